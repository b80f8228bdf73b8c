"""The level of a map of photos that report neither positions nor angles: from the plane that most
tie points lie near, the vertical that most photos look along, and the height they are flown at.
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
GROUND_DEG, AXES_DEG, FLOWN_DEG = 3.0, 1.5, 1.5
"""How far ground that counts as level slopes, gimbals are off, and drones climb that fly at one
height: one standard deviation each. `brighton` without metadata: 4.1, 0.0 and 0.8 degrees.
"""


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
    """The alignment turned so that it is level; unchanged without tie points.

    Ground slopes by some degrees, and may be a hillside, but most photos of a flight with a gimbal
    look straight down. They do if their axes are parallel while they are headed in several
    directions, since cameras tilted on their drones would look another way on each line, or if
    their axes are normal to a plane that they were taken in. Then the vertical is the mean, by
    their deviations, of the normal of the dominant plane, unless it lies clearly inclined to the
    axes, of these axes, and of the normal of that plane of centres. Otherwise it is the first.
    """
    xyz = alignment.ties.xyz
    if len(xyz) < 3:
        return alignment
    C = np.array([p.map_C for p in alignment.poses.values()])
    normal = dominant_normal(xyz, NEAR * _height(C, xyz))
    seen = vertical_of(np.array([p.cam_R_map for p in alignment.poses.values()]), C)
    if seen is not None:
        axes, scatter = seen
        off = scatter / 2  # without a gimbal, wind tilts all alike
        mean = axes / max(AXES_DEG, off) ** 2
        if (flown := _flown_level(C, axes, max(UPRIGHT_DEG, off))) is not None:
            mean += flown / FLOWN_DEG**2
        inclined = np.degrees(np.arccos(np.clip(axes @ normal, -1, 1)))
        if inclined <= max(SLOPING_DEG, SCATTERS * scatter):
            mean += normal / GROUND_DEG**2
        normal = mean / np.linalg.norm(mean)
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
    if turned.mean(1).min() < TURNED_SHARE and _flown_level(map_C[some], down, UPRIGHT_DEG) is None:
        return None
    off = np.arccos(np.clip(axes[some] @ down, -1, 1))
    return -down, float(np.degrees(np.sqrt((off**2).mean())))


def _flown_level(C: Array, axis: Array, within_deg: float) -> Array | None:
    """The normal (3,), along the axis (3,) of their photos, of the plane that centres (n, 3) lie
    in; None where they lie in none, or its normal is not so near the axis.
    """
    if len(C) < FEWEST_LEVEL:
        return None
    _, wide, directions = np.linalg.svd(C - C.mean(0), full_matrices=False)
    along = float(directions[2] @ axis)
    if abs(along) <= np.cos(np.radians(within_deg)) or wide[2] >= FLAT * wide[1]:
        return None
    return np.asarray(np.sign(along) * directions[2])


def _frame(up: Array, side: Array) -> Array:
    return np.array([up, side, np.cross(up, side)])


def _height(C: Array, xyz: Array) -> float:
    """Median distance of the centres from the median point, in m."""
    return float(np.median(np.linalg.norm(C - np.median(xyz, axis=0), axis=1)))
