"""Heights at steps: walls, eaves and the rims of crowns between the cells of a surface.

Between heights that lie far apart a straight line would be a slope that is not there: a photo
drawn on it shows a strip of itself compressed into a line. There each place belongs to the upper or
to the lower side, and its height is interpolated from the corners on that side. The edge between
both runs where softened heights cross the middle of the square's, so it does not follow the
staircase of the cells.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]
Mask = NDArray[np.bool_]
STEP = 5.0
"""Heights around a square of four that lie further apart than this number of cells are a step.
Slopes of roofs and the sides of crowns stay slopes.
"""
SOFT = 5
"""Side in cells of the window over which heights are softened to find where an edge runs."""
MARGIN = SOFT // 2
"""Cells around a place on which its height depends, beyond the four nearest."""
LEAST = 0.1
"""An edge keeps from corners on the other side at least about this share of a cell."""


def steep(z: Float, cell: float) -> Mask:
    """(r - 1, c - 1) the squares between heights z (r, c) in m of cells of `cell` m that have a
    step.
    """
    low, high = _range(z)
    return np.asarray(high - low > STEP * cell)


def _range(z: Float) -> tuple[Float, Float]:
    """Lowest and highest corner (r - 1, c - 1) of each square."""
    low, high = np.minimum(z[1:], z[:-1]), np.maximum(z[1:], z[:-1])
    return np.minimum(low[:, 1:], low[:, :-1]), np.maximum(high[:, 1:], high[:, :-1])


def with_steps(
    out: Float, z: Float, squares: Mask, rows: NDArray[Any], columns: NDArray[Any]
) -> None:
    """Replaces the heights `out` (h, w), contiguous, of places in squares with a step; their rows
    (h,) and columns (w,) are counted in the heights z (r, c).
    """
    i, fr = _split(rows, z.shape[0])
    j, fc = _split(columns, z.shape[1])
    at = np.flatnonzero(squares.take(i, 0).take(j, 1))
    if not len(at):
        return
    r = at // len(j)
    c = at - r * len(j)
    # a square's corners: heights, and by how much their softened heights are above its middle
    soft = cv2.GaussianBlur(z, (SOFT, SOFT), 0, borderType=cv2.BORDER_REPLICATE)
    low, high = _range(z)
    middle, least = (low + high) / 2, LEAST * (high - low)
    h, w = low.shape
    corner = np.empty((h * w, 8), np.float32)
    for k, (down, right) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        part = (slice(down, down + h), slice(right, right + w))
        s = soft[part] - middle
        s = np.where(z[part] > middle, np.maximum(s, least), np.minimum(s, -least))
        corner[:, k], corner[:, 4 + k] = z[part].ravel(), s.ravel()
    corner = corner.take((i * w).take(r) + j.take(c), 0)
    fr, fc = fr.take(r), fc.take(c)
    weight = np.empty((len(at), 4), np.float32)
    np.multiply(fr, fc, out=weight[:, 3])
    np.subtract(fr, weight[:, 3], out=weight[:, 2])
    np.subtract(fc, weight[:, 3], out=weight[:, 1])
    np.subtract(1 - fr, weight[:, 1], out=weight[:, 0])
    over = corner[:, 4:]
    upper = np.einsum("nk,nk->n", weight, over) > 0
    weight *= (over > 0) == upper[:, None]
    found = np.einsum("nk,nk->n", weight, corner[:, :4])
    found /= np.einsum("nk->n", weight)
    out.reshape(-1)[at] = found


def _split(at: NDArray[Any], size: int) -> tuple[NDArray[np.intp], Float]:
    """The squares (n,) of places (n,) along an axis of `size` heights, and how far on they lie."""
    index = np.clip(np.floor(at).astype(np.intp), 0, size - 2)
    return index, np.clip(at - index, 0, 1).astype(np.float32)
