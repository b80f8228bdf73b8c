"""Contour lines of a raster of heights, by marching squares (Maple 2003)."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shapely import linestrings
from shapely.ops import linemerge

Float = NDArray[np.float32]
# the two sides of a square that a contour joins, by which of its corners are higher: upper left 1,
# upper right 2, lower right 4, lower left 8; sides: 0 upper, 1 right, 2 lower, 3 left
SIDES = {
    1: ((3, 0),),
    2: ((0, 1),),
    3: ((3, 1),),
    4: ((1, 2),),
    5: ((3, 0), (1, 2)),
    6: ((0, 2),),
    7: ((3, 2),),
    8: ((2, 3),),
    9: ((2, 0),),
    10: ((0, 1), (2, 3)),
    11: ((2, 1),),
    12: ((1, 3),),
    13: ((1, 0),),
    14: ((0, 3),),
}
SHORTEST = 8
"""Fewest points of a contour line that is kept."""


def contour_lines(z: Float, step: float) -> Iterator[tuple[NDArray[np.float64], float]]:
    """Lines (n, 2) of columns and rows of a raster (h, w), centres at integers, and their heights:
    the multiples of `step`. NaN = unknown; lines end there.
    """
    low, high = float(np.nanmin(z)), float(np.nanmax(z))
    for number in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1):
        height = number * step
        segments = _segments(z, height)
        if not len(segments):
            continue
        merged = linemerge(list(linestrings(segments)))
        for line in getattr(merged, "geoms", [merged]):
            if len(line.coords) >= SHORTEST:
                yield np.asarray(line.coords), height


def _segments(z: Float, height: float) -> NDArray[np.float64]:
    """(n, 2, 2) pieces of a contour, each within a square of four neighbouring cells."""
    corners = [z[:-1, :-1], z[:-1, 1:], z[1:, 1:], z[1:, :-1]]
    whole = np.isfinite(corners).all(0)
    case = sum((c > height).astype(np.int8) << k for k, c in enumerate(corners))
    pieces = []
    for which, pairs in SIDES.items():
        row, column = np.nonzero(whole & (case == which))
        if len(row):
            for a, b in pairs:
                ends = [_crossing(z, height, row, column, side) for side in (a, b)]
                pieces.append(np.stack(ends, 1))
    return np.concatenate(pieces) if pieces else np.zeros((0, 2, 2))


def _crossing(
    z: Float, height: float, row: NDArray[Any], column: NDArray[Any], side: int
) -> NDArray[np.float64]:
    """(n, 2) columns and rows where a contour crosses a side of squares."""
    r, c = row + (side == 2), column + (side == 1)
    across = side in (0, 2)
    first = z[r, c].astype(np.float64)
    second = z[r, c + 1] if across else z[r + 1, c]
    share = (height - first) / (second - first)
    return np.stack([c + share, r + 0.0 * share] if across else [c + 0.0 * share, r + share], 1)
