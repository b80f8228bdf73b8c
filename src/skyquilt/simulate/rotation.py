"""The simulator's own rotations; no code is shared with the stages that it tests.

Map: x east, y north, z up. Camera: x right, y down, z along the view. Body: x nose, y right wing, z
down.
"""

import numpy as np

from skyquilt.simulate.grid import Doubles

_NED_OF_MAP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
_CAMERA_OF_BODY = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
_NOSE_CAMERA_OF_BELLY = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])


def _turn(axis: int, degrees: float) -> Doubles:
    """Right-handed rotation about a coordinate axis."""
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def camera_rotation(yaw: float, pitch: float, roll: float) -> Doubles:
    """(3, 3) from map to camera of a belly camera; degrees, yaw clockwise from the map's north."""
    body_to_ned = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
    return np.asarray(_CAMERA_OF_BODY @ body_to_ned.T @ _NED_OF_MAP)


def gimbal_angles(yaw: float, pitch: float, roll: float) -> tuple[float, float, float]:
    """Yaw, pitch, roll of a gimbal (nose camera, pitch -90 at nadir) with the same view as the
    belly camera.
    """
    belly = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
    nose = belly @ _NOSE_CAMERA_OF_BELLY.T
    lift = np.degrees(np.arcsin(np.clip(-nose[2, 0], -1, 1)))
    if (
        np.hypot(nose[0, 0], nose[1, 0]) < 1e-9
    ):  # nadir: yaw and roll have the same axis, so roll is set to 0
        return wrap(np.degrees(np.arctan2(-nose[0, 1], nose[1, 1]))), float(lift), 0.0
    turn = np.degrees(np.arctan2(nose[1, 0], nose[0, 0]))
    bank = np.degrees(np.arctan2(nose[2, 1], nose[2, 2]))
    return wrap(turn), float(lift), wrap(bank)


def wrap(degrees: float) -> float:
    """Wraps an angle to [-180, 180)."""
    return float((degrees + 180.0) % 360.0 - 180.0)
