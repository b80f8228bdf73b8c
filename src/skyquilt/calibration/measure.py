"""Subpixel measurement of square centroids and inner corners, once the board's position is
known.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.board_pose import Placed, cell_levels, through
from skyquilt.model.board import Board

Array = NDArray[np.float64]
Image = NDArray[np.float32]
_ROUNDS = 2
_FEWEST = 6
_AREA = (0.6, 1.45)
_SMOOTH, _BESIDE, _AROUND = 0.03, 0.12, 0.6
"""Radii in sides of a square: of smoothing, of the area beside an edge, of an area that certainly
contains black and white.
"""
_STEP = 0.6
"""Least contrast of an edge as a share of the contrast around it."""
_MARGIN = 0.3
"""Margin around the board in cells, so that the outer sides of its squares are included."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """Positions of squares: blobs are separated where they touch at corners, and the centroids of
    their hulls are computed.
    """

    version: ClassVar[int] = 1
    side_px: float = 100.0
    """Images are enlarged until a square has about this side, since blobs consist of whole
    pixels.
    """
    openings: tuple[float, ...] = (0.12, 0.25)
    """Radii of erosion and dilation in sides of a square: the larger one is for squares that still
    touch others at their corners, by heat or blur. It rounds off corners; `square_image` takes that
    into account.
    """

    def centroids(self, image: Image, placed: Placed, board: Board) -> tuple[Array, Array, Array]:
        """Centroids (rows, columns, 2) in px, NaN where none was measured, the refined px_H_cell,
        and the radii (rows, columns) in px by which corners were rounded off.
        """
        H = placed.px_H_cell
        px, rounding = (
            np.full((board.rows, board.columns, 2), np.nan),
            np.zeros((board.rows, board.columns)),
        )
        for _ in range(_ROUNDS):
            px, rounding = self._once(image, H, placed.white_first, board)
            known = np.isfinite(px[..., 0])
            if known.sum() < _FEWEST:
                break
            cells = np.argwhere(known)[:, ::-1].astype(np.float64)
            H = np.asarray(cv2.findHomography(cells, px[known], 0)[0], np.float64)
        return px, H, rounding

    def _once(self, image: Image, H: Array, white_first: bool, board: Board) -> tuple[Array, Array]:
        area = _areas(H, board)
        side = float(np.sqrt(np.median(area)))
        factor = int(np.clip(round(self.side_px / side), 1, 8))
        part, px_H_part = _enlarged(image, H, board, factor)
        cell = _cell_of(part.shape, px_H_part, H)
        threshold = half_way(
            part, middle_levels(cell_levels(image, H, board)[0]), cell, side * factor
        )
        size = np.array([board.columns, board.rows], np.float32)
        near = np.all((cell > -0.5 - _MARGIN) & (cell < size - 0.5 + _MARGIN), -1)
        out = np.full((board.rows, board.columns, 2), np.nan)
        above, rounding = part - threshold, np.zeros((board.rows, board.columns))
        cell_H_px = np.asarray(np.linalg.inv(H))
        for opening in self.openings:
            for white in (True, False):
                sign = np.float32(1 if white else -1)
                blobs = opened((above * sign > 0) & near, opening * side * factor)
                for centre, size_px in _centroids(blobs, coverage(above * sign), px_H_part):
                    column, row = np.rint(through(cell_H_px, centre[None])[0]).astype(int)
                    if (
                        0 <= column < board.columns
                        and 0 <= row < board.rows
                        and np.isnan(out[row, column, 0])
                    ):
                        own = ((row + column) % 2 == 0) == (white_first == white)
                        if own and _AREA[0] < size_px / area[row, column] < _AREA[1]:
                            out[row, column], rounding[row, column] = centre, opening * side
        return out, rounding


def half_way(image: Image, middle: Image, cell: Image, side: float) -> Image:
    """Threshold between black and white (h, w) at every pixel. At an edge it is half-way between
    the values on both sides, so that uneven heat does not move the edge; elsewhere half-way between
    the levels of whole squares, `middle` (rows, columns).

    `cell` (h, w, 2): the square of each pixel, `side`: side of a square in px.
    """
    whole = cv2.remap(
        middle, cell[..., 0], cell[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    smooth: Image = np.asarray(cv2.GaussianBlur(image, (0, 0), _SMOOTH * side), np.float32)
    low, high = _extremes(smooth, _BESIDE * side)
    darkest, brightest = _extremes(smooth, _AROUND * side)
    at_edge = high - low > _STEP * (brightest - darkest)
    return np.asarray(np.where(at_edge, (low + high) / 2, whole), np.float32)


def _extremes(image: Image, radius: float) -> tuple[Image, Image]:
    """Smallest and largest value around every pixel (h, w)."""
    kernel = np.ones((2 * max(1, round(radius)) + 1,) * 2, np.uint8)
    return np.asarray(cv2.erode(image, kernel), np.float32), np.asarray(
        cv2.dilate(image, kernel), np.float32
    )


def opened(mask: NDArray[np.bool_], radius: float) -> NDArray[np.uint8]:
    """Erosion and dilation by a disc (radius in px), by distances: exact for any radius and equally
    fast.
    """
    parts = cv2.distanceTransform(mask.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) > radius
    away = cv2.distanceTransform((~parts).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away < radius, np.uint8)


def coverage(above: Image) -> Image:
    """Share (h, w) of every pixel that is above the threshold, from its value and the slope
    there.
    """
    slope_y, slope_x = np.gradient(above)
    slope = np.maximum(np.hypot(slope_x, slope_y), 1e-12)
    return np.asarray(np.clip(0.5 + above / slope, 0, 1), np.float32)


def _centroids(
    blobs: NDArray[np.uint8], covered: Image, px_H_part: Array
) -> Iterator[tuple[Array, float]]:
    """Centroid (2,) in px and area in px^2 of each blob within its convex hull [outlines: Suzuki];
    pixels on the outline are weighted by their covered share.
    """
    scale = float(px_H_part[0, 0])
    around = np.ones((3, 3), np.uint8)
    for outline in cv2.findContours(blobs, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
        x, y, w, h = cv2.boundingRect(outline)
        box = np.zeros((h + 4, w + 4), np.uint8)
        cv2.fillConvexPoly(box, cv2.convexHull(outline) - np.array([x - 2, y - 2]), 1)
        inside, reach = cv2.erode(box, around), cv2.dilate(box, around)
        top, left = max(y - 2, 0), max(x - 2, 0)
        part = covered[top : y + h + 2, left : x + w + 2]
        cut = (
            slice(top - y + 2, top - y + 2 + part.shape[0]),
            slice(left - x + 2, left - x + 2 + part.shape[1]),
        )
        share = np.where(inside[cut] > 0, 1.0, part * reach[cut])
        total = float(share.sum())
        if total > 0:
            middle = [
                share.sum(0) @ np.arange(share.shape[1]) / total,
                share.sum(1) @ np.arange(share.shape[0]) / total,
            ]
            yield (
                through(px_H_part, np.array([middle]) + np.array([left, top]))[0],
                total * scale * scale,
            )


def corners(image: Image, px_H_cell: Array, board: Board) -> Array:
    """Inner corners (rows - 1, columns - 1, 2) in px by the gradients around them [Forstner]; NaN
    where the refinement diverged.
    """
    y, x = np.mgrid[0 : board.rows - 1, 0 : board.columns - 1] + 0.5
    guess = through(px_H_cell, np.column_stack([x.ravel(), y.ravel()]))
    side = float(np.sqrt(np.median(_areas(px_H_cell, board))))
    reach = max(2, round(0.25 * side))
    low, high = np.percentile(image, [0.5, 99.5])
    grey = np.clip((image - low) / max(float(high - low), 1e-6) * 255, 0, 255).astype(np.float32)
    found = cv2.cornerSubPix(
        grey,
        guess.astype(np.float32).reshape(-1, 1, 2),
        (reach, reach),
        (-1, -1),
        (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-3),
    )[:, 0].astype(np.float64)
    found[np.linalg.norm(found - guess, axis=1) > 0.25 * side] = np.nan
    return np.asarray(found.reshape(board.rows - 1, board.columns - 1, 2))


def middle_levels(level: Array) -> Image:
    """Between black and white at every square (rows, columns): half its own level, half its
    neighbours'.
    """
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
        size = (part.shape[1] * factor, part.shape[0] * factor)
        part = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_LINEAR), np.float32)
    offset = (1 / factor - 1) / 2
    return part, np.array([[1 / factor, 0, x0 + offset], [0, 1 / factor, y0 + offset], [0, 0, 1]])


def _cell_of(shape: tuple[int, ...], px_H_part: Array, px_H_cell: Array) -> Image:
    """(column, row) of the board at every pixel (h, w, 2)."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    cell_H_part = np.linalg.inv(px_H_cell) @ px_H_part
    return np.asarray(
        through(cell_H_part, np.column_stack([x.ravel(), y.ravel()])).reshape(*shape[:2], 2),
        np.float32,
    )
