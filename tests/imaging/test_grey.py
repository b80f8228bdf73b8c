"""Reduced images against averages that are computed from shared areas."""

import numpy as np
import pytest

from skyquilt.imaging.grey import averaged, shrink


def shares(large, small):
    """(small, large): how much of each pixel of the small row each one of the large row fills."""
    edges = np.arange(small + 1) * large / small
    low, high = edges[:-1, None], edges[1:, None]
    at = np.arange(large)
    return np.clip(np.minimum(high, at + 1) - np.maximum(low, at), 0, 1) * small / large


@pytest.mark.parametrize("bands", [1, 3, 4, 5, 10])
@pytest.mark.parametrize("size", [(40, 24), (50, 31), (38, 21)])
def test_every_band_is_averaged_by_itself(bands, size):
    """10 bands are those of a MicaSense RedEdge-MX Dual."""
    image = np.random.default_rng(bands).uniform(0, 1000, (60, 100, bands)).astype(np.float32)
    found = averaged(image, size)
    rows, columns = shares(60, size[1]), shares(100, size[0])
    want = np.einsum("yi,ijb,xj->yxb", rows, image, columns)
    assert found.reshape(want.shape) == pytest.approx(want, abs=0.01)


def test_a_picture_of_five_bands_shrinks_as_its_bands_do():
    image = np.random.default_rng(0).integers(0, 60_000, (75, 100, 5)).astype(np.uint16)
    small, scale = shrink(image, 37)
    for band in range(5):
        assert np.array_equal(small[..., band], shrink(image[..., band].copy(), 37)[0])
    assert small.shape == (28, 37, 5) and scale == 100 / 37
