"""`image`, search `overview`: each photo is registered to the whole map so far, so the cost
increases with its size (Y 4.1.2).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import undistort
from skyquilt.imaging.plane import Overview, to_grid
from skyquilt.model.camera import Camera
from skyquilt.model.estimate import NoEstimate
from skyquilt.model.features import Features
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Join, MapFrame, Prior
from skyquilt.papers.lens_order import of_order
from skyquilt.papers.pieces import Piece, lay
from skyquilt.papers.plane_registration import (
    Estimator,
    Leveller,
    Matcher,
    at_share,
    plane_alignment,
    registered,
)

Array = NDArray[np.float64]
GreyPicture = Callable[[int, int], NDArray[np.uint8]]
"""Gives the grey image of a photo (index), with at most the given px on its longest side."""
RIM_PX = 12
"""Features nearer to the border of the overview than this, in px, are ignored."""


class Detector(Protocol):
    """Interface: finds the features of an image."""

    def __call__(self, image: NDArray[Any]) -> Features:
        """Keypoints and descriptors."""
        ...

    def counted(self, count: int) -> "Detector":
        """The same with another number of keypoints at most."""
        ...


@dataclass(frozen=True, kw_only=True)
class ByOverview:
    """The basic image-based method of Y 4.1.2: features of the whole overview are computed again
    for every photo.
    """

    detect: Detector
    """Features of the overview."""
    match: Matcher
    """Matching."""
    estimate: Estimator
    """Robust estimation, thresholds in px of the overview."""
    level: Leveller | None = None
    """Levelled features; None = all inliers are used."""
    distortion: str = "6t"
    """Order of the lens model, which is fitted to the calibration of the photos."""
    longest: int = 640
    """Longest side in px of a photo in the overview."""
    per_photo: int = 1500
    """Number of features per area of a photo."""
    height_m: float | None = None
    """Height above ground in m that scales pieces without positions."""
    version: ClassVar[int] = 2
    name: ClassVar[str] = "image"

    def __call__(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        priors: Sequence[Prior],
        features: Sequence[Features],
        order: Sequence[int],
        grey: GreyPicture,
    ) -> Alignment:
        """Registers photos (indices) in the order given; one that matches nothing begins a new
        piece.
        """
        cameras = {p.camera_key: of_order(p.lens, self.distortion) for p in photos}
        pieces: list[dict[int, Array]] = []
        joins, notes = [], []
        overview, K = Overview(), np.eye(3)
        for photo in order:
            camera = cameras[photos[photo].camera_key]
            joined = self._join(photo, camera, overview, features[photo], K) if pieces else None
            if isinstance(joined, tuple):
                grid_H_cam, join = joined
                joins.append(join)
            else:
                if joined is not None:
                    name = photos[photo].name
                    notes.append(
                        f"{name} does not match the map so far ({joined.reason}): a new piece"
                        " begins."
                    )
                overview, K = Overview(), self._grid(camera)
                pieces.append({})
                grid_H_cam = K
            patch = to_grid(grey(photo, self.longest), camera, np.linalg.inv(grid_H_cam))
            if patch is not None:
                overview.merge(patch)
            pieces[-1][photo] = np.linalg.inv(K) @ grid_H_cam
        laid = lay([Piece(plane_H_cam=p) for p in pieces], priors, self.height_m)
        return plane_alignment(
            self.name, frame, photos, laid.poses, laid.metric, cameras, pieces, joins, notes
        )

    def _grid(self, camera: Camera) -> Array:
        """grid_H_cam (3, 3) of a piece's first photo."""
        f = camera.focal * min(1.0, self.longest / max(camera.width, camera.height))
        return np.diag([f, f, 1.0])

    def _join(
        self, photo: int, camera: Camera, overview: Overview, features: Features, K: Array
    ) -> tuple[Array, Join] | NoEstimate:
        """grid_H_cam (3, 3) of the photo, or why there is none."""
        known = self._features(overview)
        matches = self.match(features, known)
        px = features.px[matches.index_a]
        a = undistort(camera, px) * K[0, 0]
        b = known.px[matches.index_b] + (overview.column, overview.row)
        share = max(camera.width, camera.height) / self.longest
        estimate, level = at_share(self.estimate, self.level, share)
        found = registered(photo, -1, px, a, b, estimate=estimate, level=level, centre=np.zeros(2))
        return found if isinstance(found, NoEstimate) else (found[0] @ K, found[1])

    def _features(self, overview: Overview) -> Features:
        """Features of the overview without those at its border."""
        area = overview.shown.sum() / (0.6 * self.longest**2)
        found = self.detect.counted(int(self.per_photo * max(1.0, area)))(
            overview.pixels.astype(np.uint8)
        )
        inside = cv2.erode(
            overview.shown.astype(np.uint8), np.ones((2 * RIM_PX + 1,) * 2, np.uint8), borderValue=0
        )
        at = np.rint(found.px).astype(int).T
        keep = inside[at[1].clip(0, inside.shape[0] - 1), at[0].clip(0, inside.shape[1] - 1)] > 0
        return Features(
            px=found.px[keep],
            size=found.size[keep],
            descriptors=found.descriptors[keep],
            scale=found.scale,
        )
