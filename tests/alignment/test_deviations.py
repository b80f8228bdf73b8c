"""What residuals show of observations, against errors that were drawn with known correlation."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.alignment.adjust import covariance
from skyquilt.alignment.deviations import HIDDEN, MATCHED, likeness, lone_errors, observed_noise
from skyquilt.alignment.stages import weighed
from tests.alignment.blocks import HEIGHT, WIDTH, make_block


def noise_of(shared, *, sigma=0.2, seed=0):
    """The noise found where neighbours in cells of an eighth of a photo share this part of the
    variance of their errors, at the true state; and the observations in a quarter of a photo.
    """
    problem, state, size = observed_with(shared, sigma=sigma, seed=seed)
    cell = (problem.px + 0.5) / (WIDTH, HEIGHT)
    quarter = (2 * cell).astype(int)
    crowd = np.bincount(4 * problem.photo + 2 * quarter[:, 1] + quarter[:, 0]).astype(float)
    return observed_noise(problem, state, size), (crowd**2).sum() / crowd.sum()


def observed_with(shared, *, sigma=0.2, seed=0, cameras=1):
    """Observations of which neighbours in cells of an eighth of a photo share this part of the
    variance of their errors (a number, or one for each camera), the truth, and the photos' sizes.
    """
    block = make_block(seed, points=2500, noise=0.0, lens_errs=False, cameras=cameras)
    problem, rng = block.problem, np.random.default_rng(seed)
    cell = (problem.px + 0.5) / (WIDTH, HEIGHT)
    column, row = (8 * cell).astype(int).T
    common = rng.normal(0, 1, (len(block.truth.C), 8, 8, 2))[problem.photo, row, column]
    own = rng.normal(0, 1, problem.px.shape)
    shared = np.broadcast_to(shared, cameras)[problem.camera[problem.photo], None]
    px = problem.px + sigma * (np.sqrt(shared) * common + np.sqrt(1 - shared) * own)
    problem = replace(problem, px=px, sigma_px=np.full(len(px), sigma))
    size = np.tile([WIDTH, HEIGHT], (len(block.truth.C), 1)).astype(float)
    return problem, block.truth, size


@pytest.mark.parametrize("shared", [0.0, 0.1, 0.3])
def test_the_design_effect_is_kish_s(shared):
    found, together = noise_of(shared)
    assert together > 80
    assert (found.design_effect - 1) / (together - 1) == pytest.approx(shared, abs=0.02)


def test_the_likeness_of_neighbours_is_that_of_each_camera():
    problem, state, size = observed_with((0.5, 0.0, 0.2), cameras=3)
    assert likeness(problem, state, size) == pytest.approx([0.5, 0.0, 0.2], abs=0.04)


def test_sharp_observations_tell_less_than_their_residuals_show():
    """An error of so many px that pose and lens take up weighs the more, the sharper they are."""
    blunt, together = noise_of(0.0, sigma=0.2)
    sharp, _ = noise_of(0.0, sigma=0.02)
    assert WIDTH < MATCHED  # or HIDDEN would count in px of a reduced image
    hidden = HIDDEN**2 * (1 / 0.02**2 - 1 / 0.2**2)
    more = sharp.design_effect - blunt.design_effect
    assert more == pytest.approx(hidden / sharp.variance * (together - 1), rel=0.05)
    assert sharp.variance == pytest.approx(blunt.variance, rel=0.01)


def focal_by(block, px, relative):
    """Error of the focal length in px, and its stated deviation."""
    problem = replace(block.problem, px=px, sigma_px=np.full(len(px), 0.2), relative=relative)
    photos = len(block.truth.C)
    setup = SimpleNamespace(size=np.tile([WIDTH, HEIGHT], (photos, 1)), members=np.arange(photos))
    problem, state = weighed(problem, block.truth, setup)
    sigma = covariance(problem, state).camera_sigmas[0, 0]
    return state.K[0, 0] - block.truth.K[0, 0], sigma


@pytest.mark.slow
def test_blunt_observations_of_what_stands_high_do_not_decide_a_focal_length():
    """As crowns are, the fifth of all points that differs most in height is seen ten times less
    exactly. Untold, the adjustment errs more, and by more than it states.
    """
    told, untold = [], []
    for seed in range(6):
        block = make_block(seed, points=600, noise=0.0, lies=0.0)
        apart = np.abs(block.truth.X[:, 2] - np.median(block.truth.X[:, 2]))
        crown = (apart > np.quantile(apart, 0.8))[block.problem.point]
        relative = np.where(crown, 10.0, 1.0)
        rng = np.random.default_rng([seed, 3])
        px = block.problem.px + 0.04 * relative[:, None] * rng.normal(0, 1, (len(crown), 2))
        told.append(focal_by(block, px, relative))
        untold.append(focal_by(block, px, 1.0))
    (error, sigma), (other, stated) = (np.array(rows).T for rows in (told, untold))
    assert np.sqrt((error**2).mean()) < 0.7 * np.sqrt((other**2).mean())
    assert 0.5 < np.sqrt(((error / sigma) ** 2).mean()) < 1.1
    assert np.sqrt(((other / stated) ** 2).mean()) > 1.3


def test_without_observations_nothing_is_weighed():
    """A start so wrong that no ray meets another loses all of them."""
    block = make_block()
    none = np.zeros(0, np.int64)
    empty = replace(
        block.problem, point=none, photo=none, px=np.zeros((0, 2)), sigma_px=np.zeros(0)
    )
    photos = len(block.truth.C)
    setup = SimpleNamespace(size=np.tile([WIDTH, HEIGHT], (photos, 1)), members=np.arange(photos))
    problem, state = weighed(empty, block.truth, setup)
    assert problem is empty and state is block.truth


def test_single_gross_errors_of_positions_are_told_from_bends_and_displaced_parts():
    rng = np.random.default_rng(0)
    error = rng.normal(0, 2, (40, 2))
    error[3] += 60
    error[17] -= (50, 0)
    error[30] = np.nan
    assert np.flatnonzero(lone_errors(error, 1.5)).tolist() == [3, 17]
    ends = error.copy()
    ends[3], ends[17], ends[0], ends[-1] = 0, 0, 60, 60
    assert np.flatnonzero(lone_errors(ends, 1.5)).tolist() == [0, 39]
    bent = np.linspace(-3, 3, 40)[:, None] ** 4 + rng.normal(0, 1, (40, 1))
    assert not lone_errors(bent, 1.5).any()
    part = rng.normal(0, 2, (40, 2))
    part[10:13] += 60  # a receiver that was stuck
    assert not lone_errors(part, 1.5).any()
    many = rng.normal(0, 2, (40, 2))
    many[1::4] += 60
    assert not lone_errors(many, 1.5).any()
    assert not lone_errors(error[:5], 1.5).any()
