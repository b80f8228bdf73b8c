"""Lens models of lower order, each fitted by itself."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from skyquilt.geometry.camera import undistort
from skyquilt.model.camera import Camera
from skyquilt.papers.lens_order import of_order, to_working, working_K

TRUE = Camera(
    width=4000,
    height=3000,
    focal=2900.0,
    cx=2010.0,
    cy=1480.0,
    k1=-0.12,
    k2=0.06,
    k3=-0.02,
    p1=8e-4,
    p2=-5e-4,
)
ORDERS = ("none", "2", "4", "6", "6t")
GRID = np.stack(np.meshgrid(np.linspace(0, 3999, 15), np.linspace(0, 2999, 12)), -1).reshape(-1, 2)


def misfit(camera):
    """RMS in px between two cameras over the image, rays compared in px, by OpenCV's own
    undistortion.
    """
    K = np.array([[TRUE.focal, 0, TRUE.cx], [0, TRUE.focal, TRUE.cy], [0, 0, 1.0]])
    rays = cv2.undistortPoints(
        GRID.reshape(-1, 1, 2),
        K,
        np.array([TRUE.k1, TRUE.k2, TRUE.p1, TRUE.p2, TRUE.k3]),
        criteria=(cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 200, 1e-12),
    )
    own = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    K2 = np.array([[camera.focal, 0, camera.cx], [0, camera.focal, camera.cy], [0, 0, 1.0]])
    back, _ = cv2.projectPoints(
        np.concatenate([rays[:, 0], np.ones((len(GRID), 1))], 1), np.zeros(3), np.zeros(3), K2, own
    )
    return float(np.sqrt(((back[:, 0] - GRID) ** 2).sum(1).mean()))


def test_the_full_order_is_the_calibration_itself():
    assert misfit(of_order(TRUE, "6t")) < 1e-5


def test_every_order_fits_better_than_the_one_before():
    errors = [misfit(of_order(TRUE, o)) for o in ORDERS]
    assert all(a > 1.001 * b for a, b in pairwise(errors))


@pytest.mark.parametrize(
    ("order", "left"), [("2", ("k2", "k3", "p1", "p2")), ("4", ("k3", "p1", "p2"))]
)
def test_fitted_is_better_than_cut_off(order, left):
    fitted = of_order(TRUE, order)
    assert all(getattr(fitted, name) == 0 for name in left)
    assert misfit(fitted) < 0.5 * misfit(replace(TRUE, **dict.fromkeys(left, 0.0)))


def test_an_ideal_camera_stays_ideal():
    ideal = Camera.ideal(width=800, height=600, focal=700)
    for order in ORDERS:
        assert np.allclose(of_order(ideal, order).vector, ideal.vector, atol=1e-8)


def test_an_unknown_order_is_a_mistake():
    with pytest.raises(ValueError, match="6t"):
        of_order(TRUE, "8")


def test_the_working_image_is_1500_px_wide_and_undistorted():
    K = working_K(TRUE)
    px = to_working(TRUE, GRID)
    assert K[0, 0] == pytest.approx(2900 * 1500 / 4000)
    assert np.allclose((px - K[:2, 2]) / K[0, 0], undistort(TRUE, GRID))
    small = Camera.ideal(width=800, height=600, focal=700)
    assert np.allclose(to_working(small, GRID[:5]), GRID[:5])
