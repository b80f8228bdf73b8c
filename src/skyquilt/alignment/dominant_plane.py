"""The level of a map of photos that report neither positions nor angles: the plane that most tie
points lie near, or the vertical that most photos look along.
"""

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.frames import turning
from skyquilt.model.poses import Alignment

Array = NDArray[np.float64]
NEAR = 0.03
"""Points within this share of the median flying height are near a plane."""
TRIES = 400
"""Planes tried, each through three points."""
SAMPLED = 400
"""Photos whose axes are compared, about."""
ALIKE_DEG = 10.0
"""Photos whose axes differ by less look the same way."""
TURNED_DEG, TURNED_SHARE = 60.0, 0.2
"""Photos are headed in several directions if so large a share is headed elsewhere by so much."""
SLOPING_DEG = 5.0
"""Ground that is less inclined is level: axes of vertical photos are not known better."""
SCATTERS = 3.0
"""Deviations of the axes by which the ground must be inclined as well."""
FLAT = 0.05
"""Camera centres are a plane if they scatter about it by no more than this share of how wide they
lie along it where they lie least wide: as flown at one height.
"""
FEWEST_LEVEL = 6
"""Fewer centres are no plane."""
UPRIGHT_DEG = 3.0
"""Photos look straight down from a plane of camera centres that their axes are so normal to."""


def dominant_normal(xyz: Array, near_m: float) -> Array:
    """The upward unit normal (3,) of the plane with the most points (n, 3), at least three, within
    a distance in m; refined on those (Fischler and Bolles 1981).
    """
    rng = np.random.default_rng(0)
    a, b, c = xyz[rng.integers(len(xyz), size=(3, TRIES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    fit = length > 1e-9
    normals, a = normals[fit] / length[fit, None], a[fit]
    if not len(normals):
        return np.array([0.0, 0.0, 1.0])
    some = xyz[:: max(1, len(xyz) // 4000)]
    number = [(np.abs((some - p) @ n) < near_m).sum() for n, p in zip(normals, a, strict=True)]
    normal, place = normals[int(np.argmax(number))], a[int(np.argmax(number))]
    for _ in range(5):
        mine = xyz[np.abs((xyz - place) @ normal) < near_m]
        place = mine.mean(0)
        normal = np.linalg.svd(mine - place, full_matrices=False)[2][2]
    return np.asarray(normal if normal[2] > 0 else -normal)


def levelled(alignment: Alignment) -> Alignment:
    """The alignment turned so that its dominant plane is level; unchanged without tie points.

    Ground may slope, though: most photos of a flight with a gimbal look straight down. They do if
    their axes are parallel while they are headed in several directions, since cameras tilted on
    their drones would look another way on each line, or if their axes are normal to a plane that
    they were taken in. Then their axes are the vertical where the plane lies clearly inclined to
    them.
    """
    xyz = alignment.ties.xyz
    if len(xyz) < 3:
        return alignment
    C = np.array([p.map_C for p in alignment.poses.values()])
    normal = dominant_normal(xyz, NEAR * _height(C, xyz))
    seen = vertical_of(np.array([p.cam_R_map for p in alignment.poses.values()]), C)
    if seen is not None:
        inclined = np.degrees(np.arccos(np.clip(seen[0] @ normal, -1, 1)))
        if inclined > max(SLOPING_DEG, SCATTERS * seen[1]):
            normal = seen[0]
    up = np.array([0.0, 0.0, 1.0])
    side = np.cross(normal, up)
    Q = turning(np.array([normal, side, np.cross(normal, side)]), _frame(up, side))
    if np.linalg.norm(side) < 1e-9:
        return alignment
    return alignment.carried(Q, 1.0, np.median(xyz, axis=0))


def vertical_of(cam_R_map: Array, map_C: Array) -> tuple[Array, float] | None:
    """The upward vertical (3,) of photos that look straight down, from their rotations (n, 3, 3)
    and centres (n, 3), and the scatter of their axes about it in degrees; None where most do not
    look the same way, or all of these are headed alike and their axes are not normal to a plane
    that they were taken in: such photos may slant.
    """
    each = max(1, len(cam_R_map) // SAMPLED)
    cam_R_map, map_C = cam_R_map[::each], map_C[::each]
    axes = cam_R_map[:, 2]
    near = axes @ axes.T > np.cos(np.radians(ALIKE_DEG))
    some = near[int(np.argmax(near.sum(1)))]
    if 2 * some.sum() <= len(axes):
        return None
    down = axes[some].sum(0)
    down /= np.linalg.norm(down)
    ahead = -cam_R_map[some, 1]
    ahead -= (ahead @ down)[:, None] * down
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    turned = ahead @ ahead.T < np.cos(np.radians(TURNED_DEG))
    if turned.mean(1).min() < TURNED_SHARE and not _flown_level(map_C[some], down):
        return None
    off = np.arccos(np.clip(axes[some] @ down, -1, 1))
    return -down, float(np.degrees(np.sqrt((off**2).mean())))


def _flown_level(C: Array, axis: Array) -> bool:
    """Whether centres (n, 3) lie in a plane that the axis (3,) of their photos is normal to."""
    if len(C) < FEWEST_LEVEL:
        return False
    _, wide, directions = np.linalg.svd(C - C.mean(0), full_matrices=False)
    upright = abs(float(directions[2] @ axis)) > np.cos(np.radians(UPRIGHT_DEG))
    return bool(upright and wide[2] < FLAT * wide[1])


def _frame(up: Array, side: Array) -> Array:
    return np.array([up, side, np.cross(up, side)])


def _height(C: Array, xyz: Array) -> float:
    """Median distance of the centres from the median point, in m."""
    return float(np.median(np.linalg.norm(C - np.median(xyz, axis=0), axis=1)))
