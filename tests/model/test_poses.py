"""Points in the camera's coordinates: apart or together, the same."""

import numpy as np
import pytest

from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.model.poses import Pose

R = cam_R_map_from_angles(31.0, 8.0, -5.0)
H = np.array([[0.02, 0.001, -0.3], [-0.002, -0.019, 0.2], [1e-5, 2e-5, 1.0]])


@pytest.mark.parametrize("cam_H_map", [None, H])
def test_coordinates_apart_are_those_together(cam_H_map):
    pose = Pose(cam_R_map=R, map_C=np.array([12.0, -7.0, 60.0]), cam_H_map=cam_H_map)
    x, y = np.meshgrid(np.linspace(-50, 50, 7), np.linspace(-40, 40, 5))
    z = np.random.default_rng(0).uniform(-3, 3, (2, 5, 7))
    together = pose.to_camera(np.stack(np.broadcast_arrays(x, y, z), -1))
    for apart, expected in zip(
        pose.planes_to_camera(x, y, z), np.moveaxis(together, -1, 0), strict=True
    ):
        assert np.allclose(np.broadcast_to(apart, z.shape), expected, rtol=1e-12, atol=1e-12)
