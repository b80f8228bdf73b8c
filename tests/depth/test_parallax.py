"""Disparities against a plane, from exact projections of tilted cameras."""

import numpy as np
import pytest

from skyquilt.depth.pairs import heights_above_plane
from skyquilt.geometry.frames import cam_R_map_from_angles


def seen(R, C, xyz):
    local = (xyz - C) @ R.T
    return local[:, :2] / local[:, 2:]


@pytest.mark.parametrize("seed", range(4))
def test_heights_are_exact_whatever_the_tilt_and_the_heights_of_the_cameras(seed):
    rng = np.random.default_rng(seed)
    yaw, pitch, roll = rng.uniform(-180, 180), *rng.uniform(-8, 8, 2)
    R = cam_R_map_from_angles(yaw, pitch, roll)
    a, b = np.array([rng.uniform(5, 25), -4.0, rng.uniform(45, 60)]), np.array([0.0, 3.0, 50.0])
    xyz = np.c_[rng.uniform(-15, 20, (200, 2)), rng.uniform(-2, 12, 200)]
    # the plane's homography takes what a sees of P to where b sees W, the point of the plane behind
    # it
    on_plane = a + (xyz - a) * (a[2] / (a[2] - xyz[:, 2]))[:, None]
    w = seen(R, b, on_plane)
    h, along, across = heights_above_plane(
        seen(R, b, xyz) - w, w, R @ (a - b), ((on_plane - b) @ R.T)[:, 2], a[2]
    )
    assert h == pytest.approx(xyz[:, 2], abs=1e-9)
    assert np.abs(across).max() < 1e-12
    assert (np.sign(along) == np.sign(xyz[:, 2])).all()


def test_no_baseline_tells_nothing():
    with np.errstate(all="raise"):
        h, _, _ = heights_above_plane(
            np.full((1, 2), 0.01), np.zeros((1, 2)), np.zeros(3), np.array([50.0]), 50.0
        )
    assert np.isnan(h).all()
