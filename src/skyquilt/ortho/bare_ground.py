"""The bare ground below a height surface: the simple morphological filter of Pingel, Clarke and
McBride (2013, ISPRS Journal 77).
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.ortho.fill import filled

Float = NDArray[np.float32]
Mask = NDArray[np.bool_]
CELL_M = 1.0
"""Least side in m of the cells that are filtered; each holds the lowest height in it."""
WIDEST_M = 40.0
"""Radius in m of the largest opening: half the width of the widest building or wood."""
SLOPE = 0.15
"""Rise of the ground over the radius of an opening; what is removed and rises more is an object."""
ENOUGH = 300_000
"""Cells, about, from which the general slope is estimated."""
OVER_M = 0.5
"""Height in m over the interpolated ground from which a cell is an object."""


def bare_ground(z: Float, known: Mask, cell: float) -> Float:
    """Heights (h, w) of the ground from those of the surface, cells of `cell` m; `known` (h, w):
    where these were measured.
    """
    factor = max(1, round(CELL_M / cell))
    lowest = _lowest(np.where(known, z, np.inf).astype(np.float32), factor)
    measured = np.isfinite(lowest)
    if not measured.any():
        return z
    slope = _plane(lowest, measured)
    level = lowest - slope
    ground = measured & ~_objects(_bordered(level, measured, cell * factor), cell * factor)
    if not ground.any():
        return z
    rough = filled(np.where(ground, level, 0), ground)
    ground &= np.where(measured, level, np.inf) < rough + OVER_M
    if ground.any():
        rough = filled(np.where(ground, level, 0), ground)
    smooth = cv2.GaussianBlur(rough, (0, 0), 1.5) + slope
    h, w = z.shape
    size: Any = (smooth.shape[1] * factor, smooth.shape[0] * factor)
    wide = cv2.resize(smooth, size, interpolation=cv2.INTER_LINEAR)[:h, :w]
    return np.asarray(np.where(known, np.minimum(wide, z), wide), np.float32)


def _lowest(z: Float, factor: int) -> Float:
    """Minima over blocks of `factor` cells."""
    pad = ((0, -z.shape[0] % factor), (0, -z.shape[1] % factor))
    whole = np.pad(z, pad, constant_values=np.inf)
    blocks = whole.reshape(whole.shape[0] // factor, factor, whole.shape[1] // factor, factor)
    return np.asarray(blocks.min((1, 3)))


def _plane(z: Float, known: Mask) -> Float:
    """(h, w) the general slope of heights: a plane by robust least squares."""
    row, column = np.nonzero(known)
    some = slice(None, None, max(1, len(row) // ENOUGH))
    row, column = row[some], column[some]
    terms = np.column_stack([np.ones(len(row)), row, column])
    height, weight = z[row, column].astype(np.float64), np.ones(len(row))
    x: NDArray[Any] = np.zeros(3)
    for _ in range(6):
        x = np.linalg.lstsq(terms * weight[:, None], height * weight, rcond=None)[0]
        # objects rise over the ground: what lies high counts little
        weight = 1 / (1 + np.clip(height - terms @ x, 0, None))
    r, c = np.mgrid[: z.shape[0], : z.shape[1]]
    return np.asarray(x[0] + x[1] * r + x[2] * c, np.float32)


def _bordered(z: Float, known: Mask, cell: float) -> Float:
    """Heights whose unknown cells lie as low as the lowest around, so that woods at the rim end."""
    side = 2 * round(WIDEST_M / cell) + 1
    low = cv2.erode(np.where(known, z, np.inf).astype(np.float32), np.ones((side, side), np.uint8))
    finite = low < np.finfo(np.float32).max  # OpenCV gives that where no cell is known
    return np.where(known, z, filled(np.where(finite, low, 0), finite)).astype(np.float32)


def _objects(z: Float, cell: float) -> Mask:
    """Cells (h, w) that an opening lowers by more than the ground can rise over its radius."""
    found = np.zeros(z.shape, np.bool_)
    last, radius = z, 1
    margin = round(WIDEST_M / cell) + 1
    while radius * cell <= WIDEST_M:
        padded = cv2.copyMakeBorder(
            last, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=(float(z.min()),)
        )
        opened = cv2.morphologyEx(padded, cv2.MORPH_OPEN, np.ones((2 * radius + 1,) * 2, np.uint8))[
            margin:-margin, margin:-margin
        ]
        found |= last - opened > SLOPE * radius * cell
        last, radius = np.asarray(opened, np.float32), radius + max(1, radius // 3)
    return found
