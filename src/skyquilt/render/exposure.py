"""Exposure: what brings overlapping photos to one brightness, from the ground they both show.

Per photo a gain for each band and a smooth field over the image (vignetting, a cloud's shadow, the sun's
glare). Gains act on the odds x / (1 - x) of a pixel value x in (0, 1), not on the value: black stays black
and white stays white, so nothing clips or turns purple, and two gains in a row are one gain.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from skyquilt.imaging.views import View, project_nodes
from skyquilt.model.surface import Surface

Float = NDArray[np.float32]

SETTLED = 1e-3
"""Change of log odds that no 8-bit level can show."""
SIGMA_LEVEL = 0.15
"""Deviation in log odds of two photos' brightness of one ground point, all else equal."""
EVEN = 0.1
"""Fields smaller than this in log odds everywhere (6 of 255 on a middle grey) are left
alone: it saves time.
"""
CORRELATED = 30.0
"""Neighbouring samples err alike: so many count as one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposure:
    """What brings photos to one brightness: log odds + gain[band] + field . (x, y, x^2, y^2, x y)."""

    gains: Mapping[int, Float]
    """Photo -> (bands,) in log odds."""
    fields: Mapping[int, Float]
    """Photo -> (5,) in log odds, for x and y from -1 to 1 over the image."""
    offsets: Mapping[int, float] = field(default_factory=dict)
    """Photo -> what is added to measured values, in their unit."""

    def uneven(self, photo: int) -> bool:
        """Whether the photo needs more than one gain per band."""
        return bool(np.abs(self.fields[photo]).max() > 0)

    def odds(self, photo: int, x: Float, y: Float) -> Float:
        """Factors (h, w, bands) on the odds at places x, y (h, w) in the image, -1 to 1."""
        field = np.exp(_basis(x, y) @ self.fields[photo])
        return (field[..., None] * np.exp(self.gains[photo])).astype(np.float32)

    def table(self, photo: int) -> NDArray[np.uint8] | None:
        """Lookup table (1, 256, bands) of an even photo; None where nothing changes."""
        gains = self.gains[photo]
        return odds_table(gains) if float(np.abs(gains).max()) >= 0.005 else None


def with_odds(pixels: NDArray[np.uint8], odds: Float) -> NDArray[np.uint8]:
    """Pixels (h, w, bands) with their odds multiplied by odds (h, w, bands)."""
    brighter = cv2.multiply(pixels, odds, dtype=cv2.CV_32F).reshape(pixels.shape)
    level: Any = (255.0,) * 4  # a scalar for each band: OpenCV's stubs know arrays only
    white = cv2.add(cv2.subtract(brighter, pixels, dtype=cv2.CV_32F), level).reshape(pixels.shape)
    return np.asarray(cv2.divide(brighter, white, scale=255, dtype=cv2.CV_8U), np.uint8).reshape(pixels.shape)


def _basis(x: NDArray, y: NDArray) -> NDArray:
    """(..., 5) terms of the field."""
    return np.stack([x, y, x * x, y * y, x * y], -1)


def odds_table(gains: Float) -> NDArray[np.uint8]:
    """Lookup table (1, 256, bands) of gains in log odds."""
    x = np.arange(256)[None, :, None] / 255.0
    g = np.exp(gains.astype(np.float64))
    return np.rint(255 * g * x / (1 + (g - 1) * x)).astype(np.uint8)


NEUTRAL = Exposure(gains={}, fields={})
"""No change."""


@dataclass(frozen=True, kw_only=True)
class Balance:
    """Robust least squares of log-odds differences at ground points seen by several photos."""

    points: int = 2500
    """Ground points looked at; more on surveys of many photos."""
    sigma_gain: float = 0.5
    """Prior deviation of a gain in log odds."""
    sigma_field: float = 0.15
    """Prior deviation of a term of the field in log odds."""
    version: ClassVar[int] = 2

    def __call__(
        self, views: Sequence[View], thumbnails: Mapping[int, NDArray[np.uint8]], surface: Surface,
        bounds: tuple[float, float, float, float],
    ) -> Exposure:  # fmt: skip
        """Estimates the exposure from thumbnails (h, w, bands) of the photos."""
        usable = [v for v in views if v.photo in thumbnails]
        if len(usable) < 2:
            return NEUTRAL
        samples = self._samples(usable, thumbnails, surface, bounds)
        if not len(samples.point):
            return NEUTRAL
        return _solve(samples, [v.photo for v in usable], self.sigma_gain, self.sigma_field)

    def _samples(
        self, views: Sequence[View], thumbnails: Mapping[int, NDArray[np.uint8]], surface: Surface,
        bounds: tuple[float, float, float, float],
    ) -> "Samples":  # fmt: skip
        west, south, east, north = bounds
        step = np.sqrt((east - west) * (north - south) / max(self.points, 60 * len(views)))
        x, y = np.meshgrid(np.arange(west, east, step), np.arange(south, north, step))
        z = surface.at(x, y)
        point, row, place, value = [], [], [], []
        for index, view in enumerate(views):
            nodes = project_nodes(view, x, y, z)
            seen = np.flatnonzero(nodes.seen.ravel())
            if not len(seen):
                continue
            u, v = nodes.u.ravel()[seen], nodes.v.ravel()[seen]
            point.append(seen)
            row.append(np.full(len(seen), index))
            place.append(np.stack(image_place(view, u, v), -1))
            value.append(_sampled(thumbnails[view.photo], u, v, view.camera.width, view.camera.height))
        if not point:
            return Samples(
                point=np.zeros(0, int), row=np.zeros(0, int), place=np.zeros((0, 2)), log=np.zeros((0, 3))
            )
        levels = np.concatenate(value)
        good = ((levels > 8) & (levels < 247)).all(1)
        return Samples(
            point=np.concatenate(point)[good], row=np.concatenate(row)[good],
            place=np.concatenate(place)[good], log=np.log(levels[good] / (255 - levels[good])),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Brightness of ground points in photos."""

    point: NDArray[np.int64]
    """(N,) ground point."""
    row: NDArray[np.int64]
    """(N,) view."""
    place: NDArray[np.float64]
    """(N, 2) x and y in the photo, -1 to 1."""
    log: NDArray[np.float64]
    """(N, bands) log odds of the brightness."""


def image_place(view: View, u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    """x and y from -1 to 1 over the image, of photo pixels."""
    w, h = view.camera.width - 1.0, view.camera.height - 1.0
    return np.clip(2 * u / w - 1, -1.1, 1.1), np.clip(2 * v / h - 1, -1.1, 1.1)


def _sampled(
    thumbnail: NDArray[np.uint8], u: NDArray, v: NDArray, width: int, height: int
) -> NDArray[np.float64]:
    """Smoothed thumbnail values (n, bands) at photo pixels."""
    h, w = thumbnail.shape[:2]
    smooth = cv2.GaussianBlur(thumbnail.astype(np.float32), (0, 0), 1.5).reshape(h, w, -1)
    column = np.clip(np.rint((u + 0.5) * w / width - 0.5), 0, w - 1).astype(int)
    row = np.clip(np.rint((v + 0.5) * h / height - 0.5), 0, h - 1).astype(int)
    return smooth[row, column].astype(np.float64)


def _solve(s: Samples, photos: Sequence[int], sigma_gain: float, sigma_field: float) -> Exposure:
    """log odds + gain + field is the same for all photos of a point: differences to the
    point's mean vanish.
    """
    n, N = len(photos), len(s.point)
    _, point = np.unique(s.point, return_inverse=True)
    terms = np.concatenate([np.ones((N, 1)), _basis(s.place[:, 0], s.place[:, 1])], 1)
    columns = 6 * s.row[:, None] + np.arange(6)
    A = sparse.csr_matrix((terms.ravel(), columns.ravel(), 6 * np.arange(N + 1)), (N, 6 * n))
    ridge = np.tile(1 / np.array([sigma_gain] + 5 * [sigma_field]) ** 2, n)
    x = _robust_differences(A, point, s.log.mean(1, keepdims=True), ridge).reshape(n, 6)
    fields = (
        x[:, 1:]
        * (np.abs(_basis(*np.meshgrid([-1, 0, 1], [-1, 0, 1])) @ x[:, 1:].T).max((0, 1)) > EVEN)[:, None]
    )
    even = s.log + (terms[:, 1:] * fields[s.row]).sum(1)[:, None]
    ones = sparse.csr_matrix((np.ones(N), (np.arange(N), s.row)), (N, n))
    gains = _robust_differences(ones, point, even, ridge[::6])
    gains = (gains - np.median(gains, axis=0)).astype(np.float32)
    return Exposure(
        gains=dict(zip(photos, gains, strict=True)),
        fields=dict(zip(photos, fields.astype(np.float32), strict=True)),
    )


def _robust_differences(
    A: sparse.csr_matrix, point: NDArray, y: NDArray, ridge: NDArray
) -> NDArray[np.float64]:
    """x (m, bands) that makes y + A x equal within each point, y (N, bands), reweighted against moving things
    and shadows, which all bands see.
    """
    w = np.ones(len(y))
    x = np.zeros((A.shape[1], y.shape[1]))
    for _ in range(6):
        mass = np.bincount(point, w)
        share = sparse.csr_matrix((w / np.maximum(mass, 1e-9)[point], (point, np.arange(len(y)))))
        mean_A, mean_y = share @ A, share @ y
        normal = A.T @ A.multiply(w[:, None]) - mean_A.T @ mean_A.multiply(mass[:, None])
        rhs = -(A.T @ (w[:, None] * y) - mean_A.T @ (mass[:, None] * mean_y))
        normal = normal + sparse.diags(ridge * SIGMA_LEVEL**2 * CORRELATED)
        before, x = x, sparse_linalg.splu(normal.tocsc()).solve(rhs)
        if np.abs(x - before).max() < SETTLED:
            break
        level = y + A @ x
        residual = level - (share @ level)[point]
        w = 1 / (1 + (residual**2).mean(1) / 0.25**2)
    return np.asarray(x)
