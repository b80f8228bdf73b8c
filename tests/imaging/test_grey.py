"""Reduced images against averages that are computed from shared areas."""

import numpy as np
import pytest

from skyquilt.geometry.camera import project
from skyquilt.imaging.grey import averaged, full_px, shrink, shrunken_px
from skyquilt.model.camera import Camera


def shares(large, small):
    """(small, large): how much of each pixel of the small row each one of the large row fills."""
    edges = np.arange(small + 1) * large / small
    low, high = edges[:-1, None], edges[1:, None]
    at = np.arange(large)
    return np.clip(np.minimum(high, at + 1) - np.maximum(low, at), 0, 1) * small / large


@pytest.mark.slow
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


@pytest.mark.parametrize("full", [(2250, 4000), (3648, 5472), (2700, 3600)])
def test_a_reduced_camera_shows_points_where_the_reduced_picture_does(full):
    """A square of bright pixels lies where the lens of the reduced picture has its middle."""
    height, width = full
    camera = Camera(
        width=width, height=height, focal=0.6 * width, cx=0.51 * width, cy=0.48 * height, k1=-0.05
    )
    places = np.array([[0.5, 0.45, 1.0], [-0.4, -0.3, 1.0], [0.6, -0.35, 1.0], [-0.7, 0.4, 1.0]])
    at = np.rint(project(camera, places))
    image = np.zeros(full, np.uint8)
    for column, row in at.astype(int):
        image[row - 40 : row + 41, column - 40 : column + 41] = 255
    small = shrink(image, 250)[0].astype(float)
    reduced = camera.reduced(*small.shape[::-1])
    u, v = shrunken_px(*at.T.astype(np.float32), small.shape, full)
    rows, columns = np.indices(small.shape)
    for k, seen in enumerate(project(reduced, places)):
        near = np.hypot(columns - u[k], rows - v[k]) < 8
        middle = np.array([(n * small)[near].sum() for n in (columns, rows)]) / small[near].sum()
        assert middle == pytest.approx((u[k], v[k]), abs=0.02)
        assert seen == pytest.approx(middle, abs=0.06)  # a pixel of the photo is 0.06 of these
    assert full_px(np.column_stack([u, v]), small.shape, full) == pytest.approx(at, abs=0.01)
