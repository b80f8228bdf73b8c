"""Tilts that files report and pictures contradict. Believed to a degree, they bend or tilt the map.

Those of a camera fixed to its aircraft, whose files say that it looked straight down, are not used.
Those of a gimbal with an error that all its photos have in common are corrected: photos headed in
several directions tell it from a tilt of the map, or heights that rise on each line anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.determined import STATED_DEG
from skyquilt.alignment.priors import empty_prior
from skyquilt.alignment.problem import Problem, State
from skyquilt.alignment.setup import HALF_TURN, TURNED
from skyquilt.geometry.frames import (
    angles_from_cam_R_map,
    cam_R_map_from_angles,
    rotation_from_vector,
)
from skyquilt.model.poses import Alignment, Prior

FEWEST = 6
"""Photos that are needed to judge tilts."""
FALSE_DEG = 3.0
"""Half of the axes are further from where files tell than this, and further
"""
FALSE_DEVIATIONS = 3.0
"""than so many of the deviations stated."""
MOST_DEG = 20.0
"""Largest deviation from the vertical that such photos are given."""
NOTE = (
    "The reported tilts of the camera contradict the pictures: half of the photos look more than"
    " {0:.0f} degrees away from where they say (a camera that is fixed to its aircraft?). They"
    " count for little."
)
COMMON_DEG = 1.5
"""Smaller errors that photos of a camera have in common are usual: lines there and back bear them.
"""
COMMON_DEVIATIONS = 4.0
"""Such an error is larger than this many of its deviations,"""
COMMON_LEFT = 0.5
"""and leaves less than this share of it."""
LEAST_SCATTER_DEG = 0.3
"""Tilts that photos report are not better than this, even where they agree by chance."""
LEAST_INSIDE = 0.5
"""Cosine of the angle between axes told and found, above which they are compared."""
LEAN_DEG = 5.0
"""Less than so much may be what a drift that goes on in the turns between lines does."""
LEAST_ON_LINE, LEAST_LINES = 3, 2
"""Photos on a line, and lines, whose heights tell a gimbal from a drift."""
LINE_DEG = 60.0
"""Photos that follow one another in directions less apart belong to a line."""
SURELY = 2.0
"""Deviations of a slope that heights tell, up to which it is taken for chance."""
LEAST_NOISE = 0.1
"""Heights that photos report are not better than this share of their deviations."""
ROUNDS = 12
"""Of reweighting,"""
CUT = 3.0
"""by which an observation counts a half if it is off by this times the scatter."""
MEDIAN_LENGTH = {1: 0.674, 2: 1.177}
"""Of one and of two normal variables of deviation 1."""
WIDEST = 1e3
"""Deviation of unknowns before anything is observed: tangents, or m."""
COMMON_NOTE = (
    "All photos of {0} look {1:.1f} degrees aside of where they say, the same way as seen from the"
    " camera (a gimbal that is not calibrated?): their angles were corrected by that."
)

Array = NDArray[np.float64]


def _sensor(found: Alignment, i: int) -> Array:
    """(3, 3) rotation of the sensor of a photo, whose file may have been turned upside down."""
    R = found.poses[i].cam_R_map
    return HALF_TURN @ R if found.camera_of[i].endswith(TURNED) else R


def _told_axis(found: Alignment, prior: Prior, i: int) -> Array:
    """(3,) where a photo tells that it looks, in the frame of the camera found; the heading is the
    one found, since that of files may be wrong by itself.
    """
    R = _sensor(found, i)
    yaw = angles_from_cam_R_map(R)[0]
    return np.asarray(R @ cam_R_map_from_angles(yaw, prior.pitch_deg, prior.roll_deg)[2])


def common_tilts(
    found: Alignment, priors: Sequence[Prior], cameras: Sequence[str]
) -> tuple[Sequence[Prior], tuple[str, ...]]:
    """The priors with tilts corrected by what photos of a camera have in common beside where they
    were found, and a note for each such camera; the very same priors where there is none.
    `cameras`: names by photo, in order of capture.

    An error of the gimbal turns with the camera, a tilt of the map does not: both are solved for
    together. Of photos that are all headed alike, heights along lines there and back tell a tilt of
    the map, which no drift over the flight looks like.
    """
    own = [i for i in _largest(found) if priors[i].sigma_tilt_deg <= STATED_DEG]
    told = {i: _told_axis(found, priors[i], i) for i in own}
    own = [i for i in own if told[i][2] > LEAST_INSIDE]
    names = [n for n in dict.fromkeys(cameras) if sum(cameras[i] == n for i in own) >= FEWEST]
    own = [i for i in own if cameras[i] in names]
    if not own:
        return priors, ()
    camera = np.array([names.index(cameras[i]) for i in own])
    tangents = np.array([told[i][:2] / told[i][2] for i in own])
    turns = _turns(np.array([_sensor(found, i) for i in own]), camera)
    seen = _Group(turns, tangents, np.radians(LEAST_SCATTER_DEG))
    fit = _fitted(seen)
    C = np.array([found.poses[i].map_C for i in own])
    high = np.array([priors[i].map_C[2] for i in own]) - C[:, 2]
    known = np.flatnonzero(np.isfinite(high))
    settled = all(_settled(fit, number) for number in range(len(names)))
    if not settled and len(known) >= FEWEST:
        scatter = LEAST_NOISE * float(np.median([priors[i].sigma_C[2] for i in own]))
        first = 2 * len(names)
        rows, high, lines = _heights(
            C[known], high[known], np.array(own)[known], camera[known], first
        )
        fit = _fitted(seen, _Group(rows, high, scatter, lines))
    said, corrected = [], list(priors)
    for number, name in enumerate(names):
        common = common_turn(_known(fit, number), fit.left[camera == number])
        if common is None:
            continue
        off, back = common
        for i in _stated_by(name, priors, cameras):
            corrected[i] = turned_prior(priors[i], back)
        said.append(COMMON_NOTE.format(name, off))
    return (corrected if said else priors), tuple(said)


def common_turn(x: Array, left: Array) -> tuple[float, Array] | None:
    """The error in degrees that axes have in common which are told at tangents x (2,) beside where
    they were found, and the rotation (3, 3) that takes it back; None where it is small, or leaves
    too much of the tangents: lengths (n,).
    """
    off = float(np.degrees(np.arctan(np.linalg.norm(x))))
    if off <= COMMON_DEG or np.degrees(np.median(left)) > COMMON_LEFT * off:
        return None
    axis = np.array([-x[1], x[0], 0.0])
    return off, rotation_from_vector(axis / np.linalg.norm(axis) * np.radians(off))


def leaning_lines(
    found: Alignment, priors: Sequence[Prior], cameras: Sequence[str]
) -> tuple[Sequence[Prior], tuple[str, ...]]:
    """As `common_tilts`, of oblique photos on lines whose pictures do not hold on to one another,
    as those that look ahead there and back: each line then leans by what its gimbal is off, and
    agrees with what it tells. Heights found rise to where the photos look, on each line anew, which
    no drift over the flight does.
    """
    said, corrected = list[str](), list(priors)
    stated = [
        i
        for i in _largest(found)
        if priors[i].sigma_tilt_deg <= STATED_DEG and np.isfinite(priors[i].map_C[2])
    ]
    for name in dict.fromkeys(cameras[i] for i in stated):
        own = [i for i in stated if cameras[i] == name]
        rise = _rise(found, priors, own) if len(own) >= FEWEST else 0.0
        beside = [priors[i].pitch_deg - angles_from_cam_R_map(_sensor(found, i))[1] for i in own]
        off = float(np.degrees(np.arctan(rise)) + np.median(beside))
        if rise == 0.0 or abs(off) <= LEAN_DEG:
            continue
        for i in _stated_by(name, priors, cameras):
            corrected[i] = replace(priors[i], pitch_deg=priors[i].pitch_deg - off)
        said.append(COMMON_NOTE.format(name, abs(off)))
    return (corrected if said else priors), tuple(said)


def alike_off(problem: Problem, state: State, blocks: Sequence[NDArray[np.int64]]) -> Array:
    """Deviation (n,) in rad by which tilts that a camera's photos tell may all be off alike: the
    one that they state, and the slope by which heights told contradict those found in their block
    (rows), less what chance makes of it. Which of the two is wrong, a gimbal or a drifting height,
    nothing tells where photos are all headed alike.
    """
    stated = np.where(np.isfinite(problem.sigma_R), problem.sigma_R, 0.0)[:, 0]
    slope = np.zeros(len(stated))
    for rows in blocks:
        known = rows[np.isfinite(problem.C0[rows]).all(1)]
        if len(known) < FEWEST:
            continue
        away = state.C[known] - state.C[known].mean(0)
        plane = np.column_stack([away[:, :2], np.ones(len(known))])
        high = problem.C0[known, 2] - state.C[known, 2]
        least = LEAST_NOISE * float(np.median(problem.sigma_C[known, 2]))
        fit = _fitted(_Group(plane[:, None], high[:, None], least))
        variance, axes = np.linalg.eigh(fit.covariance[:2, :2])
        along = np.abs(axes.T @ fit.x[:2]) - SURELY * np.sqrt(variance)
        slope[rows] = np.arctan(np.linalg.norm(np.maximum(along, 0.0)))
    return np.hypot(stated, slope)


def _stated_by(camera: str, priors: Sequence[Prior], cameras: Sequence[str]) -> list[int]:
    """The photos of a camera that tell their tilts."""
    own = (i for i, name in enumerate(cameras) if name == camera)
    return [i for i in own if priors[i].sigma_tilt_deg <= STATED_DEG]


def _rise(found: Alignment, priors: Sequence[Prior], own: Sequence[int]) -> float:
    """By how much heights found rise beside those told, m per m along the headings of photos on
    each line, of two lines and more; 0 where chance and a drift over the flight tell it, too.
    """
    C = np.array([found.poses[i].map_C for i in own])
    high = np.array([C[k, 2] - priors[i].map_C[2] for k, i in enumerate(own)])
    yaw = np.radians([angles_from_cam_R_map(_sensor(found, i))[0] for i in own])
    line = _lines(C, np.zeros(len(own), np.int64))
    count = np.bincount(line)
    if (count >= LEAST_ON_LINE).sum() < LEAST_LINES:
        return 0.0
    middle = np.stack([np.bincount(line, v) / count for v in C.T[:2]], axis=1)[line]
    ahead = ((C[:, :2] - middle) * np.stack([np.sin(yaw), np.cos(yaw)], axis=1)).sum(1)
    least = LEAST_NOISE * float(np.median([priors[i].sigma_C[2] for i in own]))
    one, when = np.ones(len(own)), np.linspace(-1, 1, len(own))
    leaning, drifting = (
        _fitted(_Group(np.stack(rows, axis=1)[:, None], high[:, None], least))
        for rows in ([one, when, ahead], [one, when])
    )
    rise, sigma = float(leaning.x[2]), float(np.sqrt(leaning.covariance[2, 2]))
    left, without = (float(np.median(fit.left)) for fit in (leaning, drifting))
    told = abs(rise) > leaning.most * sigma and left < COMMON_LEFT * without
    return rise if told else 0.0


def _settled(fit: "_Fit", camera: int) -> bool:
    """Whether an error of `COMMON_DEG` of a camera would be told from chance."""
    own = slice(2 * camera, 2 * camera + 2)
    most = float(np.linalg.eigvalsh(fit.covariance[own, own])[-1])
    return bool(fit.most * np.sqrt(most) < np.radians(COMMON_DEG))


def _known(fit: "_Fit", camera: int) -> Array:
    """(2,) a camera's error along those axes along which it, or one of `COMMON_DEG`, is told from
    chance.
    """
    own = slice(2 * camera, 2 * camera + 2)
    variance, axes = np.linalg.eigh(fit.covariance[own, own])
    along = axes.T @ fit.x[own]
    known = fit.most * np.sqrt(variance) < np.maximum(abs(along), np.radians(COMMON_DEG))
    return np.asarray(axes @ (along * known))


def _largest(found: Alignment) -> list[int]:
    """The photos of the largest block."""
    return sorted(set(found.held).intersection(found.blocks[0] if found.blocks else ()))


def _turns(cam_R_map: Array, camera: NDArray[np.int64]) -> Array:
    """(n, 2, k) by how much axes told move in pictures per tangent of an error of their camera (x
    and y of each camera), and per rad of a turn of the map about its x and y.
    """
    each, first = np.arange(len(camera)), 2 * (camera.max() + 1)
    rows = np.zeros((len(camera), 2, first + 2))
    for axis in range(2):
        rows[each, axis, 2 * camera + axis] = 1.0
    rows[:, 0, first:] = -cam_R_map[:, 1, :2]
    rows[:, 1, first:] = cam_R_map[:, 0, :2]
    return rows


def _heights(
    C: Array, high: Array, order: NDArray[np.int64], camera: NDArray[np.int64], first: int
) -> tuple[Array, Array, int]:
    """(n, 1, l) by how many m heights told are above those found per unit of the unknowns of
    `_turns`, of which those of the map begin at `first`, and then per m of each camera's drift over
    the flight; and (n, 1) by how many they are, of `high` (n,). Both from the mean of each line:
    whatever a drift does from line to line, only what turns with lines there and back counts. And
    the number of lines.
    """
    rows, each = np.zeros((len(C), first + 2 + first // 2)), np.arange(len(C))
    rows[:, first] = -C[:, 1]
    rows[:, first + 1] = C[:, 0]
    rows[each, first + 2 + camera] = (order - order.min()) / max(np.ptp(order), 1)
    line = _lines(C, camera)
    count = np.bincount(line)
    for values in (rows.T, high[None]):
        for own in values:
            own -= (np.bincount(line, own) / count)[line]
    return rows[:, None], high[:, None], len(count)


def _lines(C: Array, camera: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) the number of the straight line that each photo belongs to, of centres (n, 3) in order
    of capture.
    """
    line, number = np.zeros(len(C), np.int64), 0
    for own in (np.flatnonzero(camera == k) for k in range(camera.max() + 1)):
        ahead = None
        line[own[:1]] = number
        for before, i in pairwise(own):
            step = C[i, :2] - C[before, :2]
            length = np.linalg.norm(step) + 1e-9
            if ahead is not None and ahead @ step < np.cos(np.radians(LINE_DEG)) * length:
                number, ahead = number + 1, None
            else:
                ahead = step / length
            line[i] = number
        number += 1
    return line


@dataclass(frozen=True, eq=False)
class _Group:
    """Observations alike."""

    rows: Array
    """(n, d, k) by how much each moves per unit of the unknowns."""
    told: Array
    """(n, d) observed."""
    least: float
    """The least that they scatter by."""
    means: int = 0
    """Means that were taken off them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    """Unknowns found by iteratively reweighted least squares."""

    x: Array
    """(k,) the unknowns."""
    covariance: Array
    """(k, k) of them."""
    left: Array
    """(n,) lengths of what is left of the first group's observations."""
    most: float
    """Deviations that chance exceeds as rarely as `COMMON_DEVIATIONS` of a known scatter; that of
    the observations is estimated from what is left (Student 1908).
    """


def _fitted(*groups: _Group) -> _Fit:
    """The unknowns by groups of observations alike, of which later groups may have more unknowns.

    Few observations fit unknowns by chance, so what is left of them is less than what they scatter
    by: of n observations that settle f unknowns, by the square root of (n - f) / n.
    """
    k = groups[-1].rows.shape[2]
    x: NDArray[Any] = np.zeros(k)
    free = [float(g.told.size - g.means) for g in groups]
    for again in range(ROUNDS):
        N, y, parts = np.eye(k) * WIDEST**-2, np.zeros(k), []
        left = [np.linalg.norm(g.told - g.rows @ x[: g.rows.shape[2]], axis=1) for g in groups]
        for g, away, few in zip(groups, left, free, strict=True):
            one = float(np.median(away)) / MEDIAN_LENGTH[g.told.shape[1]]
            scatter = max(one * np.sqrt(g.told.size / max(few, 1.0)), g.least)
            far = (away / (CUT * scatter)) ** 2 if again else np.zeros(len(away))
            weight, known = scatter**-2 / (1 + far), slice(g.rows.shape[2])
            own = np.zeros((k, k))
            own[known, known] = np.einsum("n,nij,nik->jk", weight, g.rows, g.rows)
            y[known] += np.einsum("n,nij,ni->j", weight, g.rows, g.told)
            N += own
            parts.append(own)
        covariance = np.linalg.inv(N)
        x = np.asarray(covariance @ y)
        free = [
            g.told.size - g.means - float((covariance * own).sum())
            for g, own in zip(groups, parts, strict=True)
        ]
    most = _as_rare(max(min(free), 1.0))
    return _Fit(x=x, covariance=np.asarray(covariance), left=left[0], most=most)


def _as_rare(free: float) -> float:
    """Deviations that chance exceeds as rarely as `COMMON_DEVIATIONS`, where the deviation is that
    of so many free observations (Wallace 1959; SciPy, exact, takes a third of a second to load).
    """
    normal = COMMON_DEVIATIONS * (8 * free + 3) / (8 * free + 1)
    return float(np.sqrt(free * np.expm1(normal**2 / free)))


def turned_prior(prior: Prior, back: Array) -> Prior:
    """A prior whose camera is turned (3, 3) in its own frame."""
    heading = prior.yaw_deg if np.isfinite(prior.yaw_deg) else 0.0
    R = back @ cam_R_map_from_angles(heading, prior.pitch_deg, prior.roll_deg)
    yaw, pitch, roll = angles_from_cam_R_map(R)
    own = yaw if np.isfinite(prior.yaw_deg) else prior.yaw_deg
    return replace(prior, yaw_deg=own, pitch_deg=pitch, roll_deg=roll)


def off_told(found: Alignment, priors: Sequence[Prior]) -> float:
    """Median angle in degrees between where photos tell that they look and where they were found;
    NaN if none tells.
    """
    stated = [i for i in found.held if priors[i].sigma_tilt_deg <= STATED_DEG]
    apart = [np.arccos(np.clip(_told_axis(found, priors[i], i)[2], -1, 1)) for i in stated]
    return float(np.degrees(np.median(apart))) if apart else np.nan


def told_no_tilt(found: Alignment, priors: Sequence[Prior]) -> tuple[Sequence[Prior], str]:
    """The priors without the tilts that they report, and a note, where an alignment contradicts
    these as a whole; otherwise the priors themselves and an empty text.
    """
    stated = [i for i in found.held if priors[i].sigma_tilt_deg <= STATED_DEG]
    if len(stated) < FEWEST or 2 * len(stated) < len(found.held):
        return priors, ""
    usual = off_told(found, priors)
    sigma = float(np.median([priors[i].sigma_tilt_deg for i in stated]))
    if usual <= max(FALSE_DEG, FALSE_DEVIATIONS * sigma):
        return priors, ""
    loose = float(np.clip(usual, empty_prior().sigma_tilt_deg, MOST_DEG))
    return [
        replace(p, pitch_deg=0.0, roll_deg=0.0, sigma_tilt_deg=loose) for p in priors
    ], NOTE.format(usual)
