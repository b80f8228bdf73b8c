"""What residuals show of observations, against errors that were drawn with known correlation."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.deviations import HIDDEN, MATCHED, observed_noise
from tests.alignment.blocks import HEIGHT, WIDTH, make_block


def noise_of(shared, *, sigma=0.2, seed=0):
    """The noise found where neighbours in cells of an eighth of a photo share this part of the
    variance of their errors, at the true state; and the observations in a quarter of a photo.
    """
    block = make_block(seed, points=2500, noise=0.0, lens_errs=False)
    problem, rng = block.problem, np.random.default_rng(seed)
    cell = (problem.px + 0.5) / (WIDTH, HEIGHT)
    column, row = (8 * cell).astype(int).T
    common = rng.normal(0, 1, (len(block.truth.C), 8, 8, 2))[problem.photo, row, column]
    own = rng.normal(0, 1, problem.px.shape)
    px = problem.px + sigma * (np.sqrt(shared) * common + np.sqrt(1 - shared) * own)
    problem = replace(problem, px=px, sigma_px=np.full(len(px), sigma))
    size = np.tile([WIDTH, HEIGHT], (len(block.truth.C), 1)).astype(float)
    quarter = (2 * cell).astype(int)
    crowd = np.bincount(4 * problem.photo + 2 * quarter[:, 1] + quarter[:, 0]).astype(float)
    return observed_noise(problem, block.truth, size), (crowd**2).sum() / crowd.sum()


@pytest.mark.parametrize("shared", [0.0, 0.1, 0.3])
def test_the_design_effect_is_kish_s(shared):
    found, together = noise_of(shared)
    assert together > 80
    assert (found.design_effect - 1) / (together - 1) == pytest.approx(shared, abs=0.02)


def test_sharp_observations_tell_less_than_their_residuals_show():
    """An error of so many px that pose and lens take up weighs the more, the sharper they are."""
    blunt, together = noise_of(0.0, sigma=0.2)
    sharp, _ = noise_of(0.0, sigma=0.02)
    assert WIDTH < MATCHED  # or HIDDEN would count in px of a reduced image
    hidden = HIDDEN**2 * (1 / 0.02**2 - 1 / 0.2**2)
    more = sharp.design_effect - blunt.design_effect
    assert more == pytest.approx(hidden / sharp.variance * (together - 1), rel=0.05)
    assert sharp.variance == pytest.approx(blunt.variance, rel=0.01)
