"""The start of an adjustment: every linked photo is a similarity of the ground plane, in m of the
map frame; and how far it lets headings be believed.

Headings of one aircraft have errors in common: a compass that is off, or a gimbal that counts from
elsewhere, turns all of them by one angle. Taken each by itself, as many of them as there are photos
would turn the map.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.similarity_graph import (
    PlaneLink,
    PlaneSolution,
    against_positions,
    consistent_blocks,
    fit_similarity,
    tie_to_positions,
)
from skyquilt.geometry.frames import angle_difference_deg, angles_from_cam_R_map
from skyquilt.matching.lens_kind import as_pinhole
from skyquilt.model.features import Features, Link
from skyquilt.model.photo import Photo
from skyquilt.model.poses import MapFrame, Pose, Prior

OWN_ZERO = ("takeoff", "unknown", "control")
"""Datums in which the ground that heights are counted from lies at zero."""
NOMINAL_HEIGHT_M = 50.0
"""Height above ground in m assumed if no data determine the scale; the result is then marked as not
metric.
"""
LEAST_BASE = 0.1
"""Photos whose places in the pictures lie closer than so many deviations of their positions tell no
scale and no direction.
"""
LOOSE_RAD = 0.15
"""Positions that tell the direction no better than this do not tell it where headings are reported,
nor, as badly, the scale where heights above ground are known;
"""
SCATTER = 10.0
"""unless they lie further apart than so many deviations: then they are no errors of a receiver.
"""

NARROW = 1.6
"""A guessed focal length that is shorter than heights tell by more than this factor is wrong."""
LEAST_FOCAL_M = 10.0
"""Heights above ground of less do not tell it: take-off lies elsewhere by some metres,"""
FEWEST_FOCAL, FOCAL_SPREAD, FOCAL_SCALE = 5, 0.15, 0.2
"""nor do fewer photos, nor some that differ by more than this share (median), nor positions that
leave the scale less certain than this share.
"""
FOCAL_SHARE, DOUBTED_SHARE = 0.2, 0.25
"""Deviation of a focal length that heights tell, as a share of it: ground is uneven; least one of
another than files tell.
"""
GROSS_DEG = 20.0
"""A heading that is off by more is false."""
UNKNOWN_YAW_DEG = 90.0
"""Deviation of a heading that is not known; that of the start stands for it."""
LOOSEST_DEG = 20.0
"""Deviation of a heading at most, where many share one error."""
ALIKE_DEG = 20.0
"""Headings are off by one angle if most of them are off by about as much."""
FOCAL_NOTE = (
    "No file tells the focal length of {0}: heights above take-off and the ground between positions"
    " tell about {1:.0f} px, and heights of the map are as good as that."
)
OFF = 5.0
"""Weak links that contradict positions are left out where positions scatter by so many times their
deviations with them, but not without: ground that repeats.
"""
FEWEST_HEADINGS = 3
"""Fewer headings do not tell what they have in common."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """Approximate values for the adjustment."""

    placed: dict[int, tuple[complex, complex]]
    """Photo -> (a, t) of x + iy = a p + t, in m."""
    blocks: tuple[tuple[int, ...], ...]
    """Connected groups of two or more photos."""
    links: tuple[Link, ...]
    """Links that agree with the blocks."""
    sigma_xy: dict[int, float]
    """Photo -> standard deviation of its measured position in m as estimated from its block, where
    larger than stated.
    """
    georeferenced: frozenset[int]
    """Photos of blocks that positions placed."""
    metric: bool
    """False if the scale had to be assumed."""
    in_space: bool = False
    """Photos begin with the poses that they report; otherwise they look straight down."""


def plane_link(link: Link, photos: Sequence[Photo], features: Sequence[Features]) -> PlaneLink:
    """The link in image coordinates over the focal length, y up."""

    def mean(photo: Photo, px: NDArray[Any]) -> complex:
        x, y = as_pinhole(photo.lens, px).mean(0)
        return complex(x - (photo.width - 1) / 2, -(y - (photo.height - 1) / 2)) / photo.lens.focal

    a, b = photos[link.a], photos[link.b]
    return PlaneLink(
        a=link.a,
        b=link.b,
        b_S_a=link.b_S_a * a.lens.focal / b.lens.focal,
        p_a=mean(a, features[link.a].px[link.index_a]),
        p_b=mean(b, features[link.b].px[link.index_b]),
        weight=min(float(len(link)), 300.0),
    )


def find_start(
    photos: Sequence[Photo],
    priors: Sequence[Prior],
    features: Sequence[Features],
    links: Sequence[Link],
    ground_m: float = 0.0,
) -> Start:
    """Solves every block, removes links that contradict it, or positions as a whole, and
    georeferences it by these. `ground_m`: height of the take-off point in the map's frame,
    NaN = not known.
    """
    plane = {(k.a, k.b): plane_link(k, photos, features) for k in links}
    start = _start(plane, priors, links, ground_m)
    usual = np.array([p.sigma_C[0] for p in priors])
    if _fits(start, usual):
        return start
    position = np.array([p.map_C[:2] @ (1, 1j) for p in priors])
    against = {(k.a, k.b) for k in against_positions(list(plane.values()), position, usual)}
    if not against:
        return start
    rest = {key: link for key, link in plane.items() if key not in against}
    other = _start(rest, priors, links, ground_m)
    return other if _fits(other, usual) else start


def _fits(start: Start, sigma: NDArray[np.float64]) -> bool:
    """Whether positions of these deviations (n,) scatter by no more than `OFF` times as much."""
    return all(off <= OFF * sigma[i] for i, off in start.sigma_xy.items())


def _start(
    plane: dict[tuple[int, int], PlaneLink],
    priors: Sequence[Prior],
    links: Sequence[Link],
    ground_m: float,
) -> Start:
    """`find_start` with links given in the plane as well."""
    solutions, kept = consistent_blocks(len(priors), plane)
    placed: dict[int, tuple[complex, complex]] = {}
    sigma_xy: dict[int, float] = {}
    georeferenced: set[int] = set()
    metric = True
    for solution in solutions:
        members = set(solution.members.tolist())
        inner = [plane[key] for key in kept if key[0] in members]
        solution, spread, scaled = georeference(
            solution, inner, [priors[m] for m in solution.members], ground_m
        )
        metric &= scaled
        for m, a, t in zip(solution.members.tolist(), solution.a, solution.t, strict=True):
            placed[m] = (complex(a), complex(t))
            if np.isfinite(spread):
                georeferenced.add(m)
                sigma_xy[m] = spread
    return Start(
        placed=placed,
        blocks=tuple(tuple(s.members.tolist()) for s in solutions),
        links=tuple(k for k in links if (k.a, k.b) in kept),
        sigma_xy=sigma_xy,
        georeferenced=frozenset(georeferenced),
        metric=metric,
    )


def focals_by_heights(
    photos: Sequence[Photo], priors: Sequence[Prior], start: Start, ground_m: float
) -> tuple[Sequence[Photo], Start, tuple[str, ...]]:
    """Photos of cameras whose focal length is a guess that is far too short, with the one that
    heights above take-off and the ground between positions tell; the start with these, and notes.

    Photos that look straight down fit a short lens near the ground as well as a long one high
    above it: the adjustment would stay near the guess. `ground_m`: see `find_start`.
    """
    sized: dict[str, list[float]] = {}
    for block in start.blocks if start.metric and not start.in_space else ():
        if not _scaled(block, priors, start):
            continue
        for i in block:
            own, height = photos[i], priors[i].map_C[2] - ground_m
            if own.lens_guessed and height > LEAST_FOCAL_M:
                sized.setdefault(own.camera_key, []).append(height / abs(start.placed[i][0]))
    factors: dict[str, float] = {}
    for camera, found in sized.items():
        factor = float(np.median(found))
        spread = float(np.median(np.abs(np.array(found) / factor - 1)))
        if len(found) >= FEWEST_FOCAL and factor > NARROW and spread < FOCAL_SPREAD:
            factors[camera] = factor
    if not factors:
        return photos, start, ()
    told = with_focals(photos, factors, FOCAL_SHARE)
    placed = {
        i: (a * factors.get(photos[i].camera_key, 1.0), t) for i, (a, t) in start.placed.items()
    }
    px = {p.camera_key: p.focal.px for p in told}
    said = tuple(FOCAL_NOTE.format(camera, px[camera]) for camera in factors)
    return told, replace(start, placed=placed), said


def with_focals(
    photos: Sequence[Photo], factors: Mapping[str, float], share: float | None = None
) -> list[Photo]:
    """The photos, focal lengths of some cameras (names) times a factor, with a deviation of this
    share of them; None: of the share that they had, or of a guess where they are not believed.
    """
    out = list(photos)
    for i, photo in enumerate(photos):
        if (factor := factors.get(photo.camera_key)) is not None:
            px = photo.focal.px * factor
            own = photo.focal.sigma_px / photo.focal.px
            sigma = (max(own, DOUBTED_SHARE) if share is None else share) * px
            out[i] = replace(photo, focal=replace(photo.focal, px=px, sigma_px=sigma))
    return out


def _scaled(block: Sequence[int], priors: Sequence[Prior], start: Start) -> bool:
    """Whether positions tell the scale of a block to `FOCAL_SCALE`, by how far they lie from where
    the start put the photos.
    """
    own = [i for i in block if np.isfinite(priors[i].map_C[:2]).all()]
    if len(own) < FEWEST_FOCAL:
        return False
    there = np.array([start.placed[i][1] for i in own])
    told = np.array([priors[i].map_C[:2] @ (1, 1j) for i in own])
    off = np.abs(told - there)
    wide = np.abs(there - there.mean())
    return bool(np.sqrt((off**2).mean() / len(own)) < FOCAL_SCALE * np.sqrt((wide**2).mean()))


def georeference(
    solution: PlaneSolution,
    links: Sequence[PlaneLink],
    priors: Sequence[Prior],
    ground_m: float = 0.0,
) -> tuple[PlaneSolution, float, bool]:
    """The block in map metres, the scatter of its positions in m (NaN without positions), and
    whether its scale is known. `ground_m`: see `find_start`.
    """
    position = np.array([complex(p.map_C[0], p.map_C[1]) for p in priors])
    sigma = np.array([p.sigma_C[0] for p in priors])
    known = np.isfinite(position)
    if not known.any():
        turn = _turn(solution.a, priors)
        height, metric = _scale_by_height(solution.a, priors, ground_m)
        scaled = replace(solution, a=solution.a * height * turn, t=solution.t * height * turn)
        return scaled, np.nan, metric
    where = position[known]
    spread = float(np.abs(where - where.mean()).max()) if known.sum() > 1 else 0.0
    usual = float(np.median(sigma[known]))
    shown = np.ptp(solution.t[known].view(float).reshape(-1, 2), axis=0).max()
    height, metric = _scale_by_height(solution.a, priors, ground_m)
    shown *= height
    apart = height * np.abs(solution.t[known] - solution.t[known].mean())
    headed = any(np.isfinite(p.yaw_deg) for p in priors)
    loose = headed and float((apart**2).sum()) < (usual / LOOSE_RAD) ** 2
    loose &= spread < SCATTER * usual + float(apart.max())
    turn = _turn(solution.a, priors) if headed else 1 + 0j
    if (
        known.sum() >= 2
        and spread > 3 * usual
        and shown > LEAST_BASE * usual
        and not (loose and metric)
    ):
        told = turn if loose else None
        g, c, scatter = fit_similarity(solution.t[known], where, sigma[known], turn=told)
        metric = True
    else:
        g = height * turn
        c, scatter = complex(np.mean(where - g * solution.t[known])), 0.0
    placed = replace(solution, a=solution.a * g, t=solution.t * g + c)
    far = np.maximum(np.where(known, sigma, 1e5), scatter)
    return tie_to_positions(placed, links, position, far), scatter, metric


def _turn(a: NDArray[np.complex128], priors: Sequence[Prior]) -> complex:
    """The rotation from the block's yaws to the reported ones, by majority; 1 if none is
    reported.
    """
    yaw = np.radians([p.yaw_deg for p in priors])
    known = np.isfinite(yaw)
    if not known.any():
        return 1 + 0j
    unit = np.exp(-1j * yaw[known]) / (a[known] / np.abs(a[known]))
    votes = [int((np.abs(unit - u) < 0.35).sum()) for u in unit]
    chosen = unit[np.abs(unit - unit[int(np.argmax(votes))]) < 0.35].mean()
    return complex(chosen / abs(chosen))


def ground_of(frame: MapFrame) -> float:
    """Height of the take-off point in a frame in m; NaN where nothing tells it."""
    if frame.vertical_datum in OWN_ZERO:
        return 0.0
    return np.nan if frame.takeoff_m is None else frame.takeoff_m


def _scale_by_height(
    a: NDArray[np.complex128], priors: Sequence[Prior], ground_m: float
) -> tuple[float, bool]:
    """Metres per block unit from heights above take-off, taken as heights above ground; otherwise
    from a nominal height.
    """
    height = np.array([p.map_C[2] for p in priors]) - ground_m
    ratio = (height / np.abs(a))[np.isfinite(height) & (height > 1)]
    if len(ratio):
        return float(np.median(ratio)), True
    return NOMINAL_HEIGHT_M / float(np.median(np.abs(a))), False


def steered(
    photos: Sequence[Photo], priors: Sequence[Prior], start: Start, yaw_deg: Mapping[int, float]
) -> list[Prior]:
    """The priors, their headings such that all those of one camera and block together count as one
    in the direction of the block, as far as positions tell that better: their errors are common.
    A gross common error from the start's direction (`yaw_deg` of each photo) is taken away, and
    with it what they tell of the direction.
    """
    out = list(priors)
    for block in start.blocks:
        told = [m for m in block if m in start.georeferenced]
        loose = _direction_deg(
            np.array([priors[m].map_C[:2] for m in told]).reshape(-1, 2),
            np.array([priors[m].sigma_C[0] for m in told]),
        )
        for key in dict.fromkeys(photos[m].camera_key for m in block):
            own = [m for m in block if photos[m].camera_key == key]
            headed = [m for m in own if np.isfinite(priors[m].yaw_deg)]
            off = [angle_difference_deg(priors[m].yaw_deg, yaw_deg[m]) for m in headed]
            common = common_error_deg(np.array(off), [photos[m].editor is None for m in headed])
            gross = abs(common) > GROSS_DEG
            for m in headed:
                told_deg = priors[m].sigma_yaw_deg
                share = max(0.0, 1 - (loose / told_deg) ** 2)
                looser = told_deg * np.sqrt(1 + share * (len(headed) - 1))
                sigma_deg = UNKNOWN_YAW_DEG if gross else min(looser, LOOSEST_DEG)
                out[m] = replace(
                    priors[m],
                    yaw_deg=priors[m].yaw_deg - (common if gross else 0.0),
                    sigma_yaw_deg=float(max(told_deg, sigma_deg)),
                )
    return out


def heading_errors(
    photos: Sequence[Photo], priors: Sequence[Prior], found: Mapping[int, Pose]
) -> tuple[dict[int, float], dict[str, float]]:
    """Reported minus found heading in degrees of each of some photos that reports one, and what
    those of each camera have in common.
    """
    off = {
        i: angle_difference_deg(priors[i].yaw_deg, angles_from_cam_R_map(pose.cam_R_map)[0])
        for i, pose in found.items()
        if np.isfinite(priors[i].yaw_deg)
    }
    cameras: dict[str, list[int]] = {}
    for i in off:
        cameras.setdefault(photos[i].camera_key, []).append(i)
    return off, {
        key: common_error_deg(
            np.array([off[i] for i in own]), [photos[i].editor is None for i in own]
        )
        for key, own in cameras.items()
    }


def common_error_deg(off_deg: NDArray[np.float64], whole: Sequence[bool]) -> float:
    """The angle in degrees by which most of some headings are off; 0 where they are not off alike.

    `off_deg` (n,): reported minus estimated. `whole`: whether each file is as its camera wrote it;
    files that programs rewrote may be turned, so they count only where there are no others, and
    then a half turn is not the compass's.
    """
    own = off_deg[np.array(whole, bool)]
    off = own if len(own) >= FEWEST_HEADINGS else off_deg
    if len(off) < FEWEST_HEADINGS:
        return 0.0
    angle = common_angle_deg(off, ALIKE_DEG)
    if angle is None:
        return 0.0
    return 0.0 if off is off_deg and not all(whole) and abs(angle) > 180 - ALIKE_DEG else angle


def common_angle_deg(off_deg: NDArray[np.float64], alike_deg: float) -> float | None:
    """The angle in degrees that more than half of some (n,) share within `alike_deg`, as their
    median; None where they do not agree. Not empty.
    """
    near = np.abs(angle_difference_deg(off_deg[:, None], off_deg)) < alike_deg
    best = int(np.argmax(near.sum(1)))
    if 2 * near[best].sum() <= len(off_deg):
        return None
    about = angle_difference_deg(off_deg[near[best]], off_deg[best])
    return float(angle_difference_deg(float(off_deg[best]), -float(np.median(about))))


def _direction_deg(C: NDArray[np.float64], sigma_m: NDArray[np.float64]) -> float:
    """Deviation in degrees of the direction that positions C (n, 2) in m of deviations (n,) tell;
    those that are not known are NaN.
    """
    known = np.isfinite(C).all(1)
    if not known.any():
        return np.inf
    weight = sigma_m[known] ** -2
    reach = C[known] - np.average(C[known], axis=0, weights=weight)
    tells = float((weight * (reach**2).sum(1)).sum())
    return float(np.degrees(1 / np.sqrt(max(tells, 1e-12))))
