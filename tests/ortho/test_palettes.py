"""Thermal photos in different palettes are told; those in one palette, whatever their range, are
not.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.ortho.palettes import palette_notes
from tests.alignment import surveys

MAPS = {
    "iron": cv2.COLORMAP_INFERNO,
    "rainbow": cv2.COLORMAP_JET,
    "arctic": cv2.COLORMAP_OCEAN,
    "grey": None,
}


def photo(band="thermal", unit=""):
    return replace(surveys.photo(position=None), band=band, unit=unit)


def frames(palettes, seed=1, *, own_range=True):
    """A picture of other ground for each palette, as JPEGs keep them."""
    rng = np.random.default_rng(seed)
    out = {}
    for k, name in enumerate(palettes):
        heat = cv2.GaussianBlur(rng.standard_normal((205, 256)), (0, 0), 12) * 20
        heat = heat * 0.6 + rng.uniform(-0.6, 0.6)
        low, high = np.percentile(heat, [1, 99]) if own_range else (-2, 2)
        grey = np.clip((heat - low) / (high - low) * 255, 0, 255).astype(np.uint8)
        chosen = MAPS[name]
        colours = cv2.merge([grey] * 3) if chosen is None else cv2.applyColorMap(grey, chosen)
        coded = cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, 75])[1]
        out[k] = cv2.imdecode(coded, cv2.IMREAD_COLOR)[..., ::-1]
    return out


@pytest.mark.parametrize("own_range", [True, False])
@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_one_palette_is_one(name, own_range, seed):
    small = frames([name] * 12, seed, own_range=own_range)
    assert palette_notes([photo()] * 12, small) == ()


@pytest.mark.parametrize("own_range", [True, False])
@pytest.mark.parametrize("other", ["rainbow", "arctic", "grey"])
def test_two_palettes_are_told(other, own_range):
    """A map of both was made without a word."""
    small = frames(["iron"] * 8 + [other] * 4, own_range=own_range)
    (told,) = palette_notes([photo()] * 12, small)
    assert "2 different palettes" in told and "(8)" in told and "(4)" in told
    assert palette_notes([photo("visible")] * 12, small) == ()
    assert palette_notes([photo(unit="celsius")] * 12, small) == ()


def test_grey_files_have_one_palette_with_grey_colours():
    small = frames(["grey"] * 6)
    small[2] = small[2][..., 0]
    assert palette_notes([photo()] * 6, small) == ()
