"""Thermal frames without links that show a closed shutter, or water."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from skyquilt.alignment.nothing_shown import likeness, shutter_closed
from tests.alignment.surveys import photo
from tests.alignment.test_oblique import CAMERA, LAWN, block, hills, pose


def picture(rng, kind):
    """(120, 160) noise of the detector, ground seen through a lens, or noise on a shutter that is
    warmer towards its corners; as bright and as contrasty as each other, as grey pictures are.
    """
    values = rng.normal(size=(120, 160))
    if kind == "ground":
        values = cv2.GaussianBlur(values, (0, 0), 1.2)
    if kind == "shutter":
        y, x = np.mgrid[-1:1:120j, -1:1:160j]
        values = values + 4 * (x**2 + y**2)
    return np.clip(128 + 45 * (values - values.mean()) / values.std(), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("own", "others", "band", "shut"),
    [
        ("noise", "ground", "thermal", True),
        ("shutter", "ground", "thermal", True),
        ("ground", "ground", "thermal", False),
        ("noise", "noise", "thermal", False),  # water
        ("noise", "ground", "visible", False),
    ],
)
def test_a_closed_shutter_is_told_from_water(own, others, band, shut):
    """At the rim of the flight, where frames without links were drawn by their metadata."""
    done, rng = block(LAWN, hills(3000)), np.random.default_rng(1)
    pictures = [picture(rng, others) for _ in LAWN] + [picture(rng, own)]
    frame = replace(photo("a.tif"), band=band, width=CAMERA.width, height=CAMERA.height)
    found = shutter_closed(frame, len(LAWN), pose(50, 20), done, lambda i, _: pictures[i])
    assert found == shut


def test_where_no_other_frame_shows_the_ground_nothing_is_told():
    done, rng = block(LAWN, hills(3000)), np.random.default_rng(1)
    pictures = [picture(rng, "ground") for _ in LAWN] + [picture(rng, "noise")]
    frame = replace(photo("a.tif"), band="thermal", width=CAMERA.width, height=CAMERA.height)
    assert not shutter_closed(frame, len(LAWN), pose(200, 0), done, lambda i, _: pictures[i])


def test_noise_has_no_likeness_whatever_lies_below_it():
    rng = np.random.default_rng(2)
    assert abs(likeness(picture(rng, "noise"))) < 0.05
    assert abs(likeness(picture(rng, "shutter"))) < 0.1
    assert likeness(picture(rng, "ground")) > 0.6
    assert likeness(np.full((20, 30), 7, np.uint8)) == 0
