"""The spread of photos' values over the same ground, against pictures of known values."""

import numpy as np
import pytest

from skyquilt.ortho.exposure import NEUTRAL, Exposure
from skyquilt.ortho.tie_surface import level
from skyquilt.quality.tone import tone_residual
from tests.ortho.scenes import view

BOUNDS = (-5.0, -5.0, 5.0, 5.0)


def plain(*values, dtype=np.uint8, bands=3):
    """Pictures (60, 80[, bands]) of one value each."""
    shape = (60, 80, bands) if bands > 1 else (60, 80)
    return {i: np.full(shape, v, dtype) for i, v in enumerate(values)}


def found(thumbnails, exposure=NEUTRAL, apart=1.0):
    views = [view(i, apart * i, 0.0) for i in thumbnails]
    return tone_residual(views, thumbnails, level(0.0), BOUNDS, exposure)


@pytest.mark.parametrize("values", [(100, 110), (100, 100, 130), (40, 200)])
def test_the_spread_is_the_standard_deviation_of_the_values(values):
    told = found(plain(*values))
    assert told["median"] == pytest.approx(np.std(values), abs=1e-3) == told["p95"]
    assert told["cells"] > 1000


def test_gains_that_even_the_photos_leave_nothing():
    """Odds of 110 over those of 100, of 255, written down by hand."""
    gain = np.log((110 / 145) / (100 / 155))
    fields = {i: np.zeros(6, np.float32) for i in range(2)}
    gains = {0: np.full(3, gain, np.float32), 1: np.zeros(3, np.float32)}
    even = Exposure(gains=gains, fields=fields)
    assert found(plain(100, 110), even)["p95"] < 0.01
    wrong = Exposure(gains={0: -gains[0], 1: gains[1]}, fields=fields)
    assert found(plain(100, 110), wrong)["median"] > 9


def test_white_balance_that_is_evened_leaves_nothing():
    """A red and a blue picture of one grey ground: each band has its own odds."""
    colours = np.array([[140, 100, 70], [70, 100, 140]])
    pictures = {i: np.broadcast_to(c, (60, 80, 3)).astype(np.uint8) for i, c in enumerate(colours)}
    odds = colours / (255 - colours)
    gains = dict(enumerate(np.log(100 / 155 / odds).astype(np.float32)))
    even = Exposure(gains=gains, fields={i: np.zeros(6, np.float32) for i in range(2)})
    assert found(pictures, even)["p95"] < 0.01
    assert found(pictures)["median"] > 5


def test_clipped_values_do_not_count():
    assert found(plain(100, 255)) is None
    assert found(plain(2, 100)) is None
    assert found(plain(100, 110, 255))["median"] == pytest.approx(5.0, abs=1e-3)


def test_measured_values_with_their_offsets_in_their_unit():
    heat = plain(20.0, 22.5, dtype=np.float32, bands=1)
    assert found(heat)["median"] == pytest.approx(1.25)
    level_ = Exposure(gains={}, fields={}, offsets={0: 2.5})
    assert found(heat, level_)["median"] == pytest.approx(0.0, abs=1e-6)
    heat[0][:] = np.nan
    assert found(heat) is None


def test_photos_of_different_places_share_nothing():
    assert found(plain(100, 110), apart=500.0) is None
