"""Guessed directions for oblique surveys whose photos do not tell them, or tell them falsely.

Photos taken around something look at the middle of their positions; cameras that are mounted
aslant, or held so out of a window, are tilted alike in all photos; headings that are false are
usually so by the same angle. Of such guesses the one is taken with which rays of matched keypoints
meet: the epipolar constraint, with reported positions.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.determined import STATED_DEG
from skyquilt.alignment.oblique import OBLIQUE_DEG, tilt_deg, tilted, tilts_reported, turned_deg
from skyquilt.alignment.oblique_start import (
    as_found,
    levelled_about_line,
    off_positions,
    slanting,
    told_directions,
    turned_far,
)
from skyquilt.alignment.priors import empty_prior
from skyquilt.geometry.frames import angles_from_cam_R_map, cam_R_map_from_angles
from skyquilt.matching.lens_kind import as_pinhole
from skyquilt.model.features import Features, Link
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Prior

Array = NDArray[np.float64]
OFF = 1.3
"""Photos without camera angles that lie further from their positions than this times their
deviations in space (median; two thirds are usual) may have been begun wrongly;
"""
LOST = 0.2
"""so may one that lost more than this share of its linked photos."""
AGREES = 0.7
"""An adjustment by a guess that keeps less than this share of the observations of the one before
contradicts the pictures, however near to their positions its photos come.
"""
AS_NEAR = 1.05
"""Photos that lie no further from their positions than this times as far lie as near to them."""
MATCHES, LOOKED_AT = 40, 20_000
"""Matches of a link, and of all, that are looked at, about."""
FAR = 4.0
"""Photos this many deviations of their positions apart tell where they look."""
CLEARER = 0.5
"""A guess is taken whose rays miss by less than this share of what they missed by before."""
TILTS_DEG = (40, 45, 50, 55, 60, 65, 70, 75)
"""Tilts that are tried where none is reported, all oblique ones: the adjustment finds the rest."""
LEVEL_DEG, NEARLY_ALL = 70.0, 0.9
"""A photo that reports a larger tilt looks at the horizon; and the share of photos that must."""
FEWEST_UNEVEN, UNEVEN = 5, 0.05
"""So many photos without camera angles whose heights over those reported vary by more than this
share of their height above the ground (RMS) may be tilted alike.
"""
ALIKE_DEG, ROUND_DEG, FINER_DEG = (12, 20, 28, 36, 44, 52, 60), 30, (4.0, 2.0, 1.0)
"""Tilts that are then tried, in directions so far apart, and steps by which the best one is moved.
"""
ABOUT_AS_WELL = 1.1
"""The best one is adjusted where rays miss by no more than this times what they miss by as found:
errors of positions hide what 20 degrees of tilt are worth, and the adjustment does not.
"""
BETTER = 0.9
"""Residuals of photos that look aslant fall below this share with about their tilts."""
ONE_SIDE = 0.7
"""Length of the mean of unit vectors in which photos look ahead that look to one side."""
TURN_DEG = 15
"""Headings are turned by multiples of this angle."""

_DOWN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Turns a camera that looks ahead downwards, about its axis to the right."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rays:
    """Matched keypoints of all links as rays in camera coordinates."""

    a: NDArray[np.int64]
    """(M,) first photo of each match."""
    b: NDArray[np.int64]
    """(M,) second photo."""
    from_a: Array
    """(M, 3) unit vectors."""
    from_b: Array
    """(M, 3) unit vectors."""
    base: Array
    """(M, 3) unit vectors from the first to the second photo, by their positions."""


def misled(found: Alignment, priors: Sequence[Prior], linked: int) -> bool:
    """Whether an adjustment of `linked` photos may have been begun wrongly: those of an oblique
    survey as they tell, since some fit false headings, too; others without camera angles that lie
    far from positions, were lost or turned far.
    """
    if tilts_reported(priors):
        return slanting(priors)
    lost = len(found.held) < (1 - LOST) * linked
    return lost or far_off(found, priors) or turned_far(found, priors) or uneven(found, priors)


def uneven(found: Alignment, priors: Sequence[Prior]) -> bool:
    """Whether heights of photos over those that they report vary far more than barometers err."""
    z = np.array([found.poses[i].map_C[2] for i in found.held])
    off = z - [priors[i].map_C[2] for i in found.held]
    off = off[np.isfinite(off)]
    if len(off) < FEWEST_UNEVEN:
        return False
    return bool(np.std(off) > UNEVEN * float(np.median(z) - found.ground_m))


def far_off(found: Alignment, priors: Sequence[Prior], times: float = OFF) -> bool:
    """Whether photos lie further from their positions than so many deviations of these (median)."""
    sigma = np.median([float(np.linalg.norm(priors[i].sigma_C)) for i in found.held] or [np.inf])
    return bool(off_positions(found, priors) > times * sigma)


def believable(guessed: Alignment, found: Alignment, priors: Sequence[Prior]) -> bool:
    """Whether more than heights speaks for an adjustment by guessed tilts: those of a barometer
    that drifts are uneven, too, and nearer to many a false tilt. It holds clearly more photos, fits
    the pictures clearly better, or lies far nearer to positions with photos that look to many
    sides: no barometer drifts as a drone turns.
    """
    if tilts_reported(priors) or (1 - LOST) * len(guessed.held) > len(found.held):
        return True
    missed = [np.linalg.norm(a.ties.residual_px, axis=1) for a in (guessed, found)]
    if np.median(missed[0]) < BETTER * np.median(missed[1]):
        return True
    ahead = np.array([guessed.poses[i].cam_R_map[2, :2] for i in guessed.held])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    aside = np.linalg.norm(ahead.mean(0)) < ONE_SIDE
    return bool(aside and off_positions(guessed, priors) < CLEARER * off_positions(found, priors))


def agrees(guessed: Alignment, found: Alignment) -> bool:
    """Whether an adjustment by a guess keeps enough of the observations of the one before: false
    positions find directions, too, with which some rays meet.
    """
    return len(guessed.ties.photo) >= AGREES * len(found.ties.photo)


def guessed_priors(
    photos: Sequence[Photo],
    priors: Sequence[Prior],
    features: Sequence[Features],
    links: Sequence[Link],
    found: Alignment | None = None,
) -> list[Prior] | None:
    """Priors with the directions with which matched rays meet best; None where no guess is clearly
    better than what the photos report. `found`: an adjustment as if photos without camera angles
    looked down; it tells their headings, and tilts that all have in common are guessed, too.
    """
    rays = _rays(photos, priors, features, links)
    if rays is None:
        return None
    best: list[Prior] | None = None
    if found is None or tilts_reported(priors):
        least = CLEARER * _miss(rays, _rotations(priors))
    else:
        best, least = _tilted_alike(rays, priors, found)
        if not (far_off(found, priors) or turned_far(found, priors)):
            return best
    for guess in _guesses(priors):
        if (miss := _miss(rays, _rotations(guess))) < least:
            best, least = guess, miss
    return best


def _tilted_alike(
    rays: _Rays, priors: Sequence[Prior], found: Alignment
) -> tuple[list[Prior] | None, float]:
    """Priors of photos that are tilted alike, with the headings that an adjustment found, or turned
    with it as a whole to where they report to be, and by what rays miss one another; None, and
    infinity, where that is more than with what was found.
    """
    level, own = np.full((2, len(priors), 3, 3), np.nan)
    yaws = dict[int, float]()
    for i in found.held:
        own[i] = found.poses[i].cam_R_map
        yaws[i] = angles_from_cam_R_map(own[i])[0]
        level[i] = cam_R_map_from_angles(0.0).T @ cam_R_map_from_angles(yaws[i])

    def missed(tilt: tuple[float, float]) -> float:
        return _miss(rays, cam_R_map_from_angles(0.0, *tilt) @ level)

    turns = np.radians(np.arange(0, 360, ROUND_DEG))
    tilts = [(t * np.cos(a), t * np.sin(a)) for t in ALIKE_DEG for a in turns.tolist()]
    least, best = min((missed(tilt), tilt) for tilt in tilts)
    for step in FINER_DEG:
        around = [(best[0] + step * i, best[1] + step * j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        least, best = min((missed(tilt), tilt) for tilt in around)
    guess = [_looking(p, yaws.get(i, np.nan), *best) for i, p in enumerate(priors)]
    guess = _levelled(guess, priors, found)
    turned = as_found(found, priors)
    if (whole := _miss(rays, _rotations(turned))) < least:
        guess, least = turned, whole
    return (guess, least) if least < ABOUT_AS_WELL * _miss(rays, own) else (None, np.inf)


def _levelled(guess: list[Prior], priors: Sequence[Prior], found: Alignment) -> list[Prior]:
    """A guess with level horizons where positions lie in a line: rays miss by as much however all
    photos are turned about it, so what was guessed of that is chance.
    """
    held = [i for i in found.held if np.isfinite(priors[i].map_C).all()]
    if told_directions([priors[i] for i in held]) != 1:
        return guess
    turn = levelled_about_line(
        np.array([found.poses[i].map_C for i in held]), _rotations([guess[i] for i in held])
    )
    for i in held:
        R = cam_R_map_from_angles(guess[i].yaw_deg, guess[i].pitch_deg, guess[i].roll_deg)
        guess[i] = _looking(guess[i], *angles_from_cam_R_map(R @ turn.T))
    return guess


def lowered(found: Alignment, priors: Sequence[Prior]) -> Sequence[Prior]:
    """The priors with pitch counted from straight down, where nearly all photos report that they
    look at the horizon and the pictures show that they look down; otherwise the very same priors.
    """
    level = sum(_tilt_deg(priors[i]) > LEVEL_DEG for i in found.held)
    down = sum(tilt_deg(found.poses[i].cam_R_map) < OBLIQUE_DEG for i in found.held)
    most = max(1.0, NEARLY_ALL * len(found.held))
    if not tilts_reported(priors) or level < most or down < most:
        return priors
    return [_lowered(p) if _tilt_deg(p) > LEVEL_DEG else p for p in priors]


LOWERED = (
    "The photos report that they look at the horizon, and the pictures show that they look down:"
    " their pitch was counted from straight down."
)
"""What is said of priors that were lowered."""


LOOK_DOWN = (
    "{0} of {1} photos report that they look far aslant, and the pictures show that they look down:"
    " their tilts were not used."
)
"""What is said of priors that were taken to look down."""


def taken_to_look_down(priors: Sequence[Prior]) -> list[Prior]:
    """The priors with those that report oblique views taken to look down, about; headings are those
    of photos that look down where views were counted from straight down.
    """
    loose = empty_prior().sigma_tilt_deg

    def level(prior: Prior) -> Prior:
        own = _lowered(prior) if _tilt_deg(prior) > LEVEL_DEG else prior
        return replace(own, pitch_deg=0.0, roll_deg=0.0, sigma_tilt_deg=loose)

    return [level(p) if tilted(p) else p for p in priors]


def doubtful_views(found: Alignment, priors: Sequence[Prior], linked: int) -> bool:
    """Whether an adjustment of `linked` photos of an oblique survey, begun as they report, lost
    photos, lies far from positions, or turned more photos than a few away from what they report.
    """
    lost = len(found.held) < (1 - LOST) * linked
    turned = sum(turned_deg(found.poses[i], priors[i]) > OBLIQUE_DEG for i in found.held)
    return lost or far_off(found, priors) or turned > LOST * len(found.held)


def shown_to_look_down(
    level: Alignment, found: Alignment, priors: Sequence[Prior], linked: int
) -> bool:
    """Whether an adjustment whose photos began looking down shows that they do: nearly all look
    down in it, and it keeps as many of them and of their observations as the one with what they
    report, as near to positions; or far more observations, for photos without any lie where they
    report.
    """
    down = sum(tilt_deg(level.poses[i].cam_R_map) < OBLIQUE_DEG for i in level.held)
    as_full = len(level.held) >= max(len(found.held), (1 - LOST) * linked)
    seen, before = len(level.ties.photo), len(found.ties.photo)
    as_full &= seen >= before
    as_near = off_positions(level, priors) <= AS_NEAR * off_positions(found, priors)
    as_near |= AGREES * seen > before and not far_off(level, priors)
    return as_full and as_near and down >= max(1.0, NEARLY_ALL * len(level.held))


def _tilt_deg(prior: Prior) -> float:
    return tilt_deg(cam_R_map_from_angles(0.0, prior.pitch_deg, prior.roll_deg))


def _guesses(priors: Sequence[Prior]) -> Iterator[list[Prior]]:
    """Photos that look at the middle of their positions, headings turned by one angle, and pitch
    counted from straight down.
    """
    xy = np.array([p.map_C[:2] for p in priors])
    east, north = (np.nanmedian(xy, axis=0) - xy).T
    inwards = np.degrees(np.arctan2(east, north)).tolist()
    if not tilts_reported(priors):
        for tilt in TILTS_DEG:
            yield [_looking(p, yaw, float(tilt)) for p, yaw in zip(priors, inwards, strict=True)]
        return
    yield [_lowered(p) for p in priors]
    yield [replace(p, yaw_deg=yaw) for p, yaw in zip(priors, inwards, strict=True)]
    for turn in range(TURN_DEG, 360, TURN_DEG):
        yield [replace(p, yaw_deg=p.yaw_deg + turn) for p in priors]


def _lowered(prior: Prior) -> Prior:
    """The prior of a photo that looks a right angle below where it is taken to look: some programs
    count a gimbal's pitch from straight down.
    """
    R = cam_R_map_from_angles(prior.yaw_deg, prior.pitch_deg, prior.roll_deg)
    yaw, pitch, roll = angles_from_cam_R_map(_DOWN @ R)
    return replace(prior, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)


def _looking(prior: Prior, yaw_deg: float, pitch_deg: float, roll_deg: float = 0.0) -> Prior:
    return replace(
        prior,
        yaw_deg=yaw_deg,
        pitch_deg=pitch_deg,
        roll_deg=roll_deg,
        sigma_yaw_deg=STATED_DEG,
        sigma_tilt_deg=STATED_DEG,
    )


def _rays(
    photos: Sequence[Photo],
    priors: Sequence[Prior],
    features: Sequence[Features],
    links: Sequence[Link],
) -> _Rays | None:
    """The rays of links between photos far enough apart; None where there are none."""
    parts: list[tuple[Array, ...]] = []
    each = max(4, min(MATCHES, LOOKED_AT // max(len(links), 1)))
    for k in links:
        base = priors[k.b].map_C - priors[k.a].map_C
        long = float(np.linalg.norm(base))
        if not long > FAR * np.linalg.norm(priors[k.a].sigma_C[:2]):  # or unknown
            continue
        some = np.linspace(0, len(k) - 1, min(each, len(k))).astype(int)
        local = [
            _local(photos[i], features[i].px[index[some]])
            for i, index in ((k.a, k.index_a), (k.b, k.index_b))
        ]
        whose = np.tile([k.a, k.b], (len(some), 1))
        parts.append((whose, *local, np.tile(base / long, (len(some), 1))))
    if not parts:
        return None
    whose, from_a, from_b, base = (np.concatenate(p) for p in zip(*parts, strict=True))
    a, b = whose.astype(np.int64).T
    return _Rays(a=a, b=b, from_a=from_a, from_b=from_b, base=base)


def _local(photo: Photo, px: NDArray[np.floating]) -> Array:
    """(n, 3) unit vectors in camera coordinates, the lens's distortion neglected."""
    middle = np.array([photo.width - 1, photo.height - 1]) / 2
    local = np.column_stack(
        [(as_pinhole(photo.lens, px) - middle) / photo.lens.focal, np.ones(len(px))]
    )
    return np.asarray(local / np.linalg.norm(local, axis=1, keepdims=True))


def _rotations(priors: Sequence[Prior]) -> Array:
    """(n, 3, 3) from map to camera as photos report, NaN without headings."""
    return np.array([cam_R_map_from_angles(p.yaw_deg, p.pitch_deg, p.roll_deg) for p in priors])


def _miss(rays: _Rays, R: Array) -> float:
    """Median angle in rad by which rays miss one another with rotations (n, 3, 3) from map to
    camera; a right angle where they meet behind a camera. Infinite where most are not known.
    """
    u = np.einsum("nji,nj->ni", R[rays.a], rays.from_a)
    v = np.einsum("nji,nj->ni", R[rays.b], rays.from_b)
    normal = np.cross(u, v)
    sine = np.linalg.norm(normal, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        miss = np.arcsin(np.clip(np.abs((normal * rays.base).sum(1)) / sine, 0, 1))
        # how far along each ray they are nearest, up to a positive factor
        along_u = (np.cross(rays.base, v) * normal).sum(1)
        along_v = (np.cross(rays.base, u) * normal).sum(1)
        miss[~((along_u > 0) & (along_v > 0))] = np.pi / 2
    return float(np.median(np.where(np.isfinite(u[:, 0] + v[:, 0]), miss, np.inf)))
