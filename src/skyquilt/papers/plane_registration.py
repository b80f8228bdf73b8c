"""Registration of a photo to another photo or a map in the plane, shared by `chain`, `overview` and
`flightline`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.transforms import transfer
from skyquilt.matching.levelled import Level
from skyquilt.matching.ransac import Ransac
from skyquilt.model.camera import Camera
from skyquilt.model.estimate import Estimate, NoEstimate
from skyquilt.model.features import Features, Matches
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Join, MapFrame, Pose, no_ties
from skyquilt.papers.magsac import Magsac

Array = NDArray[np.float64]
LARGEST_SCALE = 1.7
"""Largest accepted ratio of the scales of two neighbours."""


class Matcher(Protocol):
    """Interface: finds putative matches of two photos."""

    def __call__(self, a: Features, b: Features) -> Matches:
        """Matches of a and b."""
        ...


class Estimator(Protocol):
    """Interface: estimates a transformation from matches (N, 2) px."""

    def __call__(self, a: Array, b: Array) -> Estimate | NoEstimate:
        """b_H_a, or the reason why there is none."""
        ...


class Leveller(Protocol):
    """Interface: estimates the transformation from features on the dominant plane (Y 4.2.2)."""

    def __call__(self, a: Array, b: Array, estimate: Estimate) -> "Levelled":
        """b_H_a from levelled features."""
        ...


class Levelled(Protocol):
    """Interface of the result of levelling."""

    @property
    def estimate(self) -> Estimate:
        """The transformation."""
        ...

    @property
    def d_px(self) -> Array:
        """(M, 2) disparity vectors of the first inliers."""
        ...

    @property
    def level(self) -> NDArray[np.bool_]:
        """(M,) those on the dominant plane."""
        ...


LEAST_PX = 1.0
"""Least threshold in px, whatever the width of a photo: keypoints are no more accurate."""


def at_share(
    estimate: Estimator, level: Leveller | None, share: float
) -> tuple[Estimator, Leveller | None]:
    """Both for photos narrower than the working width, of which they have this `share`.

    Thresholds in px are for the working width (Y 4.9 for 1500 px). Photos are never enlarged to it,
    so the thresholds shrink instead. Estimators without a threshold in px are not changed.
    """
    if share >= 1:
        return estimate, level
    if isinstance(estimate, Ransac | Magsac):
        estimate = replace(estimate, threshold_px=max(LEAST_PX, estimate.threshold_px * share))
    if isinstance(level, Level):
        level = replace(level, width=round(level.width * share))
    return estimate, level


def registered(
    photo: int,
    onto: int,
    px: Array,
    a: Array,
    b: Array,
    *,
    estimate: Estimator,
    level: Leveller | None,
    centre: Array,
) -> tuple[Array, Join] | NoEstimate:
    """b_H_a (3, 3), from features of the dominant plane if there is a leveller, and its quality; or
    the reason why there is none.

    a, b (N, 2) px of the working images are matches of the photo's `px` (N, 2) with a photo or the
    map (-1). The registration must be plausible at the photo's `centre` (2,).
    """
    found = estimate(a, b)
    if isinstance(found, NoEstimate):
        return found
    if reason := implausible(found.b_H_a, centre):
        return NoEstimate(reason=reason)
    inner = np.flatnonzero(found.inliers)
    disparity, on_plane = b[inner] - transfer(found.b_H_a, a[inner]), np.ones(len(inner), bool)
    if level is not None:
        levelled = level(a, b, found)
        found, disparity, on_plane = levelled.estimate, levelled.d_px, levelled.level
    return found.b_H_a, Join(
        photo=photo,
        onto=onto,
        matches=len(a),
        inliers=int(found.inliers.sum()),
        ste_px2=found.ste_per_inlier,
        score=np.nan,
        moved_m=np.nan,
        px=px[inner],
        d_px=disparity,
        levelled=on_plane,
    )


def implausible(H: Array, at: Array) -> str:
    """Why a registration of two aerial photos is implausible; empty if it is plausible. `at` (2,):
    the point of the check.
    """
    w = H[2] @ np.array([*at, 1.0])
    mapped = H[:2] @ np.array([*at, 1.0]) / w
    J = (H[:2, :2] - np.outer(mapped, H[2, :2])) / w
    scale2 = float(np.linalg.det(J))
    if not LARGEST_SCALE**-2 < scale2 < LARGEST_SCALE**2:
        return f"implausible scale ({np.sign(scale2) * np.sqrt(abs(scale2)):.2f})"
    s = np.linalg.svd(J, compute_uv=False)
    return f"implausible shear ({s[0] / s[1]:.2f})" if s[0] > 1.5 * s[1] else ""


def plane_alignment(
    method: str,
    frame: MapFrame,
    photos: Sequence[Photo],
    poses: dict[int, Pose],
    metric: bool,
    cameras: dict[str, Camera],
    pieces: Sequence[dict[int, Array]],
    joins: Sequence[Join],
    notes: Sequence[str],
) -> Alignment:
    """The alignment of a method that places photos in the plane."""
    used = [i for p in pieces for i in p]
    rejected = {i: "its registration is degenerate" for i in used if i not in poses}
    return Alignment(
        method=method,
        why="",
        frame=replace(frame, metric=metric),
        poses=poses,
        cameras=cameras,
        camera_of={i: photos[i].camera_key for i in poses},
        blocks=tuple(
            sorted(
                (tuple(sorted(i for i in p if i in poses)) for p in pieces), key=len, reverse=True
            )
        ),
        ties=no_ties(),
        rejected=rejected,
        joins=tuple(joins),
        notes=tuple(notes),
    )
