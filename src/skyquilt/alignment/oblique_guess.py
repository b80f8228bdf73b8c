"""Guessed directions for oblique surveys whose photos do not tell them, or tell them falsely.

Photos taken around something look at the middle of their positions; headings that are false are
usually so by the same angle in all photos. Of such guesses the one is taken with which rays of
matched keypoints meet: the epipolar constraint, with reported positions.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.determined import STATED_DEG
from skyquilt.alignment.oblique import OBLIQUE_DEG, tilt_deg, tilts_reported
from skyquilt.alignment.oblique_start import off_positions, slanting, turned_far
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
    return lost or far_off(found, priors) or turned_far(found, priors)


def far_off(found: Alignment, priors: Sequence[Prior], times: float = OFF) -> bool:
    """Whether photos lie further from their positions than so many deviations of these (median)."""
    sigma = np.median([float(np.linalg.norm(priors[i].sigma_C)) for i in found.held] or [np.inf])
    return bool(off_positions(found, priors) > times * sigma)


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
) -> list[Prior] | None:
    """Priors with the directions with which matched rays meet best; None where no guess is clearly
    better than what the photos report.
    """
    rays = _rays(photos, priors, features, links)
    if rays is None:
        return None
    best, least = None, CLEARER * _miss(rays, priors)
    for guess in _guesses(priors):
        if (miss := _miss(rays, guess)) < least:
            best, least = guess, miss
    return best


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


def _looking(prior: Prior, yaw_deg: float, tilt_deg: float) -> Prior:
    return replace(
        prior,
        yaw_deg=yaw_deg,
        pitch_deg=tilt_deg,
        roll_deg=0.0,
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


def _miss(rays: _Rays, priors: Sequence[Prior]) -> float:
    """Median angle in rad by which rays miss one another; a right angle where they meet behind a
    camera. Infinite without headings.
    """
    R = np.array([cam_R_map_from_angles(p.yaw_deg, p.pitch_deg, p.roll_deg) for p in priors])
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
