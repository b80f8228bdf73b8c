"""How well a photo's observations determine its pose: photos that hang on a block by too little."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.deviations import MATCHED
from skyquilt.alignment.least_squares_matching import LeastSquaresMatching
from skyquilt.alignment.setup import INDEPENDENT
from skyquilt.geometry.camera import project_with_derivatives, rays
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Alignment, Pose, Prior, TiePoints

Array = NDArray[np.float64]
FEWEST = 8
"""Fewest tie points of a photo in the map."""
LOOSEST = 0.007
"""Largest deviation of a photo's picture on the ground, as a share of its longer side, where tie
points alone determine it.
"""
LOOSEST_TOLD = 0.02
"""The same where its position and its heading are reported: that of a usual drone's metadata."""
LEAST_COVERED = 0.04
"""Least share of the picture that such tie points cover; smaller groups of wrong matches agree by
chance.
"""
LEAST_UNTOLD = 0.08
"""The same for photos that do not report their tilt: a small piece of level ground looks the same
from two directions, and deviations say nothing of the other one. Both are nearly the same for a
photo that is found to look straight down, and one that lies elsewhere contradicts its position.
"""
LEVEL = np.cos(np.radians(10.0))
"""Photos that look straight down to within this (cosine of the tilt)."""
STATED_DEG = 5.0
"""Tilts with a larger standard deviation than this are guesses, not reports."""
FEWEST_PLACED, EXTENDED, AGREEING = 5, 6.0, 2.5
"""Photos whose positions place a group that hangs on the rest by too little; how many of the
positions' deviations they extend over at least; and by how many (median) they lie off at most,
where the rest lies.
"""
AGAINST, OF_USUAL = 30, 0.4
"""Tie points that are believed against a position that lies elsewhere; or this share of what photos
of the block usually have. Fewer are wrong matches between rows of trees or panels that look alike.
"""
ELSEWHERE, ELSEWHERE_HIGH = 6.0, 0.15
"""A position lies elsewhere from so many deviations, and this share of the flying height, on."""
AGAIN = 1.2
"""A photo is looked at again when it has this many times as many points as before."""
GRID = np.stack(np.meshgrid(*2 * [np.linspace(0.02, 0.98, 5)]), -1).reshape(-1, 2)
"""Places in the picture, as shares of its width and height, where the deviation is predicted."""
STEEPEST = np.tan(np.radians(70.0))
"""Places seen flatter than this are left out: they are not shown."""


def weak_photos(alignment: Alignment, priors: Sequence[Prior]) -> dict[int, str]:
    """Connected photos whose pose is not determined by tie points and metadata together, with
    reasons that give the figures.

    Each block grows photo by photo from the one with most tie points: a photo joins by the points
    that photos of the block show already. So photos that are linked with each other, but as a group
    with few others, do not support each other: the largest group is the block, with those groups
    that the positions of their own photos place.
    """
    found: dict[int, str] = {}
    for block in alignment.blocks:
        if len(block) > 1:
            left = _left_out(alignment, block, priors)
            found |= left | _elsewhere(alignment, [i for i in block if i not in left], priors)
    return found


def _elsewhere(
    alignment: Alignment, block: Sequence[int], priors: Sequence[Prior]
) -> dict[int, str]:
    """Photos of a block that few tie points place elsewhere than their positions, with reasons; the
    others of the block agree with theirs.
    """
    own = [i for i in block if np.isfinite(priors[i].map_C[:2]).all()]
    if len(own) < FEWEST_PLACED or alignment.frame.crs is None:
        return {}
    off = np.array([(alignment.poses[i].map_C - priors[i].map_C)[:2] for i in own])
    away = np.linalg.norm(off - np.median(off, axis=0), axis=1)
    sigma = np.maximum([priors[i].sigma_C[0] for i in own], np.median(away))
    ties = alignment.ties
    high = np.array([alignment.poses[i].map_C[2] for i in own]) - alignment.ground_m
    count = np.array([len(rows) for rows in map(ties.of_photos(block).__getitem__, own)])
    few = count < min(AGAINST, OF_USUAL * float(np.median(count)))
    elsewhere = few & lies_elsewhere(away, sigma, high)
    return {
        own[k]: elsewhere_reason(int(count[k]), float(away[k])) for k in np.flatnonzero(elsewhere)
    }


def lies_elsewhere(away_m: Array, sigma_m: Array, high_m: Array) -> NDArray[np.bool_]:
    """Whether positions that are so far away from where photos of a flying height lie, and have
    these deviations, contradict them grossly.
    """
    return np.asarray(away_m > np.maximum(ELSEWHERE * sigma_m, ELSEWHERE_HIGH * high_m))


def elsewhere_reason(points: int, away_m: float) -> str:
    """Why a photo is not believed to lie where a few tie points place it."""
    return (
        f"it has only {points} tie points, by which it would lie {away_m:.0f} m from its reported"
        " position: matches of places that look alike"
    )


def _left_out(
    alignment: Alignment, block: Sequence[int], priors: Sequence[Prior]
) -> dict[int, str]:
    """The photos outside the largest group of a block, with reasons."""
    whole = _Growth(alignment, block, priors)
    groups, rest = list[set[int]](), set(block)
    while rest:
        left = whole.grown(rest)
        groups.append(rest - left)
        rest = left
        if not rest and len(groups) == 1:
            return {}
        if len(rest) < FEWEST_PLACED and len(rest) <= max(map(len, groups)):
            break
    largest = max(groups, key=len)
    reasons = whole.reasons(whole.grown(set(block), largest))
    held = set(block) - reasons.keys()
    for group in groups:
        if group is not largest and _placed(alignment, group & reasons.keys(), held, priors):
            reasons = {i: why for i, why in reasons.items() if i not in group}
    return reasons


def _placed(alignment: Alignment, group: set[int], held: set[int], priors: Sequence[Prior]) -> bool:
    """Whether the positions of a group's own photos place it, as they would a block that is linked
    with nothing, and agree with where it lies beside those that are `held`: a flight line that
    overlaps the next one by little. False where tie points moved it elsewhere.
    """
    own, others = (
        [i for i in sorted(some) if np.isfinite(priors[i].map_C[:2]).all()]
        for some in (group, held)
    )
    if len(own) < FEWEST_PLACED or len(others) < FEWEST_PLACED:
        return False
    told = np.array([priors[i].map_C[:2] for i in own + others])
    off = np.array([alignment.poses[i].map_C[:2] for i in own + others]) - told
    off -= np.median(off[len(own) :], axis=0)
    away = np.linalg.norm(off, axis=1)
    stated = float(np.median([priors[i].sigma_C[0] for i in own + others]))
    usual = max(stated, float(np.median(away[len(own) :])))
    extent = float(np.ptp(told[: len(own)], axis=0).max())
    return extent >= EXTENDED * usual and float(np.median(away[: len(own)])) < AGREEING * usual


class _Growth:
    """The growth of groups in one block."""

    def __init__(self, alignment: Alignment, block: Sequence[int], priors: Sequence[Prior]) -> None:
        self.alignment, self.priors = alignment, priors
        ties = alignment.ties
        self.own = ties.of_photos(block)
        self.first = np.searchsorted(ties.point, np.arange(len(ties.xyz) + 1))
        self.last = max(block)

    def grown(self, photos: set[int], among: set[int] | None = None) -> set[int]:
        """Those of these photos that never join a group; it starts with the photo that has most tie
        points, of those `among` which it shall.
        """
        ties = self.alignment.ties
        self.shown = np.zeros(len(ties.xyz), np.bool_)
        self.number = np.zeros(max(self.last, int(ties.photo.max(initial=0))) + 1, np.int64)
        start = max(sorted(among or photos), key=lambda i: len(self.own[i]))
        left, self.weak = photos - {start}, dict[int, str]()
        self._join(start)
        tried = np.zeros(len(self.number), np.int64)
        among_left = np.zeros(len(self.number), np.bool_)
        among_left[list(left)] = True
        while True:
            ready = np.flatnonzero(among_left & (self.number > AGAIN * tried))
            if not len(ready):
                break
            photo = int(ready[np.argmax(self.number[ready])])
            tried[photo] = self.number[photo]
            why = self._why_weak(photo)
            if why:
                self.weak[photo] = why
                continue
            left.remove(photo)
            among_left[photo] = False
            self._join(photo)
        return left

    def reasons(self, left: set[int]) -> dict[int, str]:
        """Why photos never joined the group that grew last."""
        return {i: self.weak.get(i) or self._why_weak(i) for i in sorted(left)}

    def _join(self, photo: int) -> None:
        points = self.alignment.ties.point[self.own[photo]]
        new = np.unique(points[~self.shown[points]])
        self.shown[new] = True
        length = self.first[new + 1] - self.first[new]
        within = np.arange(int(length.sum())) - np.repeat(np.cumsum(length) - length, length)
        seen = self.alignment.ties.photo[np.repeat(self.first[new], length) + within]
        self.number += np.bincount(seen, minlength=len(self.number))

    def _why_weak(self, photo: int) -> str:
        ties, own = self.alignment.ties, self.own[photo]
        own = own[self.shown[ties.point[own]]]
        return why_weak(
            self.alignment.poses[photo],
            self.alignment.camera(photo),
            ties.xyz[ties.point[own]],
            ties.px[own],
            ties.residual_px[own],
            self.priors[photo],
            least=least_covered(self.priors[photo], self.alignment.poses[photo]),
        )


def least_covered(prior: Prior, pose: Pose) -> float:
    """Least share of a photo's picture that its tie points cover, by its metadata and by where it
    is found to be.
    """
    if prior.sigma_tilt_deg <= STATED_DEG:
        return LEAST_COVERED
    level = -pose.cam_R_map[2, 2] > LEVEL
    return LEAST_COVERED if level and np.isfinite(prior.map_C[:2]).all() else LEAST_UNTOLD


def why_weak(
    pose: Pose,
    camera: Camera,
    xyz: Array,
    px: Array,
    residual_px: Array,
    prior: Prior | None,
    *,
    least: float,
) -> str:
    """Why tie points (n, 3) observed at px (n, 2) do not determine a pose, alone or with metadata,
    where they shall cover a share `least` of the picture; empty if they do.
    """
    if len(px) < FEWEST:
        return f"it has only {len(px)} tie points"
    wide, share = max(camera.width, camera.height), covered(px, camera)
    alone = deviation_px(pose, camera, xyz, residual_px, None)
    if alone <= LOOSEST * wide and share >= least:
        return ""
    if prior is not None and np.isfinite([*prior.map_C[:2], prior.yaw_deg]).all():
        told = deviation_px(pose, camera, xyz, residual_px, prior)
        if told <= LOOSEST_TOLD * wide:
            return ""
    return (
        f"it hangs on the other photos by too little: {len(px)} tie points in common cover"
        f" {share:.1%} of its picture ({least:.0%} are needed) and leave its place"
        f" uncertain by {alone:.1f} px (at most {LOOSEST * wide:.1f})"
    )


def covered(px: Array, camera: Camera) -> float:
    """Share of the picture inside the convex hull of observations (n, 2)."""
    hull = cv2.convexHull(px.astype(np.float32))
    return float(cv2.contourArea(hull)) / (camera.width * camera.height)


def deviation_px(
    pose: Pose, camera: Camera, xyz: Array, residual_px: Array, prior: Prior | None
) -> float:
    """Predicted standard deviation in px of the picture on the ground, at the worst place shown,
    from the covariance of the pose with all points held.
    """
    # residuals of a few points are less than their errors
    least = LeastSquaresMatching.sigma * max(camera.width / MATCHED, camera.height / MATCHED, 1.0)
    spread = max(least, float(np.median(np.linalg.norm(residual_px, axis=1))) / 1.18)
    weight = min(1.0, INDEPENDENT / len(xyz)) / spread**2
    J = pose_derivatives(pose, camera, xyz)
    flat = J.reshape(-1, 6)
    normal = weight * (flat.T @ flat)
    if prior is not None:
        normal += _known(prior)
    places = ground_places(pose, camera, float(np.median(xyz[:, 2])))
    if not len(places):
        return 0.0
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-12))  # metres and radians
    values, vectors = np.linalg.eigh(normal * scale[:, None] * scale)
    half = vectors / np.sqrt(np.maximum(values, 1e-12)) * scale[:, None]
    at = pose_derivatives(pose, camera, places) @ half
    return float(np.sqrt((at**2).sum((1, 2)).max()))


def pose_derivatives(pose: Pose, camera: Camera, xyz: Array) -> Array:
    """(n, 2, 6) derivatives of the pixels of points (n, 3) by rotation vector and centre."""
    local = pose.to_camera(xyz)
    k = np.broadcast_to(camera.vector, (len(local), len(camera.vector)))
    d_point = project_with_derivatives(k, local, intrinsics=False).d_point
    J = np.empty((len(local), 2, 6))
    J[:, :, :3] = np.cross(local[:, None, :], d_point)
    J[:, :, 3:] = -d_point @ pose.cam_R_map
    return J


def _known(prior: Prior) -> Array:
    """(6, 6) information of a photo's metadata about its rotation (camera axes) and centre."""
    out = np.zeros(6)
    if np.isfinite(prior.yaw_deg):
        tilt, yaw = np.radians([prior.sigma_tilt_deg, prior.sigma_yaw_deg])
        out[:3] = 1 / tilt**2, 1 / tilt**2, 1 / yaw**2
    known = np.isfinite(prior.map_C) & np.isfinite(prior.sigma_C)
    out[3:][known] = 1 / prior.sigma_C[known] ** 2
    return np.diag(out)


def ground_places(pose: Pose, camera: Camera, z: float) -> Array:
    """(k, 3) places at height z that the picture shows, those seen too flatly left out."""
    px = GRID * [camera.width - 1, camera.height - 1]
    ray = rays(camera, px) @ pose.cam_R_map
    steep = np.hypot(ray[:, 0], ray[:, 1]) < -ray[:, 2] * STEEPEST
    ray = ray[steep]
    return np.asarray(pose.map_C + ray * ((z - pose.map_C[2]) / ray[:, 2])[:, None])


def without(ties: TiePoints, gone: Mapping[int, str]) -> TiePoints:
    """Tie points without the observations of photos, and without points seen only once then."""
    keep = ~np.isin(ties.photo, list(gone))
    keep &= (np.bincount(ties.point[keep], minlength=len(ties.xyz)) >= 2)[ties.point]
    points, renumbered = np.unique(ties.point[keep], return_inverse=True)
    return TiePoints(
        xyz=ties.xyz[points],
        point=renumbered.astype(np.int64),
        photo=ties.photo[keep],
        px=ties.px[keep],
        residual_px=ties.residual_px[keep],
    )
