"""The simulated camera: pinhole or fisheye with Brown's distortion in OpenCV's direction."""

from dataclasses import dataclass, replace

import numpy as np

from skyquilt.errors import UsageError
from skyquilt.simulate.grid import Doubles, Floats

_NED_OF_MAP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
_CAMERA_OF_BODY = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
_NOSE_CAMERA_OF_BELLY = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])


_FLATTEST = 1.45
"""Angle in rad from the axis of a fisheye (83 degrees) beyond which rays are taken for ones there.
"""


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


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Interior orientation; pixel centres at integers, the image spans [-0.5, width - 0.5]."""

    width: int = 1600
    """Image width, px."""
    height: int = 1200
    """Image height, px."""
    focal: float = 1333.0
    """Focal length, px."""
    offset_x: float = 6.0
    """Principal point from the image centre, px to the right."""
    offset_y: float = -4.0
    """Principal point from the image centre, px downwards."""
    k1: float = -0.08
    """Radial, r^2."""
    k2: float = 0.04
    """Radial, r^4."""
    k3: float = 0.0
    """Radial, r^6."""
    p1: float = 0.0005
    """Tangential."""
    p2: float = -0.0003
    """Tangential."""
    aspect: float = 1.0
    """Focal length along the columns over that along the rows."""
    readout: float = 0.0
    """Time in s from the exposure of the first row to that of the last."""
    fisheye: bool = False
    """Whether a ray is shown at its angle from the axis in rad, not at the tangent of the angle."""

    @property
    def cx(self) -> float:
        """Principal point, x, px."""
        return (self.width - 1) / 2 + self.offset_x

    @property
    def cy(self) -> float:
        """Principal point, y, px."""
        return (self.height - 1) / 2 + self.offset_y

    def distort(self, x: Doubles, y: Doubles) -> tuple[Doubles, Doubles]:
        """Ideal to real normalised coordinates."""
        if self.fisheye:
            tangent = np.hypot(x, y)
            share = np.where(tangent > 1e-9, np.arctan(tangent) / np.maximum(tangent, 1e-9), 1.0)
            x, y = x * share, y * share
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        xy2 = 2 * x * y
        return (
            x * radial + self.p1 * xy2 + self.p2 * (r2 + 2 * x * x),
            y * radial + self.p1 * (r2 + 2 * y * y) + self.p2 * xy2,
        )

    def undistort(self, x: Doubles, y: Doubles, rounds: int = 14) -> tuple[Doubles, Doubles]:
        """Real to ideal normalised coordinates, by fixed-point iteration."""
        ideal_x, ideal_y = x.copy(), y.copy()
        flat = replace(self, fisheye=False)
        for _ in range(rounds):
            real_x, real_y = flat.distort(ideal_x, ideal_y)
            ideal_x += x - real_x
            ideal_y += y - real_y
        if self.fisheye:
            angle = np.hypot(ideal_x, ideal_y)
            stretch = np.tan(np.minimum(angle, _FLATTEST)) / np.maximum(angle, 1e-9)
            stretch = np.where(angle > 1e-9, stretch, 1.0)
            ideal_x, ideal_y = ideal_x * stretch, ideal_y * stretch
        return ideal_x, ideal_y

    @property
    def folds(self) -> bool:
        """Whether distortion lays the picture over itself before its corners, so that these have no
        ray.
        """
        flat = replace(self, fisheye=False)
        x = (np.array([0.0, self.width - 1, 0, self.width - 1]) - self.cx) / self.focal
        y = (np.array([0.0, 0, self.height - 1, self.height - 1]) - self.cy) / self.focal
        with np.errstate(all="ignore"):
            again = flat.distort(*flat.undistort(x, y / self.aspect))
            off = np.hypot(again[0] - x, again[1] - y / self.aspect)
        return not bool((off * self.focal < 1.0).all())

    def project(self, points: Doubles, rotation: Doubles, centre: Doubles) -> Doubles:
        """Pixels (n, 2) of map points (n, 3); NaN behind the camera.

        One rotation (3, 3) and centre (3,) for all points, or one for each: (n, 3, 3) and (n, 3).
        """
        away = np.asarray(points, dtype=np.float64) - centre
        each = rotation.ndim == 3
        camera = np.einsum("nij,nj->ni", rotation, away) if each else away @ rotation.T
        depth = np.where(camera[:, 2] > 1e-6, camera[:, 2], np.nan)
        x, y = self.distort(camera[:, 0] / depth, camera[:, 1] / depth)
        return np.stack([self.focal * x + self.cx, self.focal * self.aspect * y + self.cy], axis=1)

    def rays(self) -> Floats:
        """Ideal normalised coordinates (height, width, 2) of every pixel centre."""
        out = np.empty((self.height, self.width, 2), dtype=np.float32)
        x = (np.arange(self.width, dtype=np.float64) - self.cx) / self.focal
        for row in range(0, self.height, 16):
            rows = np.arange(row, min(row + 16, self.height))
            y = (rows - self.cy) / (self.focal * self.aspect)
            xx, yy = np.meshgrid(x, y)
            out[rows, :, 0], out[rows, :, 1] = self.undistort(xx, yy)
        return out

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height of the level ground that a vertical photo shows, per height above it;
        distortion neglected.
        """
        wide, tall = self.width / self.focal, self.height / self.focal
        if self.fisheye:
            wide, tall = (2 * float(np.tan(min(side / 2, _FLATTEST))) for side in (wide, tall))
        return wide, tall

    def seeing(self, degrees: float) -> "Lens":
        """The lens with another focal length: the one that gives the photo's diagonal a field of
        view, distortion neglected.

        Raises:
            UsageError: no such lens exists.
        """
        most = 165.0 if self.fisheye else 150.0
        if not 5 <= degrees <= most:
            raise UsageError(f"field of view must be 5 to {most:g} degrees, not {degrees:g}")
        half, diagonal = np.radians(degrees) / 2, np.hypot(self.width, self.height) / 2
        return replace(self, focal=float(diagonal / (half if self.fisheye else np.tan(half))))

    def turned(self) -> "Lens":
        """The lens for files whose pixels were rotated by 180 degrees."""
        return replace(
            self, offset_x=-self.offset_x, offset_y=-self.offset_y, p1=-self.p1, p2=-self.p2
        )

    def scaled(self, width: int, height: int) -> "Lens":
        """The lens with the same field of view and another number of pixels."""
        ratio = width / self.width
        return replace(
            self,
            width=width,
            height=height,
            focal=self.focal * ratio,
            offset_x=self.offset_x * ratio,
            offset_y=self.offset_y * ratio,
        )
