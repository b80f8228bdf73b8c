"""Oblique photos among vertical ones: they are kept out of the block and hung on it afterwards.

The start of an adjustment takes every photo for a similarity of the ground plane, and a link of an
oblique photo with a vertical one is a similarity in a small part of both only: such photos would
bend the block. They are placed by resection on its tie points instead: three points and a check by
all others (Fischler and Bolles 1981), refined by least squares, the block held.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.determined import STATED_DEG, least_covered, why_weak, without
from skyquilt.alignment.kept_matches import tie_points_at
from skyquilt.geometry.camera import project, undistort
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.geometry.neighbours import nearest
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Pose, Prior, TiePoints

Array = NDArray[np.float64]
OBLIQUE_DEG = 35.0
"""Photos tilted by more than this from the vertical are oblique."""
MOST_OBLIQUE = 0.4
"""With a larger share of oblique photos than this the survey itself is oblique, and they are not
told apart.
"""
FAR_OFF, TURNED_DEG = 8.0, 10.0
"""A photo so many deviations from its position, and turned so far from its angles, is elsewhere."""
ELSEWHERE = 0.1
"""And so far from its position, as a share of its height above the ground: compasses and fixes of
RTK that are lost do not move a photo as far.
"""
MOST_KEPT, FEW_KEPT = 0.8, 0.62
"""Photos that keep a larger share of their matches lie where they belong, however they look; with
less than the second they lie elsewhere. Of 99 right ones of five surveys by hand, from a kite and
from drones one keeps 0.58 and the others 0.66 or more, of two wrong ones the most 0.53.
"""
LEAST_FALL = np.cos(np.radians(60.0))
"""Flatter views count as if they fell as steeply as this: what they show best lies nearer than the
place in their middle.
"""
SAME_POINT = 0.005
"""Points nearer to a tie point than this share of the flying height are that point; others are none
any more, too uncertain for the ground.
"""
FEWEST = 12
"""Fewest tie points that must agree on the pose of a photo."""
AGREE_PX = 4.0
"""Largest residual of such a point, in px of the image searched for features."""


def tilt_deg(cam_R_map: Array) -> float:
    """Angle of a photo's axis from the vertical, in degrees."""
    return float(np.degrees(np.arccos(np.clip(-cam_R_map[2, 2], -1, 1))))


def reported_oblique(priors: Sequence[Prior]) -> frozenset[int]:
    """Photos whose metadata report a large tilt; none if most of them do."""
    found = [i for i, p in enumerate(priors) if tilted(p)]
    return frozenset(found if len(found) <= MOST_OBLIQUE * len(priors) else ())


def tilted(prior: Prior) -> bool:
    """Whether a photo's metadata report a large tilt."""
    R = cam_R_map_from_angles(0.0, prior.pitch_deg, prior.roll_deg)
    return prior.sigma_tilt_deg <= STATED_DEG and tilt_deg(R) > OBLIQUE_DEG


def told(prior: Prior) -> bool:
    """Whether metadata tell a photo's whole pose."""
    return bool(np.isfinite(prior.map_C).all()) and tells_angles(prior)


def tells_angles(prior: Prior) -> bool:
    """Whether metadata tell a photo's attitude."""
    return bool(np.isfinite(prior.yaw_deg)) and prior.sigma_tilt_deg <= STATED_DEG


def told_tilt(prior: Prior, yaw_deg: float) -> Array:
    """The attitude (map to camera) of a photo with this heading and the tilt that its metadata
    report; straight down where they report none.
    """
    if prior.sigma_tilt_deg > STATED_DEG:
        return cam_R_map_from_angles(yaw_deg)
    return cam_R_map_from_angles(yaw_deg, prior.pitch_deg, prior.roll_deg)


def looked_at(priors: Sequence[Prior], ground_m: float) -> Array | None:
    """Places (n, 4) by which photos that may show the same are near to one another, where some
    report that they are oblique; None where none does. In m: where each looks at level ground of
    the height `ground_m` (its position, NaN where unknown, if it does not tell its view), and the
    horizontal part of its direction, as long for a level view as photos usually lie above ground.

    Photos of five cameras on one drone are near to one another by their positions, but have nothing
    in common; those that look at one place from one side match.
    """
    C = np.array([p.map_C for p in priors]).reshape(-1, 3)
    above = C[:, 2] - ground_m
    if not any(map(tilted, priors)) or not (above > 0).any():
        return None
    usual = float(np.median(above[above > 0]))
    places = np.zeros((len(priors), 4))
    places[:, :2] = C[:, :2]
    for i, prior in enumerate(priors):
        if tells_angles(prior):
            R = cam_R_map_from_angles(prior.yaw_deg, prior.pitch_deg, prior.roll_deg)
            away = R[2, :2] / max(-R[2, 2], LEAST_FALL)
            places[i, :2] += away * (above[i] if above[i] > 0 else usual)
            places[i, 2:] = R[2, :2] * usual
    return places


def tilts_reported(priors: Sequence[Prior]) -> bool:
    """Whether any photo reports its tilt."""
    return any(p.sigma_tilt_deg <= STATED_DEG for p in priors)


def found_oblique(
    alignment: Alignment,
    weak: Mapping[int, str],
    priors: Sequence[Prior],
    kept: Mapping[int, float],
    part: NDArray[np.integer[Any]],
) -> frozenset[int]:
    """Photos without reported tilt that the adjustment turned far from the vertical with a loss of
    matches, that lost many, or that it could not hold; besides, those that it turned and moved far
    from what they report with such a loss: without one, they report falsely. None if most are.
    `weak`: those that are not determined; `kept`: shares of the held photos' matches
    (`kept_matches`), not needed where all report their tilt and none is moved so; `part`: numbers
    of the parts (per photo) that links connect, of which one without held photos has nothing that
    it could be placed by.
    """
    linked = [*alignment.held, *alignment.rejected]
    found = {i for i in kept if kept[i] < FEW_KEPT}
    found |= {
        i
        for i in kept
        if kept[i] < MOST_KEPT and tilt_deg(alignment.poses[i].cam_R_map) > OBLIQUE_DEG
    }
    found |= alignment.rejected.keys() | weak.keys()
    found &= set(np.flatnonzero(np.isin(part, part[list(alignment.held)])).tolist())
    guessed = {i for i in found if priors[i].sigma_tilt_deg > STATED_DEG}
    guessed |= {i for i in contradicting(alignment, priors) if kept[i] < MOST_KEPT}
    return frozenset(guessed if len(guessed) <= MOST_OBLIQUE * len(linked) else ())


def contradicting(alignment: Alignment, priors: Sequence[Prior]) -> frozenset[int]:
    """Held photos that look and lie far from where they report."""
    return frozenset(i for i in alignment.held if _contradicts(alignment.poses[i], priors[i]))


def hung(
    alignment: Alignment,
    weak: Mapping[int, str],
    photos: Sequence[Photo],
    priors: Sequence[Prior],
    features: Sequence[Features],
    links: Sequence[Link],
    aside: frozenset[int],
) -> Alignment:
    """The alignment with the photos kept aside placed by its tie points, the best linked first, and
    without those that hang on it by too little (`weak`, with reasons: `determined.weak_photos`).
    """
    alignment = without_photos(alignment, weak)
    left = set(aside)
    while left:
        counted = {i: _points_of(i, alignment, features, links) for i in sorted(left)}
        best = max(sorted(left), key=lambda i: len(counted[i][0]))
        left.remove(best)
        scale = features[best].scale
        alignment = _placed(alignment, best, photos[best], priors[best], *counted[best], scale)
    return alignment


def without_photos(alignment: Alignment, gone: Mapping[int, str]) -> Alignment:
    """The alignment without some photos and their observations; `gone`: why each is left out."""
    if not gone:
        return alignment
    ties, told = without(alignment.ties, gone), alignment.accuracy
    if told is not None and len(alignment.ties.xyz):  # of the ground that others show
        before = alignment.ties
        others = before.point[~np.isin(before.photo, list(gone))]
        away, at = nearest(before.xyz, told.xyz, 1)
        stays = (np.bincount(others, minlength=len(before.xyz)) >= 2)[at[:, 0]]
        above = np.median([p.map_C[2] for p in alignment.poses.values()]) - alignment.ground_m
        stays &= away[:, 0] < SAME_POINT * max(float(above), 1.0)
        told = replace(told, xyz=told.xyz[stays], sigma_m=told.sigma_m[stays])
    return replace(
        alignment,
        poses={i: p for i, p in alignment.poses.items() if i not in gone},
        blocks=tuple(
            b for old in alignment.blocks if (b := tuple(i for i in old if i not in gone))
        ),
        ties=ties,
        accuracy=told,
        rejected={**alignment.rejected, **gone},
    )


def _contradicts(pose: Pose, prior: Prior) -> bool:
    """Whether a photo looks and lies far from where it reports: begun as a vertical one, it may
    have fallen into another minimum than that of the photos around.
    """
    if not told(prior):
        return False
    away = np.linalg.norm((pose.map_C - prior.map_C) / prior.sigma_C)
    return bool(away > FAR_OFF and turned_deg(pose, prior) > TURNED_DEG)


def turned_deg(pose: Pose, prior: Prior) -> float:
    """Angle in degrees between where a photo looks and where it reports to look; 0 where it does
    not report its attitude.
    """
    if not tells_angles(prior):
        return 0.0
    reported = cam_R_map_from_angles(prior.yaw_deg, prior.pitch_deg, prior.roll_deg)
    return axes_apart_deg(pose.cam_R_map, reported)


def axes_apart_deg(a: Array, b: Array) -> float:
    """Angle in degrees between where cameras of two attitudes (3, 3, map to camera) look."""
    return float(np.degrees(np.arccos(np.clip(a[2] @ b[2], -1, 1))))


def _points_of(
    photo: int, alignment: Alignment, features: Sequence[Features], links: Sequence[Link]
) -> tuple[NDArray[np.int64], Array]:
    """Tie points that a photo's links show it, each once, and their pixels (n, 2) in it."""
    ties, found = alignment.ties, dict[int, Array]()
    for link in links:
        if photo not in (link.a, link.b):
            continue
        mine, theirs, other = (
            (link.index_a, link.index_b, link.b)
            if link.a == photo
            else (link.index_b, link.index_a, link.a)
        )
        points = tie_points_at(ties, other, features[other].px[theirs], features[other].scale)
        for k in np.flatnonzero(points >= 0):
            found.setdefault(int(points[k]), features[photo].px[mine[k]])
    return np.array(list(found), np.int64), np.array(list(found.values())).reshape(-1, 2)


def _placed(
    alignment: Alignment,
    photo: int,
    about: Photo,
    prior: Prior,
    point: NDArray[np.int64],
    px: Array,
    scale: float,
) -> Alignment:
    """The alignment with one more photo, or with the reason why it is left out."""
    if not len(point):
        why = "no tie point connects it with photos that are placed"
        return replace(alignment, rejected=alignment.rejected | {photo: why})
    camera = alignment.cameras.get(about.camera_key, about.lens)
    xyz = alignment.ties.xyz[point]
    pose, good = resected(camera, xyz, px, AGREE_PX * scale)
    if pose is None:
        why = (
            f"it hangs on the other photos by too little: {int(good.sum())} of {len(px)} tie points"
            f" agree on its place ({FEWEST} are needed)"
        )
        return replace(alignment, rejected=alignment.rejected | {photo: why})
    error = project(camera, pose.to_camera(xyz)) - px
    least = least_covered(prior, pose)
    why = why_weak(pose, camera, xyz[good], px[good], error[good], None, least=least)
    why = why or _why_elsewhere(pose, prior, alignment.ground_m)
    if why:
        return replace(alignment, rejected=alignment.rejected | {photo: why})
    key = about.camera_key
    block = int(
        np.bincount(
            [
                next(n for n, b in enumerate(alignment.blocks) if i in b)
                for i in alignment.ties.photo[np.isin(alignment.ties.point, point[good])]
            ]
        ).argmax()
    )
    blocks = list(alignment.blocks)
    blocks[block] = (*blocks[block], photo)
    return replace(
        alignment,
        poses=alignment.poses | {photo: pose},
        cameras=alignment.cameras | {key: camera},
        camera_of=alignment.camera_of | {photo: key},
        blocks=tuple(blocks),
        ties=_with_observations(alignment.ties, photo, point[good], px[good], error[good]),
        rejected={i: w for i, w in alignment.rejected.items() if i != photo},
    )


def _why_elsewhere(pose: Pose, prior: Prior, ground_m: float) -> str:
    """Why a photo that reports to be oblique is not where tie points put it; empty where it may be:
    ground that looks alike elsewhere puts it far from where it reports to lie and to look.
    """
    if not tilted(prior) or not _contradicts(pose, prior):
        return ""
    away = float(np.linalg.norm(pose.map_C - prior.map_C))
    if away < ELSEWHERE * (pose.map_C[2] - ground_m):
        return ""
    return (
        f"its tie points would put it {away:.0f} m from its position and turn it by"
        f" {turned_deg(pose, prior):.0f} degrees from what it reports"
    )


def _with_observations(
    ties: TiePoints, photo: int, point: NDArray[np.int64], px: Array, error: Array
) -> TiePoints:
    points = np.concatenate([ties.point, point])
    order = np.argsort(points, kind="stable")
    photos = np.concatenate([ties.photo, np.full(len(point), photo)])
    return replace(
        ties,
        point=points[order],
        photo=photos[order],
        px=np.concatenate([ties.px, px])[order],
        residual_px=np.concatenate([ties.residual_px, error])[order],
    )


def resected(
    camera: Camera, xyz: Array, px: Array, tolerance_px: float
) -> tuple[Pose | None, NDArray[np.bool_]]:
    """The pose of a photo from points (n, 3) in m and their pixels (n, 2), and which of them agree
    with it; None if too few do.
    """
    good = np.zeros(len(px), np.bool_)
    if len(px) < FEWEST:
        return None, good
    middle, flat = xyz.mean(0), undistort(camera, px)
    cv2.setRNGSeed(0)
    found, turn, shift, inliers = cv2.solvePnPRansac(
        (xyz - middle)[:, None],
        flat[:, None],
        np.eye(3),
        None,
        iterationsCount=3000,
        reprojectionError=tolerance_px / camera.focal,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None:
        return None, good
    for _ in range(3):
        good = np.zeros(len(px), np.bool_) if inliers is None else good
        good[inliers.ravel()] = True
        if good.sum() < FEWEST:
            return None, good
        turn, shift = cv2.solvePnPRefineLM(
            (xyz - middle)[good][:, None], flat[good][:, None], np.eye(3), None, turn, shift
        )
        R = np.asarray(cv2.Rodrigues(turn)[0], np.float64)
        pose = Pose(cam_R_map=R, map_C=middle - R.T @ shift.ravel())
        error = np.linalg.norm(project(camera, pose.to_camera(xyz)) - px, axis=1)
        now = np.flatnonzero(error < tolerance_px)
        good = np.zeros(len(px), np.bool_)
        inliers = now
    good[inliers] = True
    if good.sum() < FEWEST or pose.map_C[2] < np.median(xyz[good, 2]):
        return None, good
    return pose, good
