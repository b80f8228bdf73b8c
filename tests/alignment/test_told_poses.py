"""What files tell of poses is believed as far as photos confirm it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.alignment.false_tilts import alike_off
from skyquilt.alignment.told_poses import believe_told
from skyquilt.geometry.frames import rotation_from_vector
from tests.alignment.blocks import make_block


def told(scatter_deg, *, sigma_deg=1.0, seed=0):
    """A block of 24 photos at the truth whose files tell tilts that scatter; and its setup."""
    block = make_block(seed, lines=3, per_line=8, points=250)
    rng, count = np.random.default_rng(seed), len(block.truth.C)
    off = rotation_from_vector(np.radians(scatter_deg) * rng.normal(0, 1, (count, 3)) * (1, 1, 0))
    sigma = np.radians([[sigma_deg, sigma_deg, 5.0]] * count)
    problem = replace(block.problem, R0=off @ block.truth.R, sigma_R=sigma)
    rows = (np.arange(count),)
    setup = SimpleNamespace(block_rows=rows, stated_sigma_C=problem.sigma_C, in_space=False)
    return problem, block.truth, setup


@pytest.mark.parametrize(
    ("scatter_deg", "expected_deg"),
    [(0.5, 1.0), (1.0, 1.0), (3.0, 3.0), (pytest.param(6.0, 6.0, marks=pytest.mark.slow))],
)
def test_tilts_count_as_they_scatter_and_not_better_than_they_state(scatter_deg, expected_deg):
    found = []
    for seed in range(3):
        problem, _ = believe_told(*told(scatter_deg, seed=seed))
        found.append(np.degrees(np.median(problem.sigma_R[:, :2])))
        assert np.degrees(problem.sigma_R[:, 2]) == pytest.approx(5.0)  # headings as stated
    assert np.mean(found) == pytest.approx(expected_deg, rel=0.2)


def test_tilts_that_no_file_tells_stay_what_they_are():
    problem, _ = believe_told(*told(3.0, sigma_deg=6.0))
    assert np.degrees(problem.sigma_R[:, :2]) == pytest.approx(6.0)


def test_heights_that_contradict_a_line_tell_how_far_its_tilts_may_be_off():
    """Either the gimbal is off by five degrees, or the heights drifted: nothing tells."""
    block = make_block(2, lines=1, per_line=12)
    C, count = block.truth.C, len(block.truth.C)
    sigma = np.radians([[1.0, 1.0, 5.0]] * count)
    rows = (np.arange(count),)
    rng = np.random.default_rng(1)
    along = np.hypot(*(C - C[0])[:, :2].T)
    for slope_deg, expected_deg in ((0.0, 1.0), (5.0, 5.0), (-9.0, 9.0)):
        C0 = C + rng.normal(0, 0.2, C.shape)
        C0[:, 2] += along * np.tan(np.radians(slope_deg))
        C0[3, 2] += 60.0  # one that is wrong by itself
        problem = replace(block.problem, C0=C0, sigma_R=sigma)
        off = np.degrees(alike_off(problem, block.truth, rows))
        assert off == pytest.approx(expected_deg, abs=0.35)
    none = replace(problem, C0=np.full_like(C0, np.nan))
    assert np.degrees(alike_off(none, block.truth, rows)) == pytest.approx(1.0)
