"""Refinement of observations: keypoints found in reduced images are moved to the best agreement of
larger images.

With approximately correct poses, the patches around all observations of a point show the same
ground. Rectified to the ground they differ by a translation only, and this translation is the error
of the observation. One observation per point is kept and the others are registered to it.

How much both patches still differ then, and how much texture they have, tells how accurate each
observation is: on open ground ten times as accurate as in the crown of a tree, where each photo
sees other leaves. Those crowns decide a focal length, since they stand above the ground.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.tracks import Tracks
from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.geometry.camera import pixels
from skyquilt.imaging.align_patches import translate
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Pose

Array = NDArray[np.float64]
GreyPicture = Callable[[int, int], NDArray[np.uint8]]
"""Gives the grey image (h, w) of a photo (index), with at most the given px on its longest side."""
MARGIN = 3
"""Largest shift of an observation in patch px."""
PART = 25_000
"""Observations, about, whose patches are in memory at once (0.5 kB each). Tracks that the same
photos show follow one another, so a part needs few photos.
"""
OUTSIDE = 1e6
"""Places in an image farther from its corner than this, in px, are as good as there."""
BATCH = 4000
"""Number of observations registered at a time, to bound memory."""
LEAST = 1e-3
"""Least deviation in patch px: equal patches do not tell a smaller one."""


@dataclass(frozen=True, kw_only=True)
class LeastSquaresMatching:
    """Registration of all observations of a point to the most central one."""

    side: int = 15
    """Side of a patch in px of the image."""
    longest: int = 1000
    """Longest side of the images in px."""
    agree: float = 0.75
    """Least correlation of two patches. Observations below it keep their place."""
    sigma: float = 0.12
    """Standard deviation of a usual refined observation in px of the image."""
    sharpest: float = 0.5
    """Least standard deviation of a refined observation, in usual ones."""
    bluntest: float = 8.0
    """Largest, likewise; also that of observations that keep their place."""
    version: ClassVar[int] = 5

    def __call__(
        self,
        tracks: Tracks,
        xyz: Array,
        poses: Mapping[int, Pose],
        cameras: Mapping[int, Camera],
        grey: GreyPicture,
        keep: Keep = MADE_NOW,
    ) -> Tracks:
        """Tracks (file pixels) with refined observations; `xyz` (count, 3): their points in the map
        frame. `keep`: each part of some ten thousand observations.
        """
        px, sigma = tracks.px.copy(), tracks.sigma_px.copy()
        told = np.full(len(sigma), np.nan)

        def part(which: tuple[slice, slice]) -> tuple[Array, Array, Array]:
            own, points = tracks.part(*which), which[1]
            return keep(
                f"{points.start}", lambda: self._sharper(own, xyz[points], poses, cameras, grey)
            )

        parts = list(tracks.parts(PART))
        for (some, _), found in zip(parts, keep.workers.each(part, parts), strict=True):
            px[some], sigma[some], told[some] = found
        return replace(tracks, px=px, sigma_px=sigma, relative=self._relative(told))

    def _relative(self, told: Array) -> Array:
        """Deviations (N,) over the usual one, in place of `told`. Places that no patch confirmed
        are the worst.
        """
        if not np.isfinite(told).any():
            return np.ones(len(told))
        told /= np.nanmedian(told)
        np.clip(told, self.sharpest, self.bluntest, out=told)
        return np.asarray(np.nan_to_num(told, copy=False, nan=self.bluntest))

    def _sharper(
        self,
        tracks: Tracks,
        xyz: Array,
        poses: Mapping[int, Pose],
        cameras: Mapping[int, Camera],
        grey: GreyPicture,
    ) -> tuple[Array, Array, Array]:
        """Refined observations (N, 2), their usual deviation (N,) or that of keypoints, and the
        deviation (N,) in patch px that the patches tell; NaN where an observation was not refined.
        """
        anchor = self._anchors(tracks, cameras)
        patches, scale = self._patches(tracks, xyz, poses, cameras, grey)
        others = np.flatnonzero(anchor[tracks.point] != np.arange(len(tracks.point)))
        first = anchor[tracks.point[others]]
        shift, score, told = self._registered(patches, first, others)
        moved = self._on_image(tracks, xyz, poses, cameras, others, shift, scale)
        # a point that its rays do not determine may lie anywhere, and a step on the ground be wide
        far = np.linalg.norm((moved - tracks.px[others]) / scale[others], axis=1)
        good = (np.nan_to_num(score) > self.agree) & (far < 4 * MARGIN)
        px, sigma = tracks.px.copy(), tracks.sigma_px.copy()
        px[others[good]] = moved[good]
        sharp = np.maximum(self.sigma * scale[:, 0], 0.2)
        sigma[others[good]] = sharp[others[good]]
        sigma[first[good]] = sharp[first[good]]
        return px, sigma, _of_observations(np.maximum(told, LEAST), others, first, good, len(px))

    def _registered(
        self, patches: NDArray[np.uint8], first: NDArray[np.int64], others: NDArray[np.int64]
    ) -> tuple[Array, Array, Array]:
        """Shifts (m, 2) in patch px, correlations (m,) and deviations (m,) in patch px, computed
        for some thousand pairs at a time.
        """
        inner = slice(MARGIN, -MARGIN)
        parts = []
        for k in range(0, len(others), BATCH):
            part = slice(k, k + BATCH)
            reference = patches[first[part]][:, inner, inner].astype(np.float32)
            parts.append(
                translate(reference, patches[others[part]].astype(np.float32), margin=MARGIN)
            )
        if not parts:
            return np.zeros((0, 2)), np.zeros(0), np.zeros(0)
        shifts, scores, told = (np.concatenate(found) for found in zip(*parts, strict=True))
        return shifts, scores, told

    def _anchors(self, tracks: Tracks, cameras: Mapping[int, Camera]) -> NDArray[np.int64]:
        """The most central observation of each track (count,)."""
        size = np.array(
            [(cameras[p].width, cameras[p].height) for p in tracks.photo.tolist()], float
        )
        off = np.linalg.norm(tracks.px / size - 0.5, axis=1)
        order = np.lexsort((off, tracks.point))
        return order[np.searchsorted(tracks.point[order], np.arange(tracks.count))]

    def _patches(
        self,
        tracks: Tracks,
        xyz: Array,
        poses: Mapping[int, Pose],
        cameras: Mapping[int, Camera],
        grey: GreyPicture,
    ) -> tuple[NDArray[np.uint8], Array]:
        """Patches (N, s + 2 margin, ...) of all observations rectified to the level ground of their
        point, centred at each observation, and the image scales (N, 2): sensor px per image px
        along x and y. Both sides of an image are rounded, and they differ by it.
        """
        full = self.side + 2 * MARGIN
        out = np.zeros((len(tracks.point), full, full), np.uint8)
        scale = np.ones((len(tracks.point), 2))
        step = (np.arange(full) - full // 2).astype(float)
        for photo in np.unique(tracks.photo).tolist():
            own = np.flatnonzero(tracks.photo == photo)
            picture, camera = grey(photo, self.longest), cameras[photo]
            each = np.array([camera.width, camera.height]) / picture.shape[1::-1]
            scale[own] = each
            gx, gy = ground_axes(xyz[tracks.point[own]], poses[photo], camera, each)
            # the mapping from ground to image is nearly affine over a few pixels
            centre = (tracks.px[own] + 0.5) / each - 0.5
            u = (
                centre[:, 0, None, None]
                + gx[:, 0, None, None] * step
                + gy[:, 0, None, None] * step[:, None]
            )
            v = (
                centre[:, 1, None, None]
                + gx[:, 1, None, None] * step
                + gy[:, 1, None, None] * step[:, None]
            )
            flat_u, flat_v = (
                np.clip(m, -OUTSIDE, OUTSIDE).reshape(len(own), -1).astype(np.float32)
                for m in (u, v)
            )
            for k in range(0, len(own), 30000):
                part = slice(k, k + 30000)
                warped = cv2.remap(
                    picture,
                    flat_u[part],
                    flat_v[part],
                    cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE,
                )
                out[own[part]] = warped.reshape(-1, full, full)
        return out, scale

    def _on_image(
        self,
        tracks: Tracks,
        xyz: Array,
        poses: Mapping[int, Pose],
        cameras: Mapping[int, Camera],
        rows: NDArray[np.int64],
        shift: Array,
        scale: Array,
    ) -> Array:
        """Sensor pixels (m, 2) of observations moved by shifts (m, 2) in patch px."""
        moved = tracks.px[rows].copy()
        for photo in np.unique(tracks.photo[rows]).tolist():
            own = np.flatnonzero(tracks.photo[rows] == photo)
            s = scale[rows[own[0]]]
            gx, gy = ground_axes(xyz[tracks.point[rows[own]]], poses[photo], cameras[photo], s)
            moved[own] += s * (gx * shift[own, :1] + gy * shift[own, 1:])
        return moved


def _of_observations(
    told: Array,
    others: NDArray[np.int64],
    first: NDArray[np.int64],
    good: NDArray[np.bool_],
    count: int,
) -> Array:
    """The deviation (count,) of each observation from those of pairs (m,): of `others` their own,
    of the `first` ones, to which they were registered, the geometric mean of theirs. NaN for pairs
    that are not good.
    """
    out = np.full(count, np.nan)
    out[others[good]] = told[good]
    number = np.bincount(first[good], minlength=count)
    total = np.bincount(first[good], np.log(told[good]), count)
    seen = number > 0
    out[seen] = np.exp(total[seen] / number[seen])
    return out


def ground_axes(X: Array, pose: Pose, camera: Camera, scale: Array) -> tuple[Array, Array]:
    """Shift in image px (n, 2) per patch px eastwards and southwards on level ground at X
    (n, 3). `scale` (2,): sensor px per image px along x and y.
    """
    size = np.abs(pose.map_C[2] - X[:, 2]) / camera.focal * scale[0]
    px = [_pixel(camera, pose, p) / scale for p in (X, X + _along(size, 0), X - _along(size, 1))]
    return px[1] - px[0], px[2] - px[0]


def _along(size: Array, axis: int) -> Array:
    """Steps (n, 3) of size (n,) along an axis of the map."""
    out = np.zeros((len(size), 3))
    out[:, axis] = size
    return out


def _pixel(camera: Camera, pose: Pose, X: Array) -> Array:
    local = pose.to_camera(X)
    return pixels(local[:, :2] / np.maximum(local[:, 2:], 1e-6), camera.vector)
