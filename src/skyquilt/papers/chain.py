"""`image`, search `chain`: each photo is registered to the previous one, without metadata (Y
4.2).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.inputs import GreyPicture
from skyquilt.geometry.camera import undistort
from skyquilt.imaging.plane import to_grid
from skyquilt.model.camera import Camera
from skyquilt.model.estimate import NoEstimate
from skyquilt.model.features import Features
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Join, MapFrame, Prior
from skyquilt.papers.direct import Direct
from skyquilt.papers.lens_order import WORKING_WIDTH, of_order, to_working, working_K
from skyquilt.papers.loop import closed
from skyquilt.papers.pieces import Piece, lay
from skyquilt.papers.plane_registration import (
    Estimator,
    Leveller,
    Matcher,
    at_share,
    implausible,
    plane_alignment,
    registered,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Chain:
    """The loop-independent mosaic: each photo is registered to the previous one, without
    repositioning and metadata.
    """

    match: Matcher
    """Matching."""
    estimate: Estimator
    """Robust estimation of the transformation, thresholds in px of a photo 1500 px wide."""
    level: Leveller | None = None
    """Levelled features; None = all inliers are used."""
    distortion: str = "6t"
    """Order of the lens model, which is fitted to the calibration of the photos."""
    height_m: float | None = None
    """Height above ground in m that scales pieces without positions."""
    loop: bool = False
    """Also compare photos where the chain comes back, and spread its closing error [Y 2.3.4]."""
    version: ClassVar[int] = 2

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
        cameras = {p.camera_key: of_order(p.lens, self.distortion) for p in photos}
        lens = [cameras[p.camera_key] for p in photos]
        return chained(
            lambda photo, onto: self._join(photo, onto, lens, features),
            photos,
            frame,
            priors,
            order,
            cameras,
            self.height_m,
            loop=self.loop,
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
        estimate, level = at_share(self.estimate, self.level, lens[onto].width / WORKING_WIDTH)
        found = registered(photo, onto, px, a, b, estimate=estimate, level=level, centre=centre)
        if isinstance(found, NoEstimate):
            return found
        H = np.linalg.inv(working_K(lens[onto])) @ found[0] @ working_K(lens[photo])
        return H / H[2, 2], found[1]


@dataclass(frozen=True, kw_only=True)
class DirectChain:
    """The same chain by the pixels of photos instead of their features [methods B4]."""

    register: Direct
    """Registration of two pictures."""
    distortion: str = "6t"
    """Order of the lens model, which is fitted to the calibration of the photos."""
    longest: int = 640
    """Longest side in px of the undistorted pictures that are registered."""
    height_m: float | None = None
    """Height above ground in m that scales pieces without positions."""
    version: ClassVar[int] = 1

    def __call__(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        priors: Sequence[Prior],
        order: Sequence[int],
        grey: GreyPicture,
    ) -> Alignment:
        """Registers photos (indices) in the order given; where two do not match, a new piece
        begins.
        """
        cameras = {p.camera_key: of_order(p.lens, self.distortion) for p in photos}
        lens = [cameras[p.camera_key] for p in photos]

        def join(photo: int, onto: int) -> tuple[Array, Join] | NoEstimate:
            flat = [self._flat(grey(i, self.longest), lens[i]) for i in (photo, onto)]
            return self._join(photo, onto, flat[0], flat[1])

        return chained(join, photos, frame, priors, order, cameras, self.height_m)

    def _flat(self, picture: NDArray[np.uint8], camera: Camera) -> tuple[NDArray[Any], Array]:
        """The undistorted picture, and plane_H_px (3, 3) from its px to the image plane."""
        f = camera.focal * min(1.0, self.longest / max(camera.width, camera.height))
        plane_H_grid = np.diag([1 / f, 1 / f, 1.0])
        patch = to_grid(picture, camera, plane_H_grid)
        assert patch is not None, "a photo's own image plane has no horizon"
        shift = np.array([[1, 0, patch.column], [0, 1, patch.row], [0, 0, 1.0]])
        return patch.pixels, plane_H_grid @ shift

    def _join(
        self, photo: int, onto: int, a: tuple[NDArray[Any], Array], b: tuple[NDArray[Any], Array]
    ) -> tuple[Array, Join] | NoEstimate:
        found = self.register(a[0], b[0])
        if isinstance(found, NoEstimate):
            return found
        H = b[1] @ found.b_H_a @ np.linalg.inv(a[1])
        if reason := implausible(H / H[2, 2], np.zeros(2)):
            return NoEstimate(reason=reason)
        return H / H[2, 2], Join(
            photo=photo,
            onto=onto,
            matches=0,
            inliers=0,
            ste_px2=np.nan,
            score=found.score,
            moved_m=np.nan,
            px=np.zeros((0, 2)),
            d_px=np.zeros((0, 2)),
            levelled=np.zeros(0, bool),
        )


def chained(
    join: Callable[[int, int], tuple[Array, Join] | NoEstimate],
    photos: Sequence[Photo],
    frame: MapFrame,
    priors: Sequence[Prior],
    order: Sequence[int],
    cameras: dict[str, Camera],
    height_m: float | None,
    *,
    loop: bool = False,
) -> Alignment:
    """Photos one after the other: `join` gives onto_H_photo (3, 3) between undistorted image planes
    of a photo and the one before it, or why they do not match: then a new piece begins. With `loop`
    the pieces' loops are closed.
    """
    pieces: list[dict[int, Array]] = []
    joins, notes, last = [], [], -1
    for photo in order:
        joined = join(photo, last) if last >= 0 else None
        if isinstance(joined, tuple):
            last_H_photo, record = joined
            pieces[-1][photo] = pieces[-1][last] @ last_H_photo
            joins.append(record)
        else:
            if joined is not None:
                notes.append(broken(photos[photo].name, photos[last].name, joined.reason))
            pieces.append({photo: np.eye(3)})
        last = photo
    if loop:
        for k, piece in enumerate(pieces):
            extent = {i: _corners(cameras[photos[i].camera_key]) for i in piece}
            pieces[k], more = closed(piece, extent, join)
            joins += more
        notes.append(f"{len(joins) + len(pieces) - len(order)} closings of loops were found")
    laid = lay([Piece(plane_H_cam=p) for p in pieces], priors, height_m)
    return plane_alignment(
        "image", frame, photos, laid.poses, laid.metric, cameras, pieces, joins, notes
    )


def _corners(camera: Camera) -> Array:
    """Corners (4, 2) of a photo in its undistorted image plane."""
    right, low = camera.width - 1.0, camera.height - 1.0
    px = np.array([[0.0, 0.0], [right, 0.0], [right, low], [0.0, low]])
    return np.asarray(undistort(camera, px))


def broken(photo: str, before: str, reason: str) -> str:
    """The sentence about a break of the sequence."""
    return (
        f"{photo} does not match {before}, the photo before it ({reason}): a new piece begins"
        " there."
    )
