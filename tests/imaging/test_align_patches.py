"""The deviation that two patches tell of their shift, against errors of known shifts."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from skyquilt.imaging.align_patches import translate


def pairs(noise: float, blur: float, seed: int, count: int = 200, grain: float = 0.0):
    """Patches (n, 15, 15) and (n, 21, 21) of a random texture with a fraction of a px between them,
    each with its own noise, blurred by `grain` px, and these shifts (n, 2).
    """
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 1 / blur, (60, 2)) / np.sqrt(2)  # the spectrum of blurred white noise
    phase, shift = rng.uniform(0, 2 * np.pi, (count, 1, 60)), rng.uniform(-0.5, 0.5, (count, 2))
    reference, moving = (
        100 + 25 * np.sqrt(2 / 60) * np.cos(at @ waves.T + phase).sum(2)
        for at in (_places(7), _places(10) - shift[:, None])
    )
    reference, moving = reference.reshape(-1, 15, 15), moving.reshape(-1, 21, 21)
    one, other = (
        (p + noise * _grains(rng, p.shape, grain)).astype(np.float32) for p in (reference, moving)
    )
    return one, other, shift


def _grains(rng: np.random.Generator, shape: tuple[int, ...], grain: float) -> np.ndarray:
    """Noise of deviation 1 that is alike within so many px."""
    white = rng.normal(0, 1, shape)
    if grain == 0:
        return white
    found = gaussian_filter(white, (0, grain, grain), mode="wrap")
    return np.asarray(found / found.std())


def _places(reach: int) -> np.ndarray:
    """x and y (1, n, 2) of the pixels of a patch about its middle."""
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(float)
    return np.stack([x.ravel(), y.ravel()], 1)[None]


@pytest.mark.parametrize(("noise", "blur"), [(1.5, 2.0), (5.0, 2.0), (5.0, 3.5), (12.0, 2.0)])
def test_the_stated_deviation_is_that_of_the_errors(noise, blur):
    """From 0.02 to 0.2 px. Patches that hardly agree have not converged after so few steps: their
    errors are a third larger.
    """
    reference, moving, truth = pairs(noise, blur, seed=7)
    shift, score, told = translate(reference, moving)
    known = np.isfinite(score)
    assert known.mean() > 0.95
    ratio = ((shift - truth)[known] / told[known, None]).ravel()
    assert 0.9 < 1.48 * np.median(np.abs(ratio)) < 1.6


@pytest.mark.parametrize(("noise", "grain"), [(2.0, 0.7), (4.0, 0.7), (2.0, 1.0), (4.0, 1.0)])
def test_misfits_of_neighbouring_pixels_that_are_alike_tell_less(noise, grain):
    """As of leaves, of which each photo sees others."""
    reference, moving, truth = pairs(noise, 2.0, seed=9, grain=grain)
    shift, score, told = translate(reference, moving)
    known = np.isfinite(score)
    assert known.mean() > 0.95
    ratio = ((shift - truth)[known] / told[known, None]).ravel()
    assert 0.9 < 1.48 * np.median(np.abs(ratio)) < 1.6


def test_patches_that_differ_more_are_told_apart():
    """Between pairs of every kind, in one call: the stated order is that of the errors."""
    made = [pairs(n, 2.0, seed) for n, seed in ((1.5, 1), (12.0, 2))]
    reference, moving, truth = (np.concatenate(parts) for parts in zip(*made, strict=True))
    shift, _, told = translate(reference, moving)
    error = np.linalg.norm(shift - truth, axis=1)
    sharp = told < np.nanmedian(told)
    assert np.nanmedian(error[~sharp]) > 4 * np.nanmedian(error[sharp])


def test_equal_patches_tell_no_error():
    reference, moving, _ = pairs(0.0, 2.0, seed=3, count=20)
    moving[:, 3:-3, 3:-3] = reference
    shift, score, told = translate(reference, moving)
    assert np.abs(shift).max() < 1e-3 and score.min() > 0.9999 and told.max() < 3e-3
