"""The pixel grid of a map, and windows of it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Bounds = tuple[float, float, float, float]
"""West, south, east and north in m in the map frame."""


def meet(a: Bounds, b: Bounds) -> bool:
    """Whether two rectangles share ground."""
    return a[0] < b[2] and a[2] > b[0] and a[1] < b[3] and a[3] > b[1]


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A north-up pixel grid in the map frame; row 0 is the northernmost."""

    west: float
    """Easting of the left edge in m (map frame)."""
    north: float
    """Northing of the top edge in m (map frame)."""
    gsd: float
    """Ground size of a pixel in m."""
    width: int
    """Columns."""
    height: int
    """Rows."""

    def x(self, columns: NDArray[Any]) -> NDArray[np.float64]:
        """Eastings in m of pixel centres."""
        return self.west + (np.asarray(columns, np.float64) + 0.5) * self.gsd

    def y(self, rows: NDArray[Any]) -> NDArray[np.float64]:
        """Northings in m of pixel centres."""
        return self.north - (np.asarray(rows, np.float64) + 0.5) * self.gsd

    def pixel(
        self, x: NDArray[Any], y: NDArray[Any]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Columns and rows (centres at integers) of map coordinates."""
        return (np.asarray(x) - self.west) / self.gsd - 0.5, (
            self.north - np.asarray(y)
        ) / self.gsd - 0.5

    def nearest(self, other: "Grid") -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of this grid nearest to the rows and columns of another."""
        columns, rows = np.arange(other.width), np.arange(other.height)
        c, _ = self.pixel(other.x(columns), np.zeros(other.width))
        _, r = self.pixel(np.zeros(other.height), other.y(rows))
        return (
            np.clip(np.rint(r), 0, self.height - 1).astype(np.int64),
            np.clip(np.rint(c), 0, self.width - 1).astype(np.int64),
        )

    def coarser(self, factor: int) -> "Grid":
        """The same area in pixels `factor` times as large; the last row and column may reach beyond
        it.
        """
        return Grid(
            west=self.west,
            north=self.north,
            gsd=self.gsd * factor,
            width=-(-self.width // factor),
            height=-(-self.height // factor),
        )

    def reaching(self, wanted: "Grid", step: int) -> "Grid":
        """The grid, larger where another one reaches beyond it: west and north by multiples of
        `step` pixels, so that tiles and coarser grids of such steps stay where they are.
        """
        west, south, east, north = wanted.bounds
        w, s, e, n = self.bounds
        left = max(0, int(np.ceil((w - west) / (step * self.gsd) - 1e-9)))
        up = max(0, int(np.ceil((north - n) / (step * self.gsd) - 1e-9)))
        right = max(0, int(np.ceil((east - e) / self.gsd - 1e-6)))
        down = max(0, int(np.ceil((s - south) / self.gsd - 1e-6)))
        return Grid(
            west=w - left * (step * self.gsd),
            north=n + up * (step * self.gsd),
            gsd=self.gsd,
            width=self.width + left * step + right,
            height=self.height + up * step + down,
        )

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north in m (map frame)."""
        return (
            self.west,
            self.north - self.height * self.gsd,
            self.west + self.width * self.gsd,
            self.north,
        )


@dataclass(frozen=True, kw_only=True)
class Window:
    """A rectangle of a grid."""

    row: int
    """First row."""
    column: int
    """First column."""
    height: int
    """Rows."""
    width: int
    """Columns."""

    def grown(self, margin: int) -> "Window":
        """With `margin` px more on each side; may reach beyond the grid."""
        return Window(
            row=self.row - margin,
            column=self.column - margin,
            height=self.height + 2 * margin,
            width=self.width + 2 * margin,
        )
