import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyquilt.geometry.frames import (
    angle_difference_deg,
    angles_from_cam_R_map,
    belly_from_gimbal,
    cam_R_map_from_angles,
    rotation_from_vector,
)

yaws = st.floats(-180, 180)
pitches = st.floats(-85, 85)
rolls = st.floats(-175, 175)


def apart(a, b):
    return max(abs(angle_difference_deg(x, y)) for x, y in zip(a, b, strict=True))


@given(yaws, pitches, rolls)
def test_rotation_is_orthonormal_and_right_handed(yaw, pitch, roll):
    R = cam_R_map_from_angles(yaw, pitch, roll)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


@given(yaws, pitches, rolls)
def test_angles_round_trip(yaw, pitch, roll):
    angles = angles_from_cam_R_map(cam_R_map_from_angles(yaw, pitch, roll))
    assert apart(angles, (yaw, pitch, roll)) < 1e-6


@pytest.mark.parametrize(("yaw", "up"), [(0, (0, 1)), (90, (1, 0)), (180, (0, -1)), (-90, (-1, 0))])
def test_image_top_points_where_the_yaw_says(yaw, up):
    cam_R_map = cam_R_map_from_angles(yaw)
    assert np.allclose(cam_R_map.T @ [0, -1, 0], [*up, 0], atol=1e-12)
    assert np.allclose(cam_R_map.T @ [0, 0, 1], [0, 0, -1], atol=1e-12)


def test_positive_pitch_looks_ahead_and_positive_roll_looks_left():
    assert (cam_R_map_from_angles(0, 30, 0).T @ [0, 0, 1])[1] == pytest.approx(0.5)
    assert (cam_R_map_from_angles(0, 0, 30).T @ [0, 0, 1])[0] == pytest.approx(-0.5)


@given(yaws)
def test_gimbal_straight_down_keeps_its_yaw(yaw):
    assert apart(belly_from_gimbal(yaw, -90, 0), (yaw, 0, 0)) < 1e-6


@given(yaws)
def test_gimbal_straight_down_with_roll_180_is_turned_half_round(yaw):
    assert apart(belly_from_gimbal(yaw, -90, 180), (yaw + 180, 0, 0)) < 1e-6


@given(yaws, st.floats(-170, -10))
def test_gimbal_pitch_counts_from_nadir(yaw, pitch):
    """Beyond straight down (-100, say) the camera looks back: belly pitch -10."""
    belly = belly_from_gimbal(yaw, pitch, 0)
    assert apart(belly, (yaw, pitch + 90, 0)) < 1e-6


@given(yaws, st.floats(-80, 80), st.floats(-80, 80))
def test_gimbal_and_belly_see_the_same_axis(yaw, pitch, roll):
    """The gimbal's nose is the optical axis: its direction in NED follows from yaw and pitch
    alone.
    """
    cam_R_map = cam_R_map_from_angles(*belly_from_gimbal(yaw, pitch, roll))
    a, b = np.radians([yaw, pitch])
    axis = (np.sin(a) * np.cos(b), np.cos(a) * np.cos(b), np.sin(b))
    assert np.allclose(cam_R_map.T @ [0, 0, 1], axis, atol=1e-6)  # angles lose digits near 90 deg


@given(st.floats(-720, 720), st.floats(-720, 720))
def test_angle_difference_is_wrapped(a, b):
    d = angle_difference_deg(a, b)
    assert -180 <= d < 180 + 1e-9
    assert np.isclose(np.cos(np.radians(d)), np.cos(np.radians(a - b)), atol=1e-9)


@given(st.lists(st.floats(-4, 4), min_size=3, max_size=3))
def test_rotation_vector_is_a_rotation_about_itself(w):
    R = rotation_from_vector(np.array(w))
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.allclose(R @ w, w, atol=1e-9)
