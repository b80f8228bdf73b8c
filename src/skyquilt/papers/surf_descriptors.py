"""Orientation and descriptors of SURF keypoints from Haar wavelets (Bay et al. 2008, section 4).

The wavelets are differences of the means of squares that are aligned with each keypoint's own
frame. A pyramid of area means contains the means, and one lookup extracts a rotated grid of them.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_BLOCK = 4096
"""Number of keypoints processed at a time, since cv2.remap is limited to 32767 rows."""
_GRID = 20
"""Samples along the descriptor's window of 20 sigma."""
_SECTORS = 72
"""Directions in which the window of 60 degrees is tried."""


@dataclass(frozen=True, eq=False)
class Means:
    """An image's area means: level 2 o is reduced by 2**o; level 2 o + 1 is the same, slightly
    smoothed.
    """

    grey: NDArray[np.uint8]
    """(H, W)."""

    @cached_property
    def levels(self) -> list[tuple[int, Floats]]:
        """(reduction, image) from fine to coarse, until few pixels are left."""
        levels: list[tuple[int, Floats]] = []
        image: Floats = self.grey.astype(np.float32)
        factor = 1
        while True:
            levels += [
                (factor, image),
                (factor, np.asarray(cv2.GaussianBlur(image, (3, 3), 0.7), np.float32)),
            ]
            if min(image.shape) < 16:
                return levels
            factor *= 2
            size = (-(-image.shape[1] // 2), -(-image.shape[0] // 2))
            even = cv2.copyMakeBorder(
                image, 0, image.shape[0] % 2, 0, image.shape[1] % 2, cv2.BORDER_REPLICATE
            )
            image = np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA), np.float32)

    def grids(
        self, xy: NDArray[Any], sigma: NDArray[Any], angle: NDArray[Any], size: int
    ) -> Floats:
        """(N, size, size) means of squares of about sigma px, sigma apart, around xy (N, 2),
        rotated by angle (N,).
        """
        # one level smoother than sigma requires: blurred photos match better, others as well
        level = (
            np.floor(2 * np.log2(np.maximum(sigma, 1)) + 1)
            .astype(int)
            .clip(0, len(self.levels) - 1)
        )
        out = np.empty((len(xy), size, size), np.float32)
        for k in np.unique(level):
            factor, image = self.levels[k]
            chosen = np.flatnonzero(level == k)
            for some in np.array_split(chosen, -(-len(chosen) // _BLOCK)):
                place = ((xy[some] + 0.5) / factor - 0.5).astype(np.float32)
                out[some] = _lookup(image, place, sigma[some] / factor, angle[some], size)
        return out


def _lookup(
    image: Floats, xy: Floats, sigma: NDArray[Any], angle: NDArray[Any], size: int
) -> Floats:
    ticks = np.arange(size, dtype=np.float32) - np.float32((size - 1) / 2)
    c, s = ((sigma * f(angle)).astype(np.float32)[:, None, None] for f in (np.cos, np.sin))
    across, down = ticks[None, None, :], ticks[None, :, None]
    x = (c * across - s * down + xy[:, 0, None, None]).reshape(len(xy), -1)
    y = (s * across + c * down + xy[:, 1, None, None]).reshape(len(xy), -1)
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, np.float32).reshape(-1, size, size)


def orientations(means: Means, xy: NDArray[Any], sigma: NDArray[Any]) -> NDArray[np.float64]:
    """(N,) rad, from x towards y: wavelets of 4 sigma within 6 sigma, the strongest sum in a window
    of 60 degrees.
    """
    g = means.grids(xy, sigma, np.zeros(len(xy)), 16)
    columns, rows = g[:, :, 1:] + g[:, :, :-1], g[:, 1:] + g[:, :-1]
    dx = _four(columns[:, :, 2:] - columns[:, :, :-2], 1)  # (N, 13, 13) at -6..6
    dy = _four(rows[:, 2:] - rows[:, :-2], 2)
    ticks = np.arange(-6, 7)
    far = np.hypot(ticks[:, None], ticks)
    inside = far <= 6
    weight = np.exp(-(far[inside] ** 2) / (2 * 2.5**2)).astype(np.float32)
    dx, dy = dx[:, inside] * weight, dy[:, inside] * weight
    return _dominant(dx, dy)


def _four(values: Floats, axis: int) -> Floats:
    """Sums of four neighbours along an axis."""
    two = values[:, 1:] + values[:, :-1] if axis == 1 else values[:, :, 1:] + values[:, :, :-1]
    return two[:, 2:] + two[:, :-2] if axis == 1 else two[:, :, 2:] + two[:, :, :-2]


def _dominant(dx: Floats, dy: Floats) -> NDArray[np.float64]:
    if not len(dx):
        return np.zeros(0)
    sector = (
        np.floor(np.asarray(cv2.phase(dx, dy)) * np.float32(_SECTORS / (2 * np.pi))).astype(
            np.int32
        )
        % _SECTORS
    )
    index = (sector + np.arange(len(dx), dtype=np.int32)[:, None] * _SECTORS).ravel()
    width, sums = _SECTORS // 6, []
    for d in (dx, dy):
        histogram = np.bincount(index, d.ravel(), len(dx) * _SECTORS).reshape(len(dx), _SECTORS)
        running = np.cumsum(
            np.concatenate([np.zeros((len(dx), 1)), histogram, histogram[:, : width - 1]], 1), 1
        )
        sums.append(running[:, width:] - running[:, :-width])
    best = (sums[0] ** 2 + sums[1] ** 2).argmax(1)
    rows = np.arange(len(dx))
    return np.asarray(np.arctan2(sums[1][rows, best], sums[0][rows, best]))


def descriptors(
    means: Means, xy: NDArray[Any], sigma: NDArray[Any], angle: NDArray[Any], *, extended: bool
) -> Floats:
    """(N, 64) of unit length, (N, 128) if `extended`: sums of wavelets and of their absolute values
    in 4 x 4 fields.
    """
    g = means.grids(xy, sigma, angle, _GRID + 1)
    columns, rows = g[:, :, 1:] - g[:, :, :-1], g[:, 1:] - g[:, :-1]
    dx = (columns[:, 1:] + columns[:, :-1]).reshape(-1, _GRID * _GRID)
    dy = (rows[:, :, 1:] + rows[:, :, :-1]).reshape(-1, _GRID * _GRID)
    if extended:  # the sums of one direction separately for each sign of the other
        right, down = dx >= 0, dy >= 0
        parts = [
            np.where(sign, d, 0)
            for d, other in ((dx, down), (dy, right))
            for sign in (other, ~other)
        ]
    else:
        parts = [dx, dy]
    fields = np.stack([p @ _FIELDS for q in parts for p in (q, np.abs(q))], -1).reshape(
        -1, 32 * len(parts)
    )
    return np.asarray(
        fields / np.maximum(np.linalg.norm(fields, axis=1, keepdims=True), np.float32(1e-12))
    )


def _fields() -> Floats:
    """(400, 16) weight of each wavelet in each field: a Gaussian of 3.3 sigma; wavelets are shared
    by neighbouring fields.
    """
    ticks = np.arange(_GRID) - (_GRID - 1) / 2
    centres = (np.arange(4) - 1.5) * 5
    share = np.maximum(1 - np.abs(ticks[:, None] - centres) / 5, 0)  # (20, 4)
    bell = np.exp(-(ticks[:, None] ** 2 + ticks**2) / (2 * 3.3**2))
    weight = bell[:, :, None, None] * share[:, None, :, None] * share[None, :, None, :]
    return weight.reshape(_GRID * _GRID, 16).astype(np.float32)


_FIELDS = _fields()
