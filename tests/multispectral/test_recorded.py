"""Files of bands that show nothing are told from dark ones that do."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.multispectral.recorded import look_at
from skyquilt.multispectral.reflectance import Reflectance
from skyquilt.photos.band_tags import read_band_tags
from skyquilt.photos.read import read_photo
from tests.photos.band_files import dji

BLACK, SHAPE = 3200, (120, 160)


def looked(tmp_path, counts):
    """What is found in a file of these counts."""
    path = dji(tmp_path / "a.tif", np.clip(counts, 0, 65535).astype(np.uint16))
    photo = read_photo(path)
    return look_at((photo, Reflectance.of(read_band_tags(path), photo.width, photo.height)))


@pytest.fixture
def noise():
    return np.random.default_rng(3).normal(0, 40, SHAPE)


@pytest.mark.parametrize(
    ("level", "words"),
    [(BLACK, "it is black"), (70_000, "one value"), (65_600, "of its pixels are saturated")],
)
def test_black_and_white_files_are_left_out(tmp_path, noise, level, words):
    assert words in looked(tmp_path, level + noise).reason


def test_a_damaged_file_is_left_out(tmp_path, noise):
    path = dji(tmp_path / "a.tif", (5000 + noise).astype(np.uint16))
    photo, tags = read_photo(path), read_band_tags(path)
    path.write_bytes(path.read_bytes()[: photo.width * photo.height])
    assert look_at((photo, Reflectance.of(tags, photo.width, photo.height))).reason


def test_water_in_the_infrared_is_drawn(tmp_path, noise):
    """It gives back a hundredth of the light for which plants fill the range."""
    assert not looked(tmp_path, BLACK + 400 + noise).reason
    shore = BLACK + noise
    shore[:, :20] = 30_000  # a strip of meadow beside black water
    assert not looked(tmp_path, shore).reason


def test_saturated_pixels_are_counted(tmp_path, noise):
    counts = 20_000 + noise
    counts[:, :40] = 65_535
    found = looked(tmp_path, counts)
    assert not found.reason and found.saturated == pytest.approx(0.25, abs=0.01)


def test_temperatures_and_counts_without_a_black_level_are_left_alone(tmp_path, noise):
    path = dji(tmp_path / "a.tif", (29_315 + noise).astype(np.uint16), dji__BlackCurrent=None)
    photo = read_photo(path)
    convert = Reflectance.of(replace(read_band_tags(path), black_level=None), 160, 120)
    assert convert.kind == "counts" and not look_at((photo, convert)).reason
