"""The start of an oblique survey (orbits, facades, a tilted grid): photos as their metadata say.

Links of oblique photos are no similarities of the ground plane, so a start by them bends into a
dome. Where most photos report their tilt and their place, these are near enough to the truth for
an adjustment in space to begin with.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.control import fit_similarity_3d
from skyquilt.alignment.determined import STATED_DEG
from skyquilt.alignment.oblique import (
    MOST_OBLIQUE,
    tells_angles,
    tilt_deg,
    tilted,
    tilts_reported,
    told,
)
from skyquilt.alignment.similarity_graph import components
from skyquilt.alignment.start import GROSS_DEG, Start, heading_errors, plane_link
from skyquilt.alignment.triangulate import intersect
from skyquilt.geometry.frames import (
    angles_from_cam_R_map,
    cam_R_map_from_angles,
    rotation_from_vector,
)
from skyquilt.matching.lens_kind import as_pinhole
from skyquilt.model.features import Features, Link
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Prior

Array = NDArray[np.float64]
ASLANT_DEG = 5.0
"""Photos tilted by more than this (median) show that their links are no similarities."""
APART = np.sin(np.radians(5.0))
"""Sine of the least angle between two rays that tell where they meet, positions erring by metres.
"""
VERTICAL_DEG, LEVEL_SHARE = 15.0, 0.1
"""Photos tilted by less look straight down; with fewer of them a survey has none to speak of."""
FROM_ABOVE_DEG = 40.0
"""View angle up to which a map shows ground and roofs rather than walls, about."""
NEIGHBOURS = 3
"""Photos by which one begins that reports no position."""
NEARER = 0.95
"""Photos come nearer to their positions where their distance falls by this factor."""
LOST = 0.8
"""An adjustment that holds less than this share of another's photos or observations lost them."""
FEWEST_CROWDED = 4
"""Photos with positions that are needed to judge whether these crowd in one place: ..."""
CROWDED = 5.0
"""... half of them lie within so many of their deviations of their middle."""
WIDE = 2.0
"""Least spread of positions across their main direction, in their deviations (RMS), that tells how
all are turned about it.
"""
ACROSS = 0.5
"""Least rise of photos' rows, to their length, as they are turned about a line by a right angle, by
which their horizon tells how they are turned about it.
"""
FEWEST_MET = 50
"""Fewest such pairs of rays that tell the height of the ground."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Beginnings:
    """Where photos begin in space of which metadata do not tell it, or tell it falsely."""

    centres: Mapping[int, Array]
    """Photo -> (3,) centre in m."""
    yaw_deg: Mapping[int, float]
    """Photo -> heading in degrees."""

    def of(self, photo: int, prior: Prior) -> Prior:
        """The prior of a photo with its beginning."""
        return replace(
            prior,
            map_C=self.centres.get(photo, prior.map_C),
            yaw_deg=self.yaw_deg.get(photo, prior.yaw_deg),
        )


NO_BEGINNINGS = Beginnings(centres={}, yaw_deg={})
"""All photos begin as they report."""


def beginnings(found: Alignment, photos: Sequence[Photo], priors: Sequence[Prior]) -> Beginnings:
    """Headings of compasses that are grossly off, and centres of photos that report their angles
    but no position, by an adjustment: it may be off, but hardly so from one photo to the next.
    """
    off, common = heading_errors(photos, priors, {i: found.poses[i] for i in found.held})
    yaw_deg = {
        i: priors[i].yaw_deg - common[photos[i].camera_key]
        for i in off
        if abs(common[photos[i].camera_key]) > GROSS_DEG
    }
    held = [i for i in found.held if told(priors[i])]
    centres: dict[int, Array] = {}
    C = np.array([found.poses[i].map_C for i in held]).reshape(-1, 3)
    apart = np.array([priors[i].map_C for i in held]).reshape(-1, 3) - C
    for i in found.held:
        if not told(priors[i]) and tells_angles(priors[i]):
            centres[i] = here = found.poses[i].map_C
            if held:
                near = np.argsort(np.linalg.norm(C - here, axis=1))[:NEIGHBOURS]
                centres[i] = here + apart[near].mean(0)
    return Beginnings(centres=centres, yaw_deg=yaw_deg)


def slanting(priors: Sequence[Prior]) -> bool:
    """Whether the survey itself is oblique by what its photos report."""
    return sum(tilted(p) for p in priors) > MOST_OBLIQUE * len(priors)


def aslant(priors: Sequence[Prior]) -> bool:
    """Whether most photos tell where they look, and look aslant, though the survey is no oblique
    one.
    """
    known = [cam_R_map_from_angles(0.0, p.pitch_deg, p.roll_deg) for p in priors if tells_angles(p)]
    half = len(known) > len(priors) / 2
    return half and not slanting(priors) and np.median([*map(tilt_deg, known)]) > ASLANT_DEG


def untold(priors: Sequence[Prior]) -> frozenset[int]:
    """The photos whose metadata do not tell their whole pose."""
    return frozenset(i for i, p in enumerate(priors) if not told(p))


def turned_far(found: Alignment, priors: Sequence[Prior]) -> bool:
    """Whether an adjustment turned most photos far from the vertical, and none reports its tilt."""
    far = sum(tilt_deg(found.poses[i].cam_R_map) > VERTICAL_DEG for i in found.held)
    return not tilts_reported(priors) and far > MOST_OBLIQUE * len(found.held)


def tilt_warnings(
    priors: Sequence[Prior], found: Alignment, most_view_deg: float = 90.0
) -> list[str]:
    """A sentence where an oblique survey was placed without its camera angles, or where oblique
    photos lie around vertical ones. `most_view_deg`: angle from the nadir up to which they are
    drawn.
    """
    if not turned_far(found, priors):
        return _walls(priors, found, most_view_deg)
    if np.isnan(off_positions(found, priors)):
        across = any(np.isfinite(priors[i].map_C[:2]).all() for i in found.held)
        lacking, wanted = ("height", "heights") if across else ("position", "positions")
        return [
            "Most photos look far from straight down at the plane that most of the ground lies"
            f" in, and none reports a {lacking} or camera angles: that plane was taken to be level."
            f" Give {wanted}, camera angles or control points if the ground slopes."
        ]
    return [
        "Most photos look far from straight down, and none reports its camera angles: heights,"
        " scale and tilt of the map rest on positions alone. Compare it with known distances, or"
        " give camera angles or control points."
    ]


def _walls(priors: Sequence[Prior], found: Alignment, most_view_deg: float) -> list[str]:
    tilts = np.array([tilt_deg(found.poses[i].cam_R_map) for i in found.held])
    level = int((tilts < VERTICAL_DEG).sum())
    few = level < LEVEL_SHARE * len(tilts) or level == len(tilts)
    if not slanting(priors) or few or most_view_deg <= FROM_ABOVE_DEG:
        return []
    return [
        f"{len(tilts) - level} of {len(tilts)} photos look aslant: around what the other {level}"
        " show from above, the map shows walls and the sides of trees. --max-view-angle"
        f" {FROM_ABOVE_DEG:.0f} leaves such places out; the photos still support the heights."
    ]


def turned_priors(found: Alignment, priors: Sequence[Prior]) -> list[Prior] | None:
    """What photos without reported tilt are taken to report, where an adjustment turned most
    of them far from the vertical: it was begun, and held, as if all looked down. None otherwise.
    """
    if not turned_far(found, priors) or not np.isfinite(off_positions(found, priors)):
        return None
    return as_found(found, priors)


def as_found(found: Alignment, priors: Sequence[Prior]) -> list[Prior]:
    """Priors of photos that are taken to report the directions that an adjustment found, turned
    as a whole to where photos lie as they report.
    """
    turned, aside = list(priors), turned_aside(found, priors)
    for i in found.held:
        yaw, pitch, roll = angles_from_cam_R_map(found.poses[i].cam_R_map @ aside.T)
        turned[i] = replace(
            priors[i],
            yaw_deg=yaw,
            pitch_deg=pitch,
            roll_deg=roll,
            sigma_yaw_deg=STATED_DEG,
            sigma_tilt_deg=STATED_DEG,
        )
    return turned


def turned_aside(found: Alignment, priors: Sequence[Prior]) -> Array:
    """(3, 3) rotation of an adjustment as a whole by which photos come nearest to the positions
    that they report; where these lie about in a line, which does not tell how all are turned about
    it, the one by which horizons are level.
    """
    held = [i for i in found.held if np.isfinite(priors[i].map_C).all()]
    C = np.array([found.poses[i].map_C for i in held])
    directions = told_directions([priors[i] for i in held])
    if directions == 1:
        return levelled_about_line(C, np.array([found.poses[i].cam_R_map for i in held]))
    if directions == 0:
        return np.eye(3)
    there = np.array([priors[i].map_C for i in held])
    return fit_similarity_3d(C - C.mean(0), there - there.mean(0))[1]


def told_directions(priors: Sequence[Prior]) -> int:
    """In how many directions positions spread clearly further than they err: 2 over an area, 1
    along a line, 0 about one place, or of too few.
    """
    if len(priors) < FEWEST_CROWDED:
        return 0
    there = np.array([p.map_C for p in priors])
    spread = np.linalg.svd(there - there.mean(0), compute_uv=False)[:2] / np.sqrt(len(priors))
    return int((spread > WIDE * float(np.median([p.sigma_C[0] for p in priors]))).sum())


def levelled_about_line(C: Array, cam_R_map: Array) -> Array:
    """(3, 3) rotation about the line of centres (n, 3) by which the horizons of photos with these
    rotations (n, 3, 3) are level, as gimbals hold them; none where their rows lie along it, so that
    it would not tilt these.
    """
    axis = np.linalg.svd(C - C.mean(0), full_matrices=False)[2][0]
    right = cam_R_map[:, 0]
    rises = np.array([right[:, 2], np.cross(axis, right)[:, 2]])
    if not (rises[1] ** 2).mean() > ACROSS**2:
        return np.eye(3)
    cosine, sine = np.linalg.eigh(rises @ rises.T)[1][:, 0].tolist()
    angle = float(np.arctan2(sine * np.sign(cosine), abs(cosine)))
    return np.asarray(rotation_from_vector(angle * axis), np.float64)


def off_positions(found: Alignment, priors: Sequence[Prior]) -> float:
    """Median distance in m of the held photos from where they report to be; NaN if none does."""
    away = np.array([np.linalg.norm(found.poses[i].map_C - priors[i].map_C) for i in found.held])
    known = away[np.isfinite(away)]
    return float(np.median(known)) if len(known) else np.nan


def nearer(other: Alignment, found: Alignment, priors: Sequence[Prior]) -> bool:
    """Whether another adjustment's photos lie clearly nearer to their positions, or about as near
    with far more observations, and no fewer of them are held; or whether it holds far more.
    """
    more, less = len(other.held), len(found.held)
    off, before = off_positions(other, priors), off_positions(found, priors)
    fuller = LOST * len(other.ties.photo) > len(found.ties.photo) and LOST * off < before
    return ((off < NEARER * before or fuller) and more >= less) or LOST * more > less


def reported_start(
    photos: Sequence[Photo],
    priors: Sequence[Prior],
    features: Sequence[Features],
    links: Sequence[Link],
    ground_m: float = np.nan,
    begun: Beginnings = NO_BEGINNINGS,
) -> Start | None:
    """The start with linked photos where their metadata put them or, as far as these tell nothing,
    false headings or no position, `begun` does; photos whose pose is not known are left out. Where
    the rays of these do not tell the height of the ground, since they are few or all were taken
    from one place, it is taken for `ground_m`; None if that is not known either.
    """
    priors = [begun.of(i, p) for i, p in enumerate(priors)]
    links = tuple(k for k in links if told(priors[k.a]) and told(priors[k.b]))
    plane = [plane_link(k, photos, features) for k in links]
    groups = [g.tolist() for g in components(len(photos), plane) if len(g) > 1]
    members = sorted(i for g in groups for i in g)
    meetings = _meetings(photos, priors, features, links)
    if not members:
        return None
    seen = float(np.median(meetings)) if len(meetings) >= FEWEST_MET else np.nan
    few = sum(map(len, links)) < 2 * FEWEST_MET
    if np.isnan(seen) and (few or within_noise([priors[i] for i in members])):
        seen = ground_m
    if np.isnan(seen):
        return None
    lowest = min(priors[i].map_C[2] for i in members)
    ground = min(seen, lowest - 1.0)
    placed = {}
    for i in members:
        x, y, z = priors[i].map_C.tolist()
        turn = np.exp(-1j * np.radians(priors[i].yaw_deg))
        placed[i] = complex((z - ground) * turn), complex(x, y)
    return Start(
        placed=placed,
        blocks=tuple(map(tuple, groups)),
        links=links,
        sigma_xy={},
        georeferenced=frozenset(members),
        metric=True,
        in_space=True,
    )


def within_noise(priors: Sequence[Prior]) -> bool:
    """Whether positions lie as close to one another as their errors alone would have them."""
    known = [p for p in priors if np.isfinite(p.map_C[0])]
    if len(known) < FEWEST_CROWDED:
        return False
    reach = reach_of(np.array([p.map_C[:2] for p in known]))
    return reach < CROWDED * float(np.median([p.sigma_C[0] for p in known]))


def reach_of(xy: Array) -> float:
    """Median distance of places (n, 2) from their middle; NaN without any."""
    xy = xy[np.isfinite(xy).all(1)]
    if not len(xy):
        return np.nan
    return float(np.median(np.linalg.norm(xy - np.median(xy, axis=0), axis=1)))


def _meetings(
    photos: Sequence[Photo],
    priors: Sequence[Prior],
    features: Sequence[Features],
    links: Sequence[Link],
) -> Array:
    """Heights in m where the rays of matched keypoints meet, if they do in front of both photos."""
    found = [np.zeros(0)]
    for k in links:
        rays = [
            map_rays(photos[i], priors[i], features[i].px[index])
            for i, index in ((k.a, k.index_a), (k.b, k.index_b))
        ]
        count = len(k)
        point = np.tile(np.arange(count), 2)
        C = np.repeat([priors[k.a].map_C, priors[k.b].map_C], count, axis=0)
        X = intersect(point, C, np.concatenate(rays), count)
        ahead = np.ones(count, np.bool_)
        for i, ray in zip((k.a, k.b), rays, strict=True):
            ahead &= ((X - priors[i].map_C) * ray).sum(1) > 0
        sine = np.linalg.norm(np.cross(rays[0], rays[1]), axis=1)
        found.append(X[ahead & (sine > APART), 2])
    return np.concatenate(found)


def map_rays(photo: Photo, prior: Prior, px: NDArray[np.floating]) -> Array:
    """(n, 3) unit vectors in the map frame to keypoints (n, 2) of a photo that looks as it reports,
    the lens's distortion neglected.
    """
    middle = np.array([photo.width - 1, photo.height - 1]) / 2
    local = np.column_stack(
        [(as_pinhole(photo.lens, px) - middle) / photo.lens.focal, np.ones(len(px))]
    )
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    return local @ cam_R_map_from_angles(prior.yaw_deg, prior.pitch_deg, prior.roll_deg)
