import cv2
import numpy as np
import pytest

from skyquilt.calibration.measure import coverage, opened
from skyquilt.calibration.square_image import centroid_bias, polygon_centroids
from skyquilt.geometry.camera import project
from skyquilt.model.calibration import BoardPose
from skyquilt.model.camera import Camera

CAMERA = Camera(width=640, height=480, focal=600.0, cx=319.5, cy=239.5, k1=-0.3, k2=0.1)


def pose(tilt, distance=0.5):
    a = np.radians(tilt)
    R = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    return BoardPose(cam_R_board=R, cam_t=np.array([0.05, -0.03, distance]))


def drawn(camera, at, side, rounding=0.0):
    """The centroid of a square's image by filling it, 16 times enlarged."""
    t = np.linspace(-0.5, 0.5, 200)
    half = np.full(200, 0.5)
    x, y = np.r_[t, half, -t, -half] * side, np.r_[-half, t, half, -t] * side
    px = project(camera, at(np.column_stack([x, y, 0 * x])))
    low = np.floor(px.min(0)) - 2
    size = np.ceil(px.max(0) - low).astype(int) + 3
    mask = np.zeros((size[1] * 16, size[0] * 16), np.uint8)
    cv2.fillPoly(mask, [np.round((px - low + 0.5) * 16 - 0.5).astype(np.int32)], 1)
    mask = opened(mask > 0, rounding * 16) if rounding else mask
    y, x = np.nonzero(mask)
    return (np.array([x.mean(), y.mean()]) + 0.5) / 16 - 0.5 + low


@pytest.mark.parametrize("tilt", [0, 25, 50])
@pytest.mark.parametrize("rounding", [0.0, 25.0])
def test_the_bias_is_that_of_a_square_drawn_pixel_by_pixel(tilt, rounding):
    centre = np.zeros((1, 3))
    bias = centroid_bias(CAMERA, pose(tilt), centre, 0.1, rounding)[0]
    seen = drawn(CAMERA, pose(tilt), 0.1, rounding) - project(CAMERA, pose(tilt)(centre))[0]
    assert np.abs(bias - seen).max() < 0.06
    if tilt == 50:
        assert np.linalg.norm(bias) > 1.0


def test_no_bias_without_perspective_and_distortion():
    ideal = Camera.ideal(width=640, height=480, focal=600.0)
    assert np.abs(centroid_bias(ideal, pose(0), np.zeros((1, 3)), 0.1)).max() < 1e-9


def test_centroids_and_areas_of_polygons():
    triangle = np.array([[[0, 0], [6, 0], [0, 3.0]]])
    centroid, area = polygon_centroids(triangle)
    assert np.allclose(centroid, [[2, 1]])
    assert np.allclose(area, 9)


def test_coverage_sums_to_the_true_area():
    x, y = np.meshgrid(np.arange(60.0), np.arange(60.0))
    soft = np.float32(20.3 - np.hypot(x - 29.6, y - 30.1))  # a disc, its distance to the outline
    assert coverage(soft).sum() == pytest.approx(np.pi * 20.3**2, rel=2e-3)
