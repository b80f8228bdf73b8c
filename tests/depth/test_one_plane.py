"""Fields of one ground, each with a plane of its own, become one ground again."""

import numpy as np
import pytest

from skyquilt.depth.pairs import OnePlane


def ground(x, y):
    return 3 * np.sin(x / 9) * np.cos(y / 11) + 6 * (np.hypot(x - 40, y - 30) < 6)


def fields(rng, tilt):
    """Twelve overlapping fields of 40 m over 100 x 80 m, with noise of 0.1 m."""
    found = []
    for west in (0, 20, 40, 60):
        for south in (0, 20, 40):
            x, y = west + 40 * rng.random(600), south + 40 * rng.random(600)
            plane = rng.normal(0, 2) + tilt * rng.normal(0, 0.05, 2) @ [x - west, y - south]
            found.append(np.c_[x, y, ground(x, y) + plane + rng.normal(0, 0.1, 600)])
    return found


def off(xyz):
    """RMS against the ground, both without their general slope, m."""
    lacking = xyz[:, 2] - ground(xyz[:, 0], xyz[:, 1])
    terms = np.c_[np.ones(len(xyz)), xyz[:, :2]]
    return (lacking - terms @ np.linalg.lstsq(terms, lacking, rcond=None)[0]).std()


@pytest.mark.parametrize("seed", range(3))
def test_planes_are_taken_away_and_heights_are_kept(seed):
    rng = np.random.default_rng(seed)
    given = fields(rng, tilt=1)
    assert off(np.concatenate(given)) > 1.5
    assert off(OnePlane()(given)) < 0.35


def test_order_and_places_stay():
    given = fields(np.random.default_rng(5), tilt=0)
    assert (OnePlane()(given)[:, :2] == np.concatenate(given)[:, :2]).all()


def test_one_field_only_loses_its_slope():
    x, y = np.random.default_rng(1).random((2, 300)) * 40
    found = OnePlane()([np.c_[x, y, ground(x, y) + 5 + 0.3 * x]])
    assert off(found) < 1e-9 and found[:, 2].mean() == pytest.approx(0, abs=1e-9)
