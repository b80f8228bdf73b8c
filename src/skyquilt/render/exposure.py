"""Exposure: one gain per photo and band and one vignetting per camera, from what overlapping photos show alike.

Gains act on the odds x / (1 - x) of a pixel value x in (0, 1), not on the value: black stays black and white
stays white, so nothing clips or turns purple, and two gains in a row are one gain.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from skyquilt.model.surface import Surface
from skyquilt.imaging.views import View, project_nodes

Float = NDArray[np.float32]

SIGMA_LEVEL = 0.15
"""Deviation in log odds of two photos' brightness of one ground point, all else equal."""
NO_VIGNETTING = 0.08
"""Falls in log odds below this (two percent of a middle grey, in the corners) are left alone: it saves a second."""
CORRELATED = 30.0
"""Neighbouring samples err alike: so many count as one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposure:
    """What brings photos to one brightness: log odds + gain[band] + v2 r^2 + v4 r^4, r = 1 at the corner."""

    gains: Mapping[int, Float]
    """Photo -> (bands,) in log odds."""
    vignetting: Mapping[int, tuple[float, float]]
    """Photo -> (v2, v4) in log odds."""

    def apply(self, photo: int, pixels: NDArray[np.uint8], radius2: Float) -> NDArray[np.uint8]:
        """Pixels (h, w, bands) at the common brightness; radius2 (h, w): squared radius, 1 at the corner."""
        v2, v4 = self.vignetting[photo]
        gains = self.gains[photo]
        if max(abs(v2 + v4), abs(v2) / 2) < NO_VIGNETTING:
            if float(np.abs(gains).max()) < 0.005:
                return pixels
            return np.asarray(cv2.LUT(pixels, odds_table(gains))).reshape(pixels.shape)
        odds = np.exp(v2 * radius2 + v4 * radius2**2)[..., None] * np.exp(gains)
        brighter = cv2.multiply(pixels, odds.astype(np.float32), dtype=cv2.CV_32F).reshape(pixels.shape)
        white = brighter - pixels + np.float32(255)
        return np.asarray(cv2.divide(brighter, white, scale=255, dtype=cv2.CV_8U)).reshape(pixels.shape)


def odds_table(gains: Float) -> NDArray[np.uint8]:
    """Lookup table (1, 256, bands) of gains in log odds."""
    x = np.arange(256)[None, :, None] / 255.0
    g = np.exp(gains.astype(np.float64))
    return np.rint(255 * g * x / (1 + (g - 1) * x)).astype(np.uint8)


NEUTRAL = Exposure(gains={}, vignetting={})
"""No change."""


@dataclass(frozen=True, kw_only=True)
class Balance:
    """Robust least squares of log-odds differences at ground points seen by several photos."""

    points: int = 2500
    """Ground points looked at."""
    sigma_gain: float = 0.5
    """Prior deviation of a gain in log odds."""
    sigma_vignetting: float = 0.15
    """Prior deviation of a vignetting coefficient in log odds."""
    version: ClassVar[int] = 1

    def __call__(
        self, views: Sequence[View], thumbnails: Mapping[int, NDArray[np.uint8]], camera_of: Mapping[int, str],
        surface: Surface, bounds: tuple[float, float, float, float],
    ) -> Exposure:  # fmt: skip
        """Estimates the exposure from thumbnails (h, w, bands) of the photos."""
        usable = [v for v in views if v.photo in thumbnails]
        if len(usable) < 2:
            return NEUTRAL
        samples = self._samples(usable, thumbnails, surface, bounds)
        if not len(samples.point):
            return NEUTRAL
        return _solve(samples, [v.photo for v in usable], camera_of, self.sigma_gain, self.sigma_vignetting)

    def _samples(
        self, views: Sequence[View], thumbnails: Mapping[int, NDArray[np.uint8]], surface: Surface,
        bounds: tuple[float, float, float, float],
    ) -> "Samples":  # fmt: skip
        west, south, east, north = bounds
        step = np.sqrt((east - west) * (north - south) / self.points)
        x, y = np.meshgrid(np.arange(west, east, step), np.arange(south, north, step))
        z = surface.at(x, y)
        point, row, radius2, value = [], [], [], []
        for index, view in enumerate(views):
            nodes = project_nodes(view, x, y, z)
            seen = np.flatnonzero(nodes.seen.ravel())
            if not len(seen):
                continue
            u, v = nodes.u.ravel()[seen], nodes.v.ravel()[seen]
            point.append(seen)
            row.append(np.full(len(seen), index))
            radius2.append(corner_radius2(view, u, v))
            value.append(_sampled(thumbnails[view.photo], u, v, view.camera.width, view.camera.height))
        if not point:
            return Samples(point=np.zeros(0, int), row=np.zeros(0, int), radius2=np.zeros(0), log=np.zeros((0, 3)))
        levels = np.concatenate(value)
        good = ((levels > 8) & (levels < 247)).all(1)
        return Samples(
            point=np.concatenate(point)[good], row=np.concatenate(row)[good],
            radius2=np.concatenate(radius2)[good], log=np.log(levels[good] / (255 - levels[good])),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Brightness of ground points in photos."""

    point: NDArray[np.int64]
    """(N,) ground point."""
    row: NDArray[np.int64]
    """(N,) view."""
    radius2: NDArray[np.float64]
    """(N,) squared radius in the photo, 1 at the corner."""
    log: NDArray[np.float64]
    """(N, bands) log odds of the brightness."""


def corner_radius2(view: View, u: NDArray, v: NDArray) -> NDArray:
    """Squared distance from the image centre over that of the corner."""
    w, h = view.camera.width - 1.0, view.camera.height - 1.0
    return ((u - w / 2) ** 2 + (v - h / 2) ** 2) / ((w / 2) ** 2 + (h / 2) ** 2)


def _sampled(thumbnail: NDArray[np.uint8], u: NDArray, v: NDArray, width: int, height: int) -> NDArray[np.float64]:
    """Smoothed thumbnail values (n, bands) at photo pixels."""
    h, w = thumbnail.shape[:2]
    smooth = cv2.GaussianBlur(thumbnail.astype(np.float32), (0, 0), 1.5).reshape(h, w, -1)
    column = np.clip(np.rint((u + 0.5) * w / width - 0.5), 0, w - 1).astype(int)
    row = np.clip(np.rint((v + 0.5) * h / height - 0.5), 0, h - 1).astype(int)
    return smooth[row, column].astype(np.float64)


def _solve(
    s: Samples, photos: Sequence[int], camera_of: Mapping[int, str], sigma_gain: float, sigma_v: float
) -> Exposure:
    """log odds + g + v2 r^2 + v4 r^4 is the same for all photos of a point: differences to the point's mean vanish."""
    lens = [camera_of[p].removesuffix("/turned") for p in photos]
    cameras = sorted(set(lens))
    camera = np.array([cameras.index(name) for name in lens])[s.row]
    n, N = len(photos), len(s.point)
    _, point = np.unique(s.point, return_inverse=True)
    columns = [s.row, n + 2 * camera, n + 2 * camera + 1]
    values = [np.ones(N), s.radius2, s.radius2**2]
    A = sparse.csr_matrix(
        (np.concatenate(values), (np.tile(np.arange(N), 3), np.concatenate(columns))), (N, n + 2 * len(cameras))
    )
    ridge = np.r_[np.full(n, 1 / sigma_gain**2), np.full(2 * len(cameras), 1 / sigma_v**2)]
    x = _robust_differences(A, point, s.log.mean(1), ridge)
    shared = A[:, n:] @ x[n:]
    bands = [
        _robust_differences(A[:, :n], point, s.log[:, band] + shared, ridge[:n]) for band in range(s.log.shape[1])
    ]
    gains = np.stack(bands, 1)
    gains = (gains - np.median(gains, axis=0)).astype(np.float32)
    v = x[n:].reshape(-1, 2)
    fall = {p: (float(v[k, 0]), float(v[k, 1])) for p, k in zip(photos, map(cameras.index, lens), strict=True)}
    return Exposure(gains=dict(zip(photos, gains, strict=True)), vignetting=fall)


def _robust_differences(A: sparse.csr_matrix, point: NDArray, y: NDArray, ridge: NDArray) -> NDArray[np.float64]:
    """x that makes y + A x equal within each point, reweighted against moving things and shadows."""
    w = np.ones(len(y))
    x = np.zeros(A.shape[1])
    for _ in range(6):
        mass = np.bincount(point, w)
        select = sparse.csr_matrix((w, (point, np.arange(len(y)))), (len(mass), len(y)))
        mean_A = sparse.diags(1 / np.maximum(mass, 1e-9)) @ (select @ A)
        mean_y = (select @ y) / np.maximum(mass, 1e-9)
        W = sparse.diags(w)
        normal = A.T @ W @ A - mean_A.T @ sparse.diags(mass) @ mean_A + sparse.diags(ridge * SIGMA_LEVEL**2 * CORRELATED)
        rhs = -(A.T @ (w * y) - mean_A.T @ (mass * mean_y))
        x = sparse_linalg.spsolve(normal.tocsc(), rhs)
        level = y + A @ x
        residual = level - (select @ level / np.maximum(mass, 1e-9))[point]
        w = 1 / (1 + (residual / 0.25) ** 2)
    return np.asarray(x)
