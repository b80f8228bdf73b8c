"""Centroids of squares and inner corners to a fraction of a pixel, once the board's place is known."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.placing import Placed, cell_levels, through
from skyquilt.model.board import Board

Array = NDArray[np.float64]
Image = NDArray[np.float32]
_ROUNDS = 3
_AREA = (0.5, 1.5)
_MARGIN = 0.3
"""Cells around the board that are looked at, so that the outer sides of its squares are seen."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """Where squares and corners lie."""

    version = 1
    side_px: float = 48.0
    """Pictures are enlarged until a square has this side: blobs have whole pixels."""
    opening: float = 0.25
    """Radius of erosion and dilation in sides of a square: parts squares that touch at their corners."""

    def centroids(self, image: Image, placed: Placed, board: Board) -> tuple[Array, Array]:
        """Centroids (rows, columns, 2) in px, NaN where none was measured, and the refined px_H_cell."""
        H = placed.px_H_cell
        px = np.full((board.rows, board.columns, 2), np.nan)
        for _ in range(_ROUNDS):
            px = self._once(image, H, placed.white_first, board)
            known = np.isfinite(px[..., 0])
            if known.sum() < 6:
                return px, H
            cells = np.argwhere(known)[:, ::-1].astype(np.float64)
            H = cv2.findHomography(cells, px[known], 0)[0]
        return px, H

    def _once(self, image: Image, H: Array, white_first: bool, board: Board) -> Array:
        area = _areas(H, board)
        factor = int(np.clip(np.ceil(self.side_px / np.sqrt(np.median(area))), 1, 8))
        part, px_of_part = _enlarged(image, H, board, factor)
        grid = _grid_of(part.shape, px_of_part, H)
        threshold = cv2.remap(
            middle_levels(cell_levels(image, H, board)[0]), grid[..., 0], grid[..., 1], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        size = np.array([board.columns, board.rows], np.float32)
        inside = np.all((grid > -0.5 - _MARGIN) & (grid < size - 0.5 + _MARGIN), -1)
        radius = max(1, round(self.opening * factor * float(np.sqrt(np.median(area)))))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
        out = np.full((board.rows, board.columns, 2), np.nan)
        for white in (True, False):
            colour = ((part > threshold) == white) & inside
            opened = cv2.morphologyEx(colour.view(np.uint8), cv2.MORPH_OPEN, disc)
            outlines = cv2.findContours(opened, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
            for outline in outlines:
                hull = cv2.convexHull(outline)
                moments = cv2.moments(hull)
                if moments["m00"] <= 0:
                    continue
                centre = through(
                    px_of_part, np.array([[moments["m10"], moments["m01"]]]) / moments["m00"]
                )
                column, row = np.rint(through(np.linalg.inv(H), centre)[0]).astype(int)
                if not (0 <= column < board.columns and 0 <= row < board.rows):
                    continue
                own = ((row + column) % 2 == 0) == (white_first == white)
                share = (np.sqrt(moments["m00"]) + 1) ** 2 / factor**2 / area[row, column]
                if own and _AREA[0] < share < _AREA[1]:
                    out[row, column] = centre[0]
        return out


def corners(image: Image, px_H_cell: Array, board: Board) -> Array:
    """Inner corners (rows - 1, columns - 1, 2) in px by the gradients around them [Forstner]; NaN where they ran away."""
    y, x = np.mgrid[0 : board.rows - 1, 0 : board.columns - 1] + 0.5
    guess = through(px_H_cell, np.column_stack([x.ravel(), y.ravel()]))
    side = float(np.sqrt(np.median(_areas(px_H_cell, board))))
    reach = max(2, round(0.25 * side))
    low, high = np.percentile(image, [0.5, 99.5])
    grey = np.clip((image - low) / max(float(high - low), 1e-6) * 255, 0, 255).astype(np.float32)
    found = cv2.cornerSubPix(
        grey, guess.astype(np.float32).reshape(-1, 1, 2), (reach, reach), (-1, -1),
        (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-3),
    )[:, 0].astype(np.float64)  # fmt: skip
    found[np.linalg.norm(found - guess, axis=1) > 0.25 * side] = np.nan
    return np.asarray(found.reshape(board.rows - 1, board.columns - 1, 2))


def middle_levels(level: Array) -> Image:
    """Between black and white at every square (rows, columns): half its own level, half its neighbours'."""
    total, count = np.zeros_like(level), np.zeros_like(level)
    for axis in (0, 1):
        for a, b in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
            to = (a, slice(None)) if axis == 0 else (slice(None), a)
            of = (b, slice(None)) if axis == 0 else (slice(None), b)
            total[to] += level[of]
            count[to] += 1
    return np.asarray((level + total / count) / 2, np.float32)


def _areas(H: Array, board: Board) -> Array:
    """Areas of the squares' images (rows, columns) in px^2."""
    y, x = np.mgrid[0 : board.rows + 1, 0 : board.columns + 1] - 0.5
    node = through(H, np.column_stack([x.ravel(), y.ravel()])).reshape(*x.shape, 2)
    one, two = node[1:, 1:] - node[:-1, :-1], node[1:, :-1] - node[:-1, 1:]
    return np.asarray(np.abs(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]) / 2)


def _enlarged(image: Image, H: Array, board: Board, factor: int) -> tuple[Image, Array]:
    """The part of the image around the board, enlarged, and px_H_part."""
    c, r = board.columns - 0.5 + _MARGIN, board.rows - 0.5 + _MARGIN
    low = -0.5 - _MARGIN
    outline = through(H, np.array([[low, low], [c, low], [c, r], [low, r]]))
    x0, y0 = np.maximum(np.floor(outline.min(0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(outline.max(0)).astype(int) + 1, [image.shape[1], image.shape[0]])
    part = image[y0:y1, x0:x1]
    if factor > 1:
        part = cv2.resize(part, None, fx=factor, fy=factor, interpolation=cv2.INTER_LINEAR)
    offset = (1 / factor - 1) / 2
    return part, np.array([[1 / factor, 0, x0 + offset], [0, 1 / factor, y0 + offset], [0, 0, 1]])


def _grid_of(shape: tuple[int, ...], px_H_part: Array, px_H_cell: Array) -> Image:
    """(column, row) of the board at every pixel (h, w, 2)."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    cell_H_part = np.linalg.inv(px_H_cell) @ px_H_part
    return np.asarray(through(cell_H_part, np.column_stack([x.ravel(), y.ravel()])).reshape(*shape[:2], 2), np.float32)
