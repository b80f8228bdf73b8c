"""`image`, search `chain`: each photo registered to the one before it, without metadata (Y 4.2)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.lens import of_order, to_working, working_K
from skyquilt.alignment.pieces import Piece, lay
from skyquilt.alignment.pose import reported_camera
from skyquilt.geometry.transforms import transfer
from skyquilt.model.camera import Camera
from skyquilt.model.estimate import Estimate, NoEstimate
from skyquilt.model.features import Features, Matches
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Join, MapFrame, Prior, no_ties

Array = NDArray[np.float64]
LARGEST_SCALE = 1.7
"""Factor between the scales of two neighbours beyond which a registration is not believed."""


class Matcher(Protocol):
    """Putative matches of two photos."""

    def __call__(self, a: Features, b: Features) -> Matches:
        """Matches of a and b."""
        ...


class Estimator(Protocol):
    """A transformation from matches (N, 2) px."""

    def __call__(self, a: Array, b: Array) -> Estimate | NoEstimate:
        """b_H_a, or why there is none."""
        ...


class Leveller(Protocol):
    """The same transformation from features on the dominant plane (Y 4.2.2)."""

    def __call__(self, a: Array, b: Array, estimate: Estimate) -> "Levelled":
        """b_H_a from levelled features."""
        ...


class Levelled(Protocol):
    """What levelling gives."""

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


@dataclass(frozen=True, kw_only=True)
class Chain:
    """The loop-independent mosaic: pairwise against the last photo, no repositioning, no metadata."""

    match: Matcher
    """Matching."""
    estimate: Estimator
    """Robust estimation of the transformation, thresholds in px of the working image."""
    level: Leveller | None = None
    """Levelled features; None = all inliers count."""
    distortion: str = "6t"
    """Order of the lens model, fitted to the calibration that photos carry."""
    height_m: float | None = None
    """Height above ground in m that scales pieces without positions."""
    version: ClassVar[int] = 1
    name: ClassVar[str] = "image"

    def __call__(
        self, photos: Sequence[Photo], frame: MapFrame, priors: Sequence[Prior], features: Sequence[Features],
        order: Sequence[int],
    ) -> Alignment:  # fmt: skip
        """Registers photos (indices) in the order given; where two do not match, a new piece begins."""
        cameras = {p.camera_key: of_order(reported_camera(p), self.distortion) for p in photos}
        lens = [cameras[p.camera_key] for p in photos]
        pieces: list[dict[int, Array]] = []
        joins, notes = [], []
        last = -1
        for photo in order:
            joined = self._join(photo, last, lens, features) if last >= 0 else None
            if isinstance(joined, tuple):
                last_H_photo, join = joined
                pieces[-1][photo] = pieces[-1][last] @ last_H_photo
                joins.append(join)
            else:
                if joined is not None:
                    notes.append(broken(photos[photo].name, photos[last].name, joined.reason))
                pieces.append({photo: np.eye(3)})
            last = photo
        laid = lay([Piece(plane_H_cam=p) for p in pieces], priors, self.height_m)
        return plane_alignment(
            self.name, frame, photos, laid.poses, laid.metric, cameras, pieces, joins, notes
        )

    def _join(
        self, photo: int, onto: int, lens: Sequence[Camera], features: Sequence[Features]
    ) -> tuple[Array, Join] | NoEstimate:
        """onto_H_photo (3, 3) between undistorted image planes, or why there is none."""
        matches = self.match(features[photo], features[onto])
        px = features[photo].px[matches.index_a]
        a = to_working(lens[photo], px)
        b = to_working(lens[onto], features[onto].px[matches.index_b])
        found = self.estimate(a, b)
        if isinstance(found, NoEstimate):
            return found
        if reason := implausible(found.b_H_a, working_K(lens[photo])[:2, 2]):
            return NoEstimate(reason=reason)
        inner = np.flatnonzero(found.inliers)
        disparity, level = b[inner] - transfer(found.b_H_a, a[inner]), np.ones(len(inner), bool)
        if self.level is not None:
            levelled = self.level(a, b, found)
            found, disparity, level = levelled.estimate, levelled.d_px, levelled.level
        H = np.linalg.inv(working_K(lens[onto])) @ found.b_H_a @ working_K(lens[photo])
        return H / H[2, 2], Join(
            photo=photo, onto=onto, matches=len(matches), inliers=int(found.inliers.sum()),
            ste_px2=found.ste_per_inlier, score=np.nan, moved_m=np.nan, px=px[inner], d_px=disparity, levelled=level,
        )  # fmt: skip


def implausible(H: Array, at: Array) -> str:
    """Why a registration of two aerial photos cannot be; empty where it can. `at` (2,) is where it is judged."""
    w = H[2] @ np.array([*at, 1.0])
    mapped = H[:2] @ np.array([*at, 1.0]) / w
    J = (H[:2, :2] - np.outer(mapped, H[2, :2])) / w
    scale2 = float(np.linalg.det(J))
    if not LARGEST_SCALE**-2 < scale2 < LARGEST_SCALE**2:
        return f"implausible scale ({np.sign(scale2) * np.sqrt(abs(scale2)):.2f})"
    s = np.linalg.svd(J, compute_uv=False)
    return f"implausible shear ({s[0] / s[1]:.2f})" if s[0] > 1.5 * s[1] else ""


def broken(photo: str, before: str, reason: str) -> str:
    """The sentence about a break of the sequence."""
    return f"{photo} does not match {before}, the photo before it ({reason}): a new piece begins there."


def plane_alignment(
    method: str, frame: MapFrame, photos: Sequence[Photo], poses: dict, metric: bool, cameras: dict[str, Camera],
    pieces: Sequence[dict[int, Array]], joins: Sequence[Join], notes: Sequence[str],
) -> Alignment:  # fmt: skip
    """The alignment of a method that places photos in the plane."""
    used = [i for p in pieces for i in p]
    rejected = {i: "its registration is degenerate" for i in used if i not in poses}
    return Alignment(
        method=method, why="", frame=replace(frame, metric=metric), poses=poses, cameras=cameras,
        camera_of={i: photos[i].camera_key for i in poses},
        blocks=tuple(sorted((tuple(sorted(i for i in p if i in poses)) for p in pieces), key=len, reverse=True)),
        ties=no_ties(), rejected=rejected, joins=tuple(joins), notes=tuple(notes),
    )  # fmt: skip
