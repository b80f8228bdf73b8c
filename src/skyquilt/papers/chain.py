"""`image`, search `chain`: each photo registered to the one before it, without metadata (Y 4.2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.pose import reported_camera
from skyquilt.model.camera import Camera
from skyquilt.model.estimate import NoEstimate
from skyquilt.model.features import Features
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Join, MapFrame, Prior
from skyquilt.papers.lens_order import of_order, to_working, working_K
from skyquilt.papers.pieces import Piece, lay
from skyquilt.papers.plane_registration import (
    Estimator,
    Leveller,
    Matcher,
    plane_alignment,
    registered,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Chain:
    """The loop-independent mosaic: pairwise against the last photo, no repositioning, no
    metadata.
    """

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
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        priors: Sequence[Prior],
        features: Sequence[Features],
        order: Sequence[int],
    ) -> Alignment:
        """Registers photos (indices) in the order given; where two do not match, a new piece
        begins.
        """
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
        centre = working_K(lens[photo])[:2, 2]
        found = registered(
            photo, onto, px, a, b, estimate=self.estimate, level=self.level, centre=centre
        )
        if isinstance(found, NoEstimate):
            return found
        H = np.linalg.inv(working_K(lens[onto])) @ found[0] @ working_K(lens[photo])
        return H / H[2, 2], found[1]


def broken(photo: str, before: str, reason: str) -> str:
    """The sentence about a break of the sequence."""
    return (
        f"{photo} does not match {before}, the photo before it ({reason}): a new piece begins"
        " there."
    )
