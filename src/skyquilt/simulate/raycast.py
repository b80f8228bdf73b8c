"""Intersections of rays with a height field: first hits, so that trees and walls hide what is
behind them.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.simulate.grid import Doubles, Floats

FLATTEST = 3.7
"""Horizontal over vertical part of the flattest rays that are intersected with the raster: 75
degrees from the vertical.
"""
# px: side of the cells in which hits are first bracketed, in the photo and in the raster
_CELL = 16
_LEVEL_M = 0.35  # height between two levels of the bracketing march
_STEP_PX = 2.0  # raster px between two samples of the exact march
_MAX_STEPS = 128
_WORTH = 0.75  # rays are taken out of the march when this share of them goes on
_TOGETHER = 1 << 15  # rays that march together: their numbers stay in the processor's cache


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """Straight lines through a raster, parametrised by height: pixel(z) = start - z * slope."""

    start: Floats
    """(..., 2) raster pixel (column, row) at height 0."""
    slope: Floats
    """(..., 2) raster pixels per metre of height."""

    def at(self, z: Floats) -> Floats:
        """Raster pixels (..., 2) at heights (...)."""
        return self.start - z[..., None] * self.slope

    def coarse(self) -> "Rays":
        """One ray per cell, at its centre."""
        h, w = self.start.shape[:2]
        rows = np.minimum(np.arange(_CELL // 2, h + _CELL - 1, _CELL), h - 1)
        cols = np.minimum(np.arange(_CELL // 2, w + _CELL - 1, _CELL), w - 1)
        at = np.ix_(rows, cols)
        return Rays(start=self.start[at], slope=self.slope[at])


def rays_of(
    directions: Floats, rotation: Doubles, centre: Doubles, origin: Doubles, res: float
) -> Rays:
    """Rays of undistorted image coordinates (h, w, 2) from a camera.

    `origin` is the map position of raster pixel (0, 0); rotation (3, 3) from map to camera and
    centre (3,), or one for each row, (h, 1, 3, 3) and (h, 1, 3).

    Heights refer to the same zero as centre[2]. Rays flatter than `FLATTEST`, and those to the sky,
    are steepened to it: what they show is no matter of the raster (`simulate.horizon`).
    """
    to_map = rotation.astype(np.float32)
    x, y = directions[..., 0], directions[..., 1]
    dx, dy, dz = (
        to_map[..., 0, i] * x + to_map[..., 1, i] * y + to_map[..., 2, i] for i in range(3)
    )
    down = np.maximum(-dz, np.hypot(dx, dy) / np.float32(FLATTEST))
    slope = np.stack([dx, -dy], axis=-1) / (down * np.float32(res))[..., None]
    place = np.stack(
        [(centre[..., 0] - origin[0]) / res, (origin[1] - centre[..., 1]) / res], axis=-1
    ).astype(np.float32)
    return Rays(start=place + centre[..., 2, None].astype(np.float32) * slope, slope=slope)


def sample(
    raster: NDArray[Any], pixels: Floats, interpolation: int = cv2.INTER_LINEAR
) -> NDArray[Any]:
    """Values of a raster at pixels (h, w, 2) or (n, 2); outside, the nearest edge value."""
    if pixels.ndim == 3:
        return _remap(raster, pixels, interpolation)
    # lists are reshaped to several columns, since images have at most 32767 rows
    count, wide = len(pixels), 1024
    folded = np.zeros((-(-count // wide), wide, 2), dtype=np.float32)
    folded.reshape(-1, 2)[:count] = pixels
    values = _remap(raster, folded, interpolation)
    return values.reshape(-1, *values.shape[2:])[:count]


def _remap(raster: NDArray[Any], pixels: Floats, interpolation: int) -> NDArray[Any]:
    x, y = cv2.split(pixels)
    return np.asarray(cv2.remap(raster, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE))


def _cells(raster: Floats, reach: int) -> tuple[Floats, Floats]:
    """Least and greatest height per cell of the raster, over `reach` cells around it as a
    margin.
    """
    h, w = raster.shape
    padded = np.pad(raster, ((0, -h % _CELL), (0, -w % _CELL)), mode="edge")
    blocks = padded.reshape(padded.shape[0] // _CELL, _CELL, padded.shape[1] // _CELL, _CELL)
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
    low, high = blocks.min(axis=(1, 3)), blocks.max(axis=(1, 3))
    return np.asarray(cv2.erode(low, kernel)), np.asarray(cv2.dilate(high, kernel))


def _bracket(raster: Floats, rays: Rays) -> tuple[Floats, Floats]:
    """Heights (cells) above and below all first hits of a cell's rays."""
    low, high = _cells(raster, _reach(rays))
    top, bottom = float(high.max()) + 0.05, float(low.min()) - 0.05
    levels = np.linspace(top, bottom, int(np.ceil((top - bottom) / _LEVEL_M)) + 2, dtype=np.float32)
    above = np.full(rays.start.shape[:2], np.nan, dtype=np.float32)
    below = np.full(rays.start.shape[:2], np.nan, dtype=np.float32)
    for upper, lower in pairwise(levels):
        cell = rays.at(np.full_like(above, lower)) / np.float32(_CELL) - np.float32(
            0.5 - 0.5 / _CELL
        )
        highest = sample(high, cell, cv2.INTER_NEAREST)
        lowest = sample(low, cell, cv2.INTER_NEAREST)
        above = np.where(np.isnan(above) & (highest >= lower), upper, above)
        below = np.where(np.isnan(below) & (lowest >= lower), lower - np.float32(0.02), below)
    return np.where(np.isnan(above), top, above), np.where(np.isnan(below), bottom, below)


def _reach(rays: Rays) -> int:
    """Cells of the raster that the rays around a cell's own lie away at most: more in oblique
    photos.
    """
    apart = [np.abs(np.diff(rays.start, axis=a)).max(initial=0.0) for a in (0, 1)]
    return int(np.clip(np.ceil(0.6 * float(max(apart)) / _CELL) + 1, 2, 40))


def _march(raster: Floats, lines: Floats, above: Floats, below: Floats, steps: int) -> Floats:
    """Heights (n,) of first hits between two heights (n,) per ray: even steps, then false
    position.

    `lines` (4, n): column and row of each ray at height 0, and by how much they fall per metre.
    """
    z_over, z_under = above.copy(), below.copy()
    f_over = np.full_like(above, -1e-3)
    f_under = np.full_like(above, 1e-3)
    step = (above - below) / np.float32(steps)
    # those that go on: their numbers, lines, begin and step, whether they have had no hit so far
    left, going, begin = np.arange(len(above)), lines, above
    open_: NDArray[np.bool_] = np.ones(len(above), dtype=bool)
    z, f = above, f_over
    for k in range(1, steps + 1):
        z_before, f_before, z = z, f, begin - np.float32(k) * step
        f = _surface(raster, going, z) - z
        ended = np.flatnonzero(open_ & (f >= 0))
        z_under[left[ended]], f_under[left[ended]] = z[ended], f[ended]
        z_over[left[ended]], f_over[left[ended]] = z_before[ended], f_before[ended]
        open_[ended] = False
        count = np.count_nonzero(open_)
        if not count:
            return _polish(raster, lines, z_over, z_under, f_over, f_under)
        if count < _WORTH * len(left):
            left, going, begin = left[open_], going[:, open_], begin[open_]
            step, z, f, open_ = step[open_], z[open_], f[open_], np.ones(count, dtype=bool)
    z_over[left[open_]], f_over[left[open_]] = z[open_], f[open_]
    return _polish(raster, lines, z_over, z_under, f_over, f_under)


def _surface(raster: Floats, lines: Floats, z: Floats) -> Floats:
    """Heights (n,) of the raster where rays have the heights z (n,)."""
    x, y = (np.subtract(lines[i], a, out=a) for i, a in enumerate((z * lines[2], z * lines[3])))
    count, wide = len(z), 1024  # lists as rows of this length: images have at most 32767
    rows = -(-count // wide)
    if rows * wide > count:
        x, y = (np.concatenate([a, np.zeros(rows * wide - count, np.float32)]) for a in (x, y))
    values = cv2.remap(
        raster, x.reshape(rows, wide), y.reshape(rows, wide), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(values, np.float32).reshape(-1)[:count]


def _polish(
    raster: Floats, lines: Floats, z_over: Floats, z_under: Floats, f_over: Floats, f_under: Floats
) -> Floats:
    """Refines the intersection between heights above and below the surface."""
    for k in range(5):
        share = np.float32(0.5) if k in (0, 2) else _share(f_over, f_under, 0.02, 0.98)
        z = z_over + (z_under - z_over) * share
        f = _surface(raster, lines, z) - z
        hit = f >= 0
        z_under, f_under = np.where(hit, z, z_under), np.where(hit, f, f_under)
        z_over, f_over = np.where(hit, z_over, z), np.where(hit, f_over, f)
    return np.asarray(z_over + (z_under - z_over) * _share(f_over, f_under, 0.0, 1.0))


def _share(f_over: Floats, f_under: Floats, least: float, most: float) -> Floats:
    """Where (n,) between two heights the surface is met, if it is straight between them."""
    share = f_over - f_under
    share -= np.float32(1e-9)
    np.divide(f_over, share, out=share)
    np.maximum(share, np.float32(least), out=share)
    return np.minimum(share, np.float32(most), out=share)


def first_hits(raster: Floats, rays: Rays) -> tuple[Floats, Floats]:
    """Raster pixels (h, w, 2) and heights (h, w) where the rays of a photo first meet the height
    raster.
    """
    h, w = rays.start.shape[:2]
    coarse = rays.coarse()
    above, below = _bracket(raster, coarse)
    travel = (above - below) * np.linalg.norm(coarse.slope, axis=-1) / _STEP_PX
    steps = 2 ** np.ceil(np.log2(np.clip(travel, 1, _MAX_STEPS))).astype(np.int32)
    above, below, steps = (_spread(a, h, w).ravel() for a in (above, below, steps))
    lines = np.stack([a[..., i].ravel() for a in (rays.start, rays.slope) for i in (0, 1)])
    heights = np.empty(h * w, dtype=np.float32)
    for count in np.unique(steps):
        alike = np.flatnonzero(steps == count)
        for k in range(0, len(alike), _TOGETHER):
            some = alike[k : k + _TOGETHER]
            heights[some] = _march(raster, lines[:, some], above[some], below[some], int(count))
    hits = np.stack([lines[i] - heights * lines[2 + i] for i in (0, 1)], axis=-1)
    return hits.reshape(h, w, 2), heights.reshape(h, w)


def _spread(cells: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """Repeats cell values for their pixels."""
    return np.repeat(np.repeat(cells, _CELL, axis=0), _CELL, axis=1)[:height, :width]
