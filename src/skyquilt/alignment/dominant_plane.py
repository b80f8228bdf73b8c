"""The level of a map of photos that report neither heights nor angles: from the plane that most
tie points lie near, the vertical that most photos look along, and the height they are flown at.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.oblique import tilts_reported
from skyquilt.alignment.similarity_graph import fit_similarity
from skyquilt.geometry.frames import turning
from skyquilt.model.poses import Alignment, Prior

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
FEWEST_FLOWN, LEAST_WAY, STRAIGHT = 4, 0.5, 0.05
"""Fewest photos that tell how a flight rises along a direction; how far they lie apart along it at
least, in flying heights; and how far off a straight rise they lie at most (RMS), as a share of
that.
"""
RISES_DEG = 5.0
"""Ground and flight rise alike where both rise by more, and differ by less. Over a hillside, a
drone that keeps its height does not rise.
"""
MOST_SCALED = 2.0
"""Factor by which a map that was laid level is enlarged or reduced at most."""
UNTOLD = (
    "No file tells heights or camera angles, and photos are headed alike: nothing tells how the map"
    " is tilted along the flight."
)
"""How the sentence begins that says so."""
TAKEN_LEVEL = (
    UNTOLD
    + " If cameras looked straight down, both the ground and the flight would rise by {0:.0f}"
    " degrees: both are taken to be level, and cameras to look aside. Heights, camera angles or"
    " control points would tell."
)
TAKEN_DOWN = (
    UNTOLD
    + " Cameras are taken to look straight down; where they looked some degrees aside, the map"
    " rises or falls by as much. Heights, camera angles or control points would tell."
)


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


def level_untold(alignment: Alignment, priors: Sequence[Prior]) -> Alignment:
    """The alignment of photos with positions of which no file tells heights or angles, with a note
    where nothing else tells how it is tilted: all are headed alike, and look not square to where
    they fly. Turned so that ground and flight are level, and laid on the positions anew, where both
    would rise alike by more than `RISES_DEG`: a camera that looks ahead does that, a hillside does
    not, unless the drone follows it. Others are unchanged.
    """
    held = [i for i in alignment.held if np.isfinite(priors[i].map_C[:2]).all()]
    told = alignment.control or tilts_reported(priors) or len(alignment.ties.xyz) < 3
    if told or len(held) < FEWEST_FLOWN or np.isfinite([p.map_C[2] for p in priors]).any():
        return alignment
    C = np.array([alignment.poses[i].map_C for i in held])
    R = np.array([alignment.poses[i].cam_R_map for i in held])
    if vertical_of(R, C) is not None:
        return alignment
    rise, square = _common_rise(C, alignment.ties.xyz)
    if not rise.any():
        return alignment if square else replace(alignment, notes=(*alignment.notes, TAKEN_DOWN))
    up = np.array([0.0, 0.0, 1.0])
    normal = np.array([*-rise, 1.0])
    normal /= np.linalg.norm(normal)
    side = np.cross(normal, up)
    Q = turning(np.array([normal, side, np.cross(normal, side)]), _frame(up, side))
    done = alignment.carried(Q, 1.0, np.median(alignment.ties.xyz, axis=0))
    done = _on_positions(done, held, priors)
    note = TAKEN_LEVEL.format(np.degrees(np.arctan(np.linalg.norm(rise))))
    return replace(done, notes=(*done.notes, note))


def _common_rise(C: Array, xyz: Array) -> tuple[Array, bool]:
    """(2,) the slope along x and y by which both centres (n, 3) and most of the points (P, 3) rise,
    as the mean by their deviations; along each main direction of the flight that is long enough to
    tell, zero where they do not rise alike. And whether the flight rises by `UPRIGHT_DEG` at most.
    """
    high = _height(C, xyz)
    normal = dominant_normal(xyz, NEAR * high)
    ground = -normal[:2] / normal[2]
    off = C - C.mean(0)
    _, _, directions = np.linalg.svd(off[:, :2], full_matrices=False)
    way = off[:, :2] @ directions.T
    long = np.ptp(way, axis=0) > LEAST_WAY * high
    flown = np.linalg.lstsq(way[:, long], off[:, 2], rcond=None)[0]
    rest = off[:, 2] - way[:, long] @ flown
    rise = np.zeros(2)
    if not long.any() or np.sqrt((rest**2).mean()) > STRAIGHT * np.ptp(way, axis=0).max():
        return rise, False
    for along, flight in zip(directions[long], flown, strict=True):
        degrees = np.degrees(np.arctan([flight, along @ ground]))
        if np.abs(degrees).min() > RISES_DEG and abs(np.diff(degrees)[0]) < RISES_DEG:
            mean = np.average(degrees, weights=[FLOWN_DEG**-2, GROUND_DEG**-2])
            rise += np.tan(np.radians(mean)) * along
    return rise, bool(np.degrees(np.arctan(np.abs(flown))).max() <= UPRIGHT_DEG)


def _on_positions(found: Alignment, held: Sequence[int], priors: Sequence[Prior]) -> Alignment:
    """The alignment enlarged, turned about the vertical and moved sideways so that photos lie where
    they report to be; as it is where positions tell nothing of its scale (a stuck receiver).
    """
    x = np.array([found.poses[i].map_C[:2] for i in held]) @ (1, 1j)
    y = np.array([priors[i].map_C[:2] for i in held]) @ (1, 1j)
    g, c, _ = fit_similarity(x, y, np.array([priors[i].sigma_C[0] for i in held]))
    if not 1 / MOST_SCALED < abs(g) < MOST_SCALED:
        return found
    cos, sin = g.real / abs(g), g.imag / abs(g)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    middle = np.median(found.ties.xyz, axis=0)
    there = g * complex(middle[0], middle[1]) + c
    return found.carried(turn, abs(g), middle, np.array([there.real, there.imag, middle[2]]))


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
