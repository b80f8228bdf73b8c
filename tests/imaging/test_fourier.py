"""Transforms of stacks against SciPy's."""

import numpy as np
import pytest
import scipy.fft

from skyquilt.imaging.registration import fft2, ifft2


@pytest.mark.parametrize("shape", [(1, 64, 64), (5, 48, 36), (3, 7, 11)])
def test_transforms_are_scipys(shape):
    rng = np.random.default_rng(0)
    stack = (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)
    kept = stack.copy()
    expected = scipy.fft.fft2(stack.astype(complex))
    assert np.abs(fft2(stack) - expected).max() < 1e-5 * np.abs(expected).max()
    assert np.abs(ifft2(fft2(stack)) - stack).max() < 1e-5
    assert (stack == kept).all()


def test_real_and_turned_stacks_are_taken_as_they_are():
    stack = np.random.default_rng(1).normal(size=(2, 9, 6)).astype(np.float32).transpose(0, 2, 1)
    expected = np.fft.fft2(stack)
    assert np.abs(fft2(stack) - expected).max() < 1e-5 * np.abs(expected).max()
