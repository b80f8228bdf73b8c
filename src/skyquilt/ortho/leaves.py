"""Heights in leaves made calm, where few places have a height on which photos agree.

Between these, heights are those of whole crowns and of single leaves, full of slopes and lumps that
are not there. A photo drawn on a steep slope is smeared into streaks, and a lump becomes a piece of
a crown that lies apart. So steep places there become level over the size of a crown, and what stays
steep becomes a step, on which a photo is drawn cleanly (`model.height_steps`). What many places
agree on, roofs and the rims of single trees, is left alone.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.ortho.fill import plateaus

Float = NDArray[np.float32]
Mask = NDArray[np.bool_]
TILE = 512
"""Cells along a side of the pieces that are made calm at once."""
AROUND = 9
"""Side in cells of the window in which places with a height of their own are counted."""
LOOSE = 0.4
"""Share of them below which heights are not believed in detail."""
SOME = 0.02
"""Least share within the size of a crown: beyond what two photos show, heights are smooth."""
STEEP = 1.0
"""Slope from which photos are smeared."""
WIDER = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
"""Cells around steep ones that are changed with them."""
WIDEST = 255
"""Largest window in cells of OpenCV's median; cells far finer than the photos ask for more."""
ROUNDS = 2
"""How often steep places are made level."""
SHARPER = 5
"""Cells on either side by which a slope that is left is narrowed to a step."""
SOFT = 2.0
"""Standard deviation in cells of the smoothing that tells the upper part of a slope from the lower.
"""


def calmed(z: Float, known: Mask, cell: float, side: int) -> Float:
    """Heights (h, w) in m of cells of `cell` m, calm where few of the cells around were `known`;
    `side`: size of a crown in cells, an odd number. The array itself is changed, and returned.
    """
    side = min(side, WIDEST)
    beyond = ROUNDS * side + AROUND + SHARPER + int(4 * SOFT)
    done = []  # tiles are written when no other one looks at them any more
    for row in range(0, z.shape[0], TILE):
        for column in range(0, z.shape[1], TILE):
            (rows, r), (columns, c) = (_reach(at, beyond) for at in (row, column))
            heights = _calm(z[rows, columns], known[rows, columns], cell, side)
            if heights is not None:
                done.append((row, column, heights[r, c].copy()))
    for row, column, heights in done:
        z[row : row + TILE, column : column + TILE] = heights
    return z


def _reach(at: int, beyond: int) -> tuple[slice, slice]:
    """The cells around those of a tile along one axis, and the tile's own among them."""
    first = max(0, at - beyond)
    return slice(first, at + TILE + beyond), slice(at - first, at - first + TILE)


def _calm(z: Float, known: Mask, cell: float, side: int) -> Float | None:
    """The calm heights (h, w); None where nothing changes."""
    near, wide = (cv2.boxFilter(known.view(np.uint8), cv2.CV_32F, (n, n)) for n in (AROUND, side))
    loose: Any = (near < LOOSE) & (wide > SOME)
    if not _steep(z, loose, cell).any():
        return None
    for _ in range(ROUNDS):
        level = plateaus(z, side, float(z.min()), max(float(np.ptp(z)), 1e-6))
        z = np.where(_steep(z, loose, cell), level, z)
    return _sharpened(z, _steep(z, loose, cell))


def _steep(z: Float, loose: Mask, cell: float) -> Mask:
    """The loose places (h, w) at and beside steep ones."""
    scale = 1 / (8 * cell)
    x, y = (cv2.Sobel(z, cv2.CV_32F, *along, scale=scale) for along in ((1, 0), (0, 1)))
    steep = (cv2.magnitude(x, y) > STEEP).view(np.uint8)
    return np.asarray((cv2.dilate(steep, WIDER) > 0) & loose)


def _sharpened(z: Float, where: Mask) -> Float:
    """Heights (h, w) whose slopes are steps (a shock filter: Alvarez and Mazorra 1994): convex
    places go down to the lowest beside them, concave ones up to the highest.
    """
    square = np.ones((3, 3), np.uint8)
    upper = cv2.Laplacian(cv2.GaussianBlur(z, (0, 0), SOFT), cv2.CV_32F) < 0
    for _ in range(SHARPER):
        z = np.where(where, np.where(upper, cv2.dilate(z, square), cv2.erode(z, square)), z)
    return z
