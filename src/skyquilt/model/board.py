"""A chess-board, and what a frame shows of it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Board:
    """A flat chess-board, counted in squares. *board*: x along a row, y along a column, z away from
    the viewer, in m; the origin is the outer corner of the first square.
    """

    columns: int
    """Squares along x, at least 3."""
    rows: int
    """Squares along y, at least 3."""
    square_m: float
    """Side of a square in m."""

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or not self.square_m > 0:
            raise ValueError(f"a board has 3 x 3 squares or more, and a size; got {self}")

    @property
    def centres(self) -> Array:
        """Centres of the squares (rows, columns, 3) in m."""
        return self._points(np.arange(self.columns) + 0.5, np.arange(self.rows) + 0.5)

    @property
    def corners(self) -> Array:
        """Inner corners (rows - 1, columns - 1, 3) in m."""
        return self._points(np.arange(1.0, self.columns), np.arange(1.0, self.rows))

    @property
    def inner(self) -> NDArray[np.bool_]:
        """(rows, columns): squares with a neighbour on each of their sides."""
        inside = np.zeros((self.rows, self.columns), bool)
        inside[1:-1, 1:-1] = True
        return inside

    def _points(self, x: NDArray[Any], y: NDArray[Any]) -> Array:
        xx, yy = np.meshgrid(x, y)
        return np.stack([xx, yy, np.zeros_like(xx)], -1) * self.square_m


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardView:
    """A board found in a frame, or in the picture assembled from a series of frames of one pose."""

    name: str
    """Frame or series."""
    width: int
    """Of the frame in px."""
    height: int
    """Of the frame in px."""
    centroids: Array
    """Centroids of the squares' images (rows, columns, 2) in px, before the correction for
    perspective; NaN where a square could not be measured.
    """
    corners: Array
    """Inner corners (rows - 1, columns - 1, 2) in px."""
    rounding_px: Array
    """Radii (rows, columns) by which the corners of the squares' images were rounded off before
    their centroids were taken.
    """
    contrast: float
    """Brightness of white squares minus that of black squares, in units of the frame's own
    noise.
    """
    frames: int = 1
    """Frames it was assembled from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RejectedView:
    """A frame without a usable board. False in `if`, where a view is true."""

    name: str
    """Frame or series."""
    reason: str
    """The reason as the end of a sentence: 'X was left out: ...'."""

    def __bool__(self) -> bool:
        return False
