"""The height surface over which photos are orthorectified."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.model.height_steps import MARGIN, steep, with_steps
from skyquilt.model.raster import Grid

WIDEST = 32_000
"""Most cells of a raster of heights along a side: OpenCV's functions take at most 32,766."""
MOST_CELLS = 2.4e7
"""Most cells of a raster of heights, or of what is decided by them."""
STRIP = 256
"""Rows of a raster that are computed at once."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Heights on a regular grid in the map frame; row 0 is the southernmost."""

    z: NDArray[np.float32]
    """(rows, cols) heights in m above the frame's vertical datum, no gaps."""
    x0: float
    """Easting of column 0 in m (map frame)."""
    y0: float
    """Northing of row 0 in m (map frame)."""
    cell: float
    """Spacing in m."""
    source: str
    """What it was made from: `tie points` or `plane`."""

    def at(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float32]:
        """Heights in m at map coordinates of any shape, bilinear; beyond the border the nearest
        height.
        """
        shape = np.shape(x)
        column, row = self._column(x), self._row(y)
        if column.ndim != 2:
            column, row = column.reshape(1, -1), row.reshape(1, -1)
        return self._between(column, row).reshape(shape)

    def _column(self, x: NDArray[Any]) -> NDArray[np.float32]:
        return ((np.asarray(x) - self.x0) / self.cell).astype(np.float32)

    def _row(self, y: NDArray[Any]) -> NDArray[np.float32]:
        return ((np.asarray(y) - self.y0) / self.cell).astype(np.float32)

    def _between(
        self, column: NDArray[np.float32], row: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Bilinear heights at columns and rows (h, w) of the surface."""
        if not column.size:
            return np.zeros(column.shape, np.float32)
        parts = []
        for k in range(0, column.shape[1], 30000):  # remap's maps must stay below 32768 columns
            parts.append(
                cv2.remap(
                    self.z,
                    column[:, k : k + 30000],
                    row[:, k : k + 30000],
                    cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE,
                )
            )
        if len(parts) == 1:
            return np.asarray(parts[0], np.float32)
        return np.concatenate(parts, 1, dtype=np.float32)

    def on(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float32]:
        """Heights (rows, columns) in m on a raster whose columns lie at x (columns,) and whose rows
        lie at y (rows,): those of `at`, but at steps (`model.height_steps`) every place has the
        height of the upper or of the lower side. Memory holds little more than the result.
        """
        out = np.empty((len(y), len(x)), np.float32)
        for low, high in pairwise([*range(0, len(y), STRIP), len(y)]):
            part = self.stepped(x, y[low:high])
            out[low:high] = self._sloping(x, y[low:high]) if part is None else part
        return out

    def stepped(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float32] | None:
        """The same for a part of a raster; None where heights do not step around it."""
        z, row, column = self._around(x, y)
        if min(z.shape) < 2 or not (squares := steep(z, self.cell)).any():
            return None
        out = self._sloping(x, y)
        rows, columns = (y - self.y0) / self.cell - row, (x - self.x0) / self.cell - column
        with_steps(out, z, squares, rows, columns)
        return out

    def _sloping(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float32]:
        """Bilinear heights (rows, columns) at x (columns,) and y (rows,)."""
        return self._between(*np.meshgrid(self._column(x), self._row(y)))

    def _around(self, x: NDArray[Any], y: NDArray[Any]) -> tuple[NDArray[np.float32], int, int]:
        """The heights on which those in a rectangle depend, and the first row and column of
        them.
        """
        first, last = [], []
        for places, start, size in ((y, self.y0, self.z.shape[0]), (x, self.x0, self.z.shape[1])):
            low, high = ((edge - start) / self.cell for edge in (places.min(), places.max()))
            first.append(int(np.clip(np.floor(low) - MARGIN, 0, max(size - 2, 0))))
            last.append(int(np.clip(np.floor(high) + 2 + MARGIN, 2, size)))
        return self.z[first[0] : last[0], first[1] : last[1]], first[0], first[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class HeightField:
    """Measured heights, with gaps, on a regular grid in the map frame; row 0 is the
    southernmost.
    """

    z: NDArray[np.float32]
    """(rows, cols) heights in m above the frame's vertical datum; meaningless where not `known`."""
    known: NDArray[np.bool_]
    """(rows, cols) where two images agree on the height."""
    x0: float
    """Easting of column 0 in m (map frame)."""
    y0: float
    """Northing of row 0 in m (map frame)."""
    cell: float
    """Spacing in m."""

    def coarser(self, cell: float) -> "HeightField":
        """Means over cells of about the requested size; known where more than 60 % of their heights
        are.
        """
        factor = min(
            1.0, self.cell / cell
        )  # one factor for both axes, so that cells stay square: see `shrunken`
        share, total = (
            np.asarray(cv2.resize(one, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))
            for one in (self.known.astype(np.float32), np.where(self.known, self.z, np.float32(0)))
        )
        size = self.cell / factor
        return HeightField(
            z=(total / np.maximum(share, 1e-3)).astype(np.float32),
            known=share > 0.6,
            x0=self.x0 + (size - self.cell) / 2,
            y0=self.y0 + (size - self.cell) / 2,
            cell=size,
        )


def least_cell(grid: Grid) -> int:
    """The least side of a cell, in map pixels, for which a raster over a map stays below
    `MOST_CELLS`, and each of its sides below `WIDEST`.
    """
    cells = np.sqrt(grid.width * grid.height / MOST_CELLS)
    return int(np.ceil(max(cells, grid.width / WIDEST, grid.height / WIDEST)))
