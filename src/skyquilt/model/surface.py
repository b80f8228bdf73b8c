"""The height surface over which photos are orthorectified."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

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
        column = ((np.asarray(x) - self.x0) / self.cell).astype(np.float32)
        row = ((np.asarray(y) - self.y0) / self.cell).astype(np.float32)
        if column.ndim != 2:
            column, row = column.reshape(1, -1), row.reshape(1, -1)
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
        return np.concatenate(parts, 1, dtype=np.float32).reshape(shape)

    def on(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float32]:
        """Heights (rows, columns) in m on a raster whose columns lie at x (columns,) and whose rows
        lie at y (rows,); memory holds little more than the result.
        """
        out = np.empty((len(y), len(x)), np.float32)
        for low, high in pairwise([*range(0, len(y), STRIP), len(y)]):
            out[low:high] = self.at(*np.meshgrid(x, y[low:high]))
        return out


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
