"""What each photo cannot see: places behind trees and roofs, from the height surface."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.neighbours import nearest
from skyquilt.imaging.nodes import View
from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface

Float = NDArray[np.float32]
Mask = NDArray[np.bool_]
STANDING_M = 1.0
"""Height in m over the bare ground from which something hides what is behind it."""
LEAST_M = 0.6
"""Heights in m by which a line of sight must pass below a surface to be blocked."""
MOST_STRETCHED = 2.0
"""How many times as long as on level ground a photo's pixel may lie on ground that falls away."""
ENOUGH_M = 0.01
"""Change in m of heights below which they are gentle enough."""


def gentle(surface: Surface, centres: NDArray[np.float64]) -> Surface:
    """Heights that fall away from the nearest of these photos' centres (n, 3) in m so gently that
    it sees all of them: nothing is hidden behind trees and roofs, where its pixels would be smeared
    over what it does not see. Their far sides are lowered and so shown leaning outwards, as on a
    map of bare ground; the ground beside them stays where it is.
    """
    cell = surface.cell
    rows, columns = (m.astype(np.float32) for m in np.mgrid[: len(surface.z), : surface.z.shape[1]])
    x, y = surface.x0 + columns * cell, surface.y0 + rows * cell
    place = np.stack([x.ravel(), y.ravel()], 1)
    mine = centres[nearest(centres[:, :2], place, 1)[1][:, 0]].reshape(*x.shape, 3)
    aside, along = x - mine[..., 0], y - mine[..., 1]
    distance = np.maximum(np.hypot(aside, along), cell)
    outer = x + cell * aside / distance, y + cell * along / distance
    sight = np.maximum(mine[..., 2] - surface.z, 0) / distance  # fall of the line of sight, m per m
    fall = ((1 - 1 / MOST_STRETCHED) * sight * cell).astype(np.float32)
    for _ in range(max(x.shape)):
        z = np.minimum(surface.z, surface.at(*outer) + fall)
        change = float((surface.z - z).max())
        surface = replace(surface, z=z)
        if change < ENOUGH_M:
            break
    return surface


class Shadow:
    """The places that a photo cannot see: a depth buffer on a level plane, seen from its centre."""

    def __init__(self, view: View, cells: Grid, z: Float, tall: Mask) -> None:
        """`z` (h, w): heights of the cells, row 0 in the north; `tall` (h, w): cells that hide
        others.
        """
        self._centre = view.pose.map_C
        self._level = float(z.min()) - 1.0
        low, high = view.footprint.min(0), view.footprint.max(0)
        columns, rows = (np.sort(p).astype(int) for p in cells.pixel(*np.stack([low, high], 1)))
        self._row, self._column = max(int(rows[0]) - 2, 0), max(int(columns[0]) - 2, 0)
        shape = (
            min(int(rows[1]) + 3, cells.height) - self._row,
            min(int(columns[1]) + 3, cells.width) - self._column,
        )
        self._cells = cells
        self._buffer = np.full((max(shape[0], 1), max(shape[1], 1)), -np.inf, np.float32)
        self.empty = True
        if min(shape) < 1 or view.pose.cam_H_map is not None:
            return
        part = (
            slice(self._row, self._row + shape[0]),
            slice(self._column, self._column + shape[1]),
        )
        r, c = np.nonzero(tall[part])
        if not len(r):
            return
        foot = cv2.erode(z[part], np.ones((3, 3), np.uint8))[r, c]
        x, y = cells.x(c + self._column), cells.y(r + self._row)
        height = z[part][r, c]
        while len(height):  # the cell, and below it the flank down to its lowest neighbour
            pr, pc = self._seen_at(x, y, height)
            inside = (pr >= 0) & (pc >= 0) & (pr < shape[0]) & (pc < shape[1])
            np.maximum.at(self._buffer, (pr[inside], pc[inside]), height[inside])
            height = height - np.float32(2 * cells.gsd)
            left = height > foot
            x, y, height, foot = x[left], y[left], height[left], foot[left]
        # towards the photo's rim cells lie further apart than in the raster: gaps are closed
        self._buffer = np.asarray(cv2.dilate(self._buffer, np.ones((3, 3), np.uint8)), np.float32)
        self.empty = False

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return int(self._buffer.nbytes)

    def _seen_at(
        self, x: NDArray[Any], y: NDArray[Any], z: NDArray[Any]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of the buffer where points are seen from the photo's centre."""
        cx, cy, cz = self._centre
        share = (z - self._level) / np.maximum(cz - z, 0.1)
        column, row = self._cells.pixel(x + share * (x - cx), y + share * (y - cy))
        return (
            np.rint(row).astype(np.int64) - self._row,
            np.rint(column).astype(np.int64) - self._column,
        )

    def hides(self, x: NDArray[Any], y: NDArray[Any], z: Float) -> Mask:
        """Whether points (h, w) are behind something."""
        if self.empty:
            return np.zeros(z.shape, np.bool_)
        row, column = self._seen_at(x, y, z)
        h, w = self._buffer.shape
        inside = (row >= 0) & (column >= 0) & (row < h) & (column < w)
        top = self._buffer[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
        return np.asarray(inside & (top > z + max(LEAST_M, 3 * self._cells.gsd)))
