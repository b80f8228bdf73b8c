"""Photos replayed in order of capture (Y 6.1, Fig. 6.4)."""

import numpy as np
import pytest

from skyquilt.imaging.plane import Patch
from skyquilt.quality.replay import lambda_corr, replay
from tests.texture import texture

GROUND = texture(120, 300, seed=2)


def photo(column, *, put=None, noise=0.0, seed=0):
    """A photo of columns `column` to `column + 100`, put where it belongs or elsewhere."""
    pixels = GROUND[:, column : column + 100] + noise * np.random.default_rng(seed).normal(
        size=(120, 100)
    )
    central = np.zeros((120, 100), bool)
    central[30:90, 25:75] = True
    return Patch(
        column=column if put is None else put,
        row=0,
        pixels=pixels.astype(np.float32),
        shown=np.ones((120, 100), bool),
        central=central,
    )


def test_photos_in_their_place_correlate_fully():
    found = replay([photo(0), photo(60), photo(120)])
    assert np.isnan(found.with_overview[0]) and np.isnan(found.with_last[0])
    assert np.allclose(found.with_overview[1:], 1.0, atol=1e-6) and np.allclose(
        found.with_last[1:], 1.0, atol=1e-6
    )
    assert lambda_corr(found.with_overview) == pytest.approx(1.0)


def test_the_figure_is_numpys():
    found = replay([photo(0), photo(60, put=57)])
    a, b = GROUND[:, 57:100], GROUND[:, 60:103]
    assert found.with_last[1] == pytest.approx(np.corrcoef(a.ravel(), b.ravel())[0, 1], abs=1e-6)


def test_the_overview_is_more_than_the_last_photo():
    # the third photo fits the first, not the second, which lies 20 columns off
    found = replay([photo(0), photo(60, put=80), photo(20)])
    assert found.with_overview[2] > found.with_last[2]


def test_photos_that_are_not_there_and_overlaps_of_nothing_count_nothing():
    found = replay([photo(0), None, photo(180), photo(190, noise=5.0)])
    assert np.isnan(found.with_overview[1:3]).all() and np.isnan(found.with_last[1:3]).all()
    assert 0.9 < found.with_overview[3] < 1.0
