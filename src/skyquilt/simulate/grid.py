"""North-up grids in the local map frame, and windows of these grids."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
"""Mostly float32: rasters and rays."""
Doubles = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A window of an unbounded north-up raster; pixel centres are half a cell inside the edges."""

    left: float
    """Map x of the left edge of column 0 of the unbounded raster, m."""
    top: float
    """Map y of the upper edge of row 0 of the unbounded raster, m."""
    res: float
    """Cell size, m."""
    width: int
    """Columns of this window."""
    height: int
    """Rows of this window."""
    col: int = 0
    """First column of this window in the unbounded raster."""
    row: int = 0
    """First row of this window in the unbounded raster."""

    def window(self, row: int, col: int, height: int, width: int) -> "Grid":
        """A part of this grid, clipped to it; rows and columns count from this grid's own
        corner.
        """
        r0, c0 = max(row, 0), max(col, 0)
        r1, c1 = min(row + height, self.height), min(col + width, self.width)
        return Grid(
            left=self.left,
            top=self.top,
            res=self.res,
            width=max(c1 - c0, 0),
            height=max(r1 - r0, 0),
            col=self.col + c0,
            row=self.row + r0,
        )

    def blocks(self, size: int) -> list["Grid"]:
        """Windows of at most size x size cells that cover this grid, row by row."""
        rows, cols = range(0, self.height, size), range(0, self.width, size)
        return [self.window(r, c, size, size) for r in rows for c in cols]

    @property
    def slices(self) -> tuple[slice, slice]:
        """Slices of this window in an array of the unbounded raster that starts at row 0, column
        0.
        """
        return slice(self.row, self.row + self.height), slice(self.col, self.col + self.width)

    @property
    def xs(self) -> Doubles:
        """Map x of the columns' centres (width,), m."""
        columns = self.col + 0.5 + np.arange(self.width, dtype=np.float64)
        return np.asarray(self.left + columns * self.res)

    @property
    def ys(self) -> Doubles:
        """Map y of the rows' centres (height,), m, decreasing."""
        rows = self.row + 0.5 + np.arange(self.height, dtype=np.float64)
        return np.asarray(self.top - rows * self.res)

    @property
    def span(self) -> tuple[float, float, float, float]:
        """Map x of the first and the last column's centres and y of the first and the last row's,
        m.
        """
        first, last = self.col + 0.5, self.col + 0.5 + (self.width - 1)
        upper, lower = self.row + 0.5, self.row + 0.5 + (self.height - 1)
        return (
            self.left + first * self.res,
            self.left + last * self.res,
            self.top - upper * self.res,
            self.top - lower * self.res,
        )

    def pixels(self, xy: Doubles) -> Doubles:
        """Pixel coordinates (..., 2) as (column, row), centres at integers, of map points (...,
        2).
        """
        xy = np.asarray(xy, dtype=np.float64)
        u = (xy[..., 0] - self.left) / self.res - 0.5 - self.col
        v = (self.top - xy[..., 1]) / self.res - 0.5 - self.row
        return np.stack([u, v], axis=-1)

    def around(self, x: float, y: float, reach: float) -> "Grid":
        """The part of this grid within `reach` m of a point (a square), possibly empty."""
        u, v = self.pixels(np.array([x, y]))
        n = int(np.ceil(reach / self.res)) + 2
        return self.window(int(np.floor(v)) - n, int(np.floor(u)) - n, 2 * n + 2, 2 * n + 2)

    def inside(self, part: "Grid") -> tuple[slice, slice]:
        """Slices of a part (of the same unbounded raster) in an array of this window."""
        r, c = part.row - self.row, part.col - self.col
        return slice(r, r + part.height), slice(c, c + part.width)
