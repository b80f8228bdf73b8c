"""Heights of several pairs of photos, put together on the cells of a map."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface
from skyquilt.ortho.fill import FIRM, bands

Array = NDArray[np.float64]
Float = NDArray[np.float32]
Mask = NDArray[np.bool_]
Cells = tuple[NDArray[np.int32], Float]
"""Numbers (n,) of cells of a grid, row by row, and their heights (n,) in m."""


def inside(heights: Cells, width: int, row: int, column: int, h: int, w: int) -> Cells:
    """Those heights of a grid `width` cells wide that lie in a part of it, numbered there."""
    r, c = heights[0] // width - row, heights[0] % width - column
    mine = (r >= 0) & (r < h) & (c >= 0) & (c < w)
    return r[mine] * np.int32(w) + c[mine], heights[1][mine]


def splatted(points: Float, origin: Array, part: Grid) -> Cells:
    """Heights of the cells of a grid that points fall in: in each the mean of those near the
    highest one.
    """
    column = np.floor((points[:, 0] + (origin[0] - part.west)) / part.gsd).astype(np.int32)
    row = np.floor(((part.north - origin[1]) - points[:, 1]) / part.gsd).astype(np.int32)
    mine = (column >= 0) & (column < part.width) & (row >= 0) & (row < part.height)
    if not mine.any():
        return np.zeros(0, np.int32), np.zeros(0, np.float32)
    column, row, z = column[mine], row[mine], points[mine, 2]
    # only the rectangle that this pair shows
    west, wide = int(column.min()), int(np.ptp(column)) + 1
    north, high = int(row.min()), int(np.ptp(row)) + 1
    cell = (row - north) * wide + (column - west)
    top = np.full(high * wide, -np.inf, np.float32)
    np.maximum.at(top, cell, z)
    close = z > top[cell] - 2 * part.gsd
    cell, z = cell[close], z[close]
    number = np.bincount(cell, minlength=len(top))
    known = np.flatnonzero(number)
    mean = np.bincount(cell, z, minlength=len(top))[known] / number[known]
    at = (known // wide + north) * part.width + known % wide + west
    return at.astype(np.int32), (mean + origin[2]).astype(np.float32)


def agreed(heights: Sequence[Cells], step: float, shape: tuple[int, int]) -> Float:
    """Median (h, w) of the heights of each cell; of an even number the lower of the two in the
    middle. NaN where there are none, or where of several none lies within `step` m of it.
    """
    number = np.zeros(shape[0] * shape[1], np.intp)
    for cell, _ in heights:
        number[cell] += 1
    ordered = np.full((int(number.max(initial=0)), len(number)), np.nan, np.float32)
    if not len(ordered):
        return np.full(shape, np.nan, np.float32)
    number[:] = 0
    for cell, z in heights:
        ordered[number[cell], cell] = z
        number[cell] += 1
    ordered.sort(axis=0)
    z = np.take_along_axis(ordered, np.maximum(number - 1, 0)[None] // 2, 0)[0]
    with np.errstate(invalid="ignore"):
        close = (np.abs(ordered - z) < step).sum(0)
    z = np.where((number > 1) & (close < 2), np.float32(np.nan), z)
    return np.asarray(z.reshape(shape))


def with_coarse(z: Float, known: Mask, rough: Surface, cells: Grid, side: int) -> Float:
    """Fine heights (h, w), smoothed, where enough of the window of `side` cells around has some of
    its own; the coarse ones elsewhere. Cliffs of these stay as steep as the cells allow.
    """
    x, y = cells.x(np.arange(cells.width)), cells.y(np.arange(cells.height))
    out = np.empty((cells.height, cells.width), np.float32)[::-1]  # as `surface_of` turns it
    for rows, around, inner in bands(cells.height, side // 2 + 1):
        share = cv2.boxFilter(known[around].view(np.uint8), cv2.CV_32F, (side, side))
        former = cv2.medianBlur(_stepwise(rough, x, y[around]), 3)
        fine = cv2.medianBlur(z[around], 3)
        out[rows] = np.where(share > FIRM, fine, former)[inner]
    return out


def _stepwise(surface: Surface, x: NDArray[Any], y: NDArray[Any]) -> Float:
    """Heights (h, w) of the nearest cells of a surface, at x (w,) and y (h,)."""
    column = np.rint((x - surface.x0) / surface.cell).astype(np.int64)
    row = np.rint((y - surface.y0) / surface.cell).astype(np.int64)
    rows, columns = surface.z.shape
    return surface.z[np.clip(row, 0, rows - 1)][:, np.clip(column, 0, columns - 1)]


def without_specks(z: Float, step: float, least: int) -> Mask:
    """Which heights (h, w) are kept: those of patches of at least `least` cells whose neighbours
    differ by less than `step` m.
    """
    known = np.isfinite(z)
    if not known.any():
        return known
    base = float(np.nanmin(z))
    scale = min(100.0, 30000 / max(float(np.nanmax(z)) - base, 1e-6))
    kept = np.empty_like(known)
    for rows, around, inner in bands(len(z), least):  # a patch that reaches beyond is large enough
        own, levels = known[around], np.full(known[around].shape, -1000, np.int16)
        levels[own] = (z[around][own] - base) * scale + 1
        cv2.filterSpeckles(levels, -1000, least, step * scale)
        kept[rows] = levels[inner] >= 0
    return kept


def surface_of(z: Float, cells: Grid) -> Surface:
    """The surface of heights (rows, columns) in m of cells, row 0 in the north, without gaps."""
    return Surface(
        z=np.ascontiguousarray(z[::-1]),
        x0=float(cells.x(np.array(0))),
        y0=float(cells.y(np.array(cells.height - 1))),
        cell=cells.gsd,
        source="multi-view matching",
    )
