"""Photos in the plane against the same photos in space."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.geometry.frames import angles_from_cam_R_map, cam_R_map_from_angles
from skyquilt.imaging.nodes import project_nodes
from skyquilt.imaging.views import make_views, on_ground
from skyquilt.model.poses import Pose
from skyquilt.ortho.tie_surface import level
from skyquilt.papers.pieces import map_H_cam_of, planar_pose
from tests.alignment.flights import CAMERA, CORNERS
from tests.alignment.surveys import alignment


def space(yaw, pitch, roll, height=60.0):
    return Pose(
        cam_R_map=cam_R_map_from_angles(yaw, pitch, roll), map_C=np.array([12.0, -7.0, height])
    )


@settings(max_examples=60, deadline=None)
@given(
    yaw=st.floats(-180, 180),
    pitch=st.floats(-12, 12),
    roll=st.floats(-12, 12),
    height=st.floats(60, 300),
)
def test_a_photo_in_space_over_level_ground_is_one_in_the_plane(yaw, pitch, roll, height):
    pose = space(yaw, pitch, roll, height)
    flat = planar_pose(map_H_cam_of(pose))
    xyz = np.column_stack([np.random.default_rng(0).uniform(-20, 20, (50, 2)), np.zeros(50)])
    a, b = pose.to_camera(xyz), flat.to_camera(xyz)
    assert np.allclose(a[:, :2] / a[:, 2:], b[:, :2] / b[:, 2:], atol=1e-9)
    assert (b[:, 2] > 0).all()


@given(yaw=st.floats(-179, 179), height=st.floats(10, 300))
def test_a_vertical_photo_keeps_its_place_height_and_heading(yaw, height):
    flat = planar_pose(map_H_cam_of(space(yaw, 0.0, 0.0, height)))
    assert np.allclose(flat.map_C, [12.0, -7.0, height])
    found = angles_from_cam_R_map(flat.cam_R_map)
    assert abs((found[0] - yaw + 180) % 360 - 180) < 1e-6 and np.allclose(found[1:], 0, atol=1e-9)


def test_height_does_not_matter_in_the_plane():
    flat = planar_pose(map_H_cam_of(space(30.0, 3.0, -2.0)))
    low, high = (
        flat.to_camera(np.array([[1.0, 2.0, 0.0]])),
        flat.to_camera(np.array([[1.0, 2.0, 30.0]])),
    )
    assert np.array_equal(low, high)


def test_a_mirrored_or_degenerate_homography_is_no_photo():
    H = map_H_cam_of(space(30.0, 3.0, -2.0))
    with pytest.raises(ValueError, match="mirror"):
        planar_pose(H @ np.diag([-1.0, 1.0, 1.0]))
    with pytest.raises(ValueError, match="infinity"):
        planar_pose(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 0]]))


def test_views_of_the_plane_see_what_views_in_space_see():
    told = alignment(1)
    pose = space(25.0, 4.0, -3.0)
    flat = planar_pose(map_H_cam_of(pose))
    found = []
    for p in (pose, flat):
        told.poses[0] = p
        told.cameras["cam"] = CAMERA
        (view,) = make_views(told, level(0.0))
        x, y = np.meshgrid(np.linspace(-20, 40, 30), np.linspace(-30, 20, 30))
        nodes = project_nodes(view, x, y, np.zeros_like(x))
        found.append(
            (view.footprint, nodes.u, nodes.v, nodes.seen, on_ground(view, CORNERS, level(0.0)))
        )
    for a, b in zip(*found, strict=True):
        assert np.allclose(a, b, atol=2e-3)
    assert found[0][3].any() and not found[0][3].all()


def test_on_ground_is_the_way_back():
    told = alignment(1)
    told.poses[0], told.cameras["cam"] = space(25.0, 4.0, -3.0), CAMERA
    (view,) = make_views(told, level(2.0))
    xyz = on_ground(view, CORNERS, level(2.0))
    local = view.pose.to_camera(xyz)
    px = local[:, :2] / local[:, 2:] * CAMERA.focal + (CAMERA.cx, CAMERA.cy)
    assert np.allclose(px, CORNERS, atol=1e-6) and np.allclose(xyz[:, 2], 2.0)
