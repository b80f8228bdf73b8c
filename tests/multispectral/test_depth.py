"""Counts of 12 bits at the low end of files of 16 are told, and converted as such where they end at
4,095. The oracle: the same counts moved up to the top of 16 bits.
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.multispectral.captures import bands_of_files
from skyquilt.multispectral.depth import depth_of, with_bits
from skyquilt.multispectral.recorded import look_at
from skyquilt.photos.read import read_photo
from tests.photos.band_files import dji

SHAPE, FILES, MOVED = (60, 80), 4, 16


def taken(folder, light, times):
    """The band of some files of a detector of 12 bits, whose counts are multiplied; and what each
    recorded.
    """
    rng, photos = np.random.default_rng(1), []
    folder.mkdir()
    for k in range(FILES):
        counts = np.clip(rng.gamma(2.0, light, SHAPE) + 200, 0, 4095).astype(np.uint16)
        path = dji(folder / f"{k}.tif", counts * times, dji__BlackCurrent=200 * times)
        photos.append(read_photo(path))
    bands = bands_of_files(photos)
    items = (item for b in bands for item in zip(b.photos, b.converts, strict=True))
    return bands, {photo.name: look_at((photo, convert)) for photo, convert in items}


def test_counts_that_end_at_a_detectors_largest_are_of_so_many_bits(tmp_path):
    bands, recorded = taken(tmp_path / "low", 900, 1)
    moved, higher = taken(tmp_path / "moved", 900, MOVED)
    bits, said = depth_of(bands, recorded)
    assert bits == 12 and "4,095" in said
    assert depth_of(moved, higher) == (0, "")
    (low,), (top,) = with_bits(bands[0], bits).converts[:1], moved[0].converts[:1]
    counts = np.arange(200, 4096, 5, np.uint16).reshape(-1, 1)
    np.testing.assert_allclose(low(counts), top(counts * MOVED), rtol=1e-6)
    again = look_at((bands[0].photos[0], low))
    assert again.saturated == pytest.approx(higher["0.tif"].saturated) and again.saturated > 0


def test_counts_that_stay_below_it_are_told(tmp_path):
    bands, recorded = taken(tmp_path / "low", 280, 1)
    bits, said = depth_of(bands, recorded)
    assert bits == 0 and "12 bits" in said and "16 times" in said


def test_counts_of_all_bits_are_left_alone(tmp_path):
    bands, recorded = taken(tmp_path / "whole", 900, 9)
    even = {name: replace(r, step=1) for name, r in recorded.items()}
    assert depth_of(bands, even) == (0, "")
