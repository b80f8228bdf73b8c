"""Frames and angles.

*map*: x east, y north, z up, in m: the output CRS less an origin. *camera*: x right, y down, z
forward. *ned*: north, east, down. *body*: x nose, y right, z down; the belly camera's image top
points along the nose. `a_R_b` takes coordinates in b to coordinates in a, so chains cancel
visually.
"""

from collections.abc import Sequence
from typing import TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.photo import GeoPosition

Matrix = NDArray[np.float64]
Metres = TypeVar("Metres", float, Matrix)

MAP_R_NED: Matrix = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
CAM_R_BODY: Matrix = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
METRES_PER_DEGREE = 111_320.0
"""Length in m of a degree of latitude, and of longitude at the equator, on a sphere of WGS 84's
larger radius; up to 0.7 % too long. What must be exact is projected.
"""


def east_north_m(origin: GeoPosition, place: GeoPosition) -> tuple[float, float]:
    """How far in m one position lies to the east and north of another near it."""
    north = (place.latitude_deg - origin.latitude_deg) * METRES_PER_DEGREE
    shrink = np.cos(np.radians(origin.latitude_deg))
    east = (place.longitude_deg - origin.longitude_deg) * METRES_PER_DEGREE * shrink
    return float(east), float(north)


def beside_deg(
    latitude_deg: float, longitude_deg: float, *, east_m: Metres, north_m: Metres
) -> tuple[Metres, Metres]:
    """Latitude and longitude in degrees of what lies so far in m to the east and north."""
    shrink = max(float(np.cos(np.radians(latitude_deg))), 1e-6)
    latitude = latitude_deg + north_m / METRES_PER_DEGREE
    return latitude, longitude_deg + east_m / (METRES_PER_DEGREE * shrink)


def _euler_zyx(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Matrix:
    """Rz(yaw) Ry(pitch) Rx(roll), degrees."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(a := np.radians([yaw_deg, pitch_deg, roll_deg])), np.sin(a)
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return np.asarray(rz @ ry @ rx)


def _zyx_angles(R: Matrix) -> tuple[float, float, float]:
    """Yaw, pitch, roll in degrees of Rz Ry Rx; roll 0 at pitch +-90 deg."""
    level = np.hypot(R[2, 1], R[2, 2])
    pitch = np.arctan2(-R[2, 0], level)  # an arcsine would lose digits near 90 degrees
    if level < 1e-9:
        return float(np.degrees(np.arctan2(-R[0, 1], R[1, 1]))), float(np.degrees(pitch)), 0.0
    yaw, roll = np.arctan2(R[1, 0], R[0, 0]), np.arctan2(R[2, 1], R[2, 2])
    return float(np.degrees(yaw)), float(np.degrees(pitch)), float(np.degrees(roll))


def cam_R_map_from_angles(yaw_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Matrix:
    """Rotation (3, 3) from map to camera for belly angles in degrees (see `model.photo.Attitude`).

    The yaw counts from the map's north (+y): subtract the meridian convergence from a true-north
    yaw first.
    """
    ned_R_body = _euler_zyx(yaw_deg, pitch_deg, roll_deg)
    return np.asarray(CAM_R_BODY @ ned_R_body.T @ MAP_R_NED.T)


def ned_from_body(yaw_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Matrix:
    """Rotation (3, 3) from an aircraft's body (nose, right, down) to north, east, down; degrees,
    pitch positive = nose up, roll positive = right wing down.
    """
    return _euler_zyx(yaw_deg, pitch_deg, roll_deg)


def angles_from_cam_R_map(cam_R_map: Matrix) -> tuple[float, float, float]:
    """Belly angles (yaw, pitch, roll) in degrees of a map-to-camera rotation; inverse of the
    above.
    """
    ned_R_body = MAP_R_NED.T @ cam_R_map.T @ CAM_R_BODY
    return _zyx_angles(ned_R_body)


def belly_from_gimbal(
    yaw_deg: float, pitch_deg: float, roll_deg: float
) -> tuple[float, float, float]:
    """Belly angles in degrees from gimbal angles of a camera that looks along the body's nose.

    Gimbals (DJI's `GimbalYaw/Pitch/RollDegree`, Rz Ry Rx in NED) report pitch -90 at nadir and roll
    about the optical axis; the belly camera looks down instead, so the two bodies differ by a
    quarter turn about y.
    """
    gimbal = _euler_zyx(yaw_deg, pitch_deg, roll_deg)
    quarter = np.array(
        [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    )  # belly axes in gimbal axes
    return _zyx_angles(gimbal @ quarter)


@overload
def angle_difference_deg(a: float, b: float) -> float: ...
@overload
def angle_difference_deg(a: Matrix, b: Matrix | float) -> Matrix: ...
def angle_difference_deg(a: Matrix | float, b: Matrix | float) -> Matrix | float:
    """a - b wrapped to [-180, 180) degrees; of arrays, each element's."""
    return (a - b + 180.0) % 360.0 - 180.0


def rotation_from_vector(w: Matrix) -> Matrix:
    """Rodrigues: rotation matrices (..., 3, 3) from rotation vectors (..., 3) in rad."""
    w = np.asarray(w, dtype=np.float64)
    theta = np.linalg.norm(w, axis=-1)[..., None, None]
    zero = np.zeros_like(w[..., 0])
    skew = np.stack(
        [
            np.stack([zero, -w[..., 2], w[..., 1]], -1),
            np.stack([w[..., 2], zero, -w[..., 0]], -1),
            np.stack([-w[..., 1], w[..., 0], zero], -1),
        ],
        -2,
    )
    small = theta < 1e-8
    safe = np.where(small, 1.0, theta)
    a = np.where(small, 1 - theta**2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - theta**2 / 24, (1 - np.cos(safe)) / safe**2)
    return np.asarray(np.eye(3) + a * skew + b * skew @ skew)


Array = NDArray[np.float64]


def commonest_deg(angles_deg: Array) -> tuple[float, float]:
    """The mean in degrees of those angles (n,) that lie within 20 degrees of the one with most of
    them around it, and their share. Of many, 500 or so are looked at.
    """
    unit = np.exp(1j * np.radians(angles_deg[:: max(1, len(angles_deg) // 500)]))
    near = np.abs(unit[:, None] - unit[None]) < 2 * np.sin(np.radians(20.0) / 2)
    most = near[near.sum(1).argmax()]
    return float(np.degrees(np.angle(unit[most].sum()))), float(most.mean())


def turning(a: Array, b: Array) -> Array:
    """The rotation b_R_a (3, 3) that best takes directions a (n, 3) to b (n, 3): Wahba's problem
    (Markley 1988).
    """
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b))
    return nearest_rotation(b.T @ a)


def nearest_rotation(m: Array) -> Array:
    """The rotation matrix nearest to a matrix (3, 3)."""
    u, _, vt = np.linalg.svd(m)
    return np.asarray(u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt)


def angle_deg(a: Array, b: Array) -> float:
    """Angle between two rotations (3, 3) in degrees."""
    return float(np.degrees(2 * np.arcsin(min(1.0, np.linalg.norm(a - b) / np.sqrt(8)))))


def median_rotation(rotations: Sequence[Array], *, rounds: int = 50) -> Array:
    """The chordal L1 mean (Hartley et al. 2013) by Weiszfeld's reweighting: robust against up to
    half of the rotations being wrong.
    """
    stack = np.stack(rotations)
    mean = nearest_rotation(np.median(stack, axis=0))
    for _ in range(rounds):
        off = np.linalg.norm(stack - mean, axis=(1, 2))
        mean = nearest_rotation((stack / np.maximum(off, 1e-6)[:, None, None]).sum(0))
    return mean
