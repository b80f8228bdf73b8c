"""Finds which squares of a grid are the board, from the chess pattern itself and not from its
outline.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.lattice import Lattice
from skyquilt.model.board import Board

Array = NDArray[np.float64]
Image = NDArray[np.float32]
_SAMPLES = 7
_WEAKEST = 0.2
"""Least difference of two neighbouring squares, as a share of the median difference."""
_ABOVE_TEXTURE = 2.0
"""Least difference of black and white, as a multiple of the spread inside a square."""


_INNER = 0.75
"""From the middle of the outermost square but one to the end of the middle half of the outermost
one.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """A board's position in a frame."""

    px_H_cell: Array
    """(3, 3): from (column, row) of the board, square centres at integers, to px."""
    white_first: bool
    """Whether the first square (0, 0) is a white one."""
    contrast: float
    """White minus black squares: median over neighbouring pairs, in units of the image."""
    texture: float
    """Median spread inside a square, in units of the image."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Misplaced:
    """Why a grid is not the requested board. Its truth value is False."""

    reason: str
    """The reason as a phrase."""
    squares: int
    """Number of squares found."""

    def __bool__(self) -> bool:
        return False


def place(image: Image, grid: Lattice, board: Board) -> Placed | Misplaced:
    """The board's position on a grid found in an image (H, W).

    Every square must differ from its neighbours according to the pattern, and only one position may
    fit. If the pattern continues, it is another board.
    """
    windows = list(_windows(grid, board))
    inside = [w for w in windows if _in_frame(grid.px_H_grid @ w, board, image.shape)]
    fits = {_place_of(w, board): _judged(image, grid, w, board) for w in inside}
    good = [f for f in fits.values() if f]
    seen, asked = np.ptp(grid.cells, 0) + 1, f"{board.columns} x {board.rows}"
    if len(good) > 1:
        why = f"the pattern continues beyond {asked} squares (squares are counted, not corners)"
    else:
        why = f"{seen[0]} x {seen[1]} squares were found where {asked} are expected"
        whole = [w for w in windows if _covers(w, grid, board)]
        if any(not _in_frame(grid.px_H_grid @ w, board, image.shape) for w in whole):
            why += "; the others are covered or outside the frame"
    if len(good) != 1:
        return Misplaced(reason=why, squares=len(grid.cells))
    (rectangle,) = (r for r, f in fits.items() if f)
    turns = [w for w in inside if _place_of(w, board) == rectangle]
    return min((p for w in turns if (p := _judged(image, grid, w, board))), key=_preference)


def _windows(grid: Lattice, board: Board) -> Iterator[Array]:
    """grid_H_board (3, 3) of every position of the board on the grid that covers all squares found,
    or all but an outer row; four rotations each.
    """
    low, high = grid.cells.min(0), grid.cells.max(0)
    for quarter in range(4):
        turn = np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), quarter)
        size = np.abs(turn @ [board.columns, board.rows])
        for x in range(high[0] - size[0], low[0] + 2):
            for y in range(high[1] - size[1], low[1] + 2):
                shift = np.eye(3)
                shift[:2, :2] = turn
                shift[:2, 2] = np.array([x, y]) + np.where(turn.sum(1) < 0, size - 1, 0)
                yield shift


def _place_of(window: Array, board: Board) -> tuple[float, ...]:
    """The rectangle that a window covers, whatever its rotation."""
    ends = through(window, np.array([[0.0, 0.0], [board.columns - 1.0, board.rows - 1.0]]))
    return (*np.rint(ends.min(0)).tolist(), *np.rint(ends.max(0)).tolist())


def _covers(window: Array, grid: Lattice, board: Board) -> bool:
    """Whether a window contains all squares found."""
    x0, y0, x1, y1 = _place_of(window, board)
    low, high = grid.cells.min(0), grid.cells.max(0)
    return bool(x0 <= low[0] and y0 <= low[1] and x1 >= high[0] and y1 >= high[1])


def _judged(image: Image, grid: Lattice, window: Array, board: Board) -> Placed | None:
    """The position, if the pattern is there."""
    H = grid.px_H_grid @ window
    level, spread = cell_levels(image, H, board)
    white_first = (round(window[0, 2] + window[1, 2]) % 2 == 0) == grid.white_even
    contrast, texture = pattern_contrast(level, white_first), float(np.median(spread))
    if contrast is None or contrast < _ABOVE_TEXTURE * texture:
        return None
    return Placed(px_H_cell=H, white_first=white_first, contrast=contrast, texture=texture)


def _in_frame(H: Array, board: Board, shape: tuple[int, ...]) -> bool:
    """Whether the middle halves of all squares are inside the image. The outer sides are not
    tested, since lens distortion moves them inwards and the homography does not model that.
    """
    c, r = board.columns - _INNER, board.rows - _INNER
    ends = np.array([[_INNER - 1, _INNER - 1], [c, _INNER - 1], [c, r], [_INNER - 1, r]])
    outline, depth = through(H, ends), np.column_stack([ends, np.ones(4)]) @ H[2]
    in_front = bool(np.all(depth * depth[0] > 0))
    return in_front and bool(
        np.all((outline > -0.5) & (outline < np.array([shape[1], shape[0]]) - 0.5))
    )


def cell_levels(image: Image, H: Array, board: Board) -> tuple[Array, Array]:
    """Median and spread (rows, columns) of the middle half of every square."""
    inner = (np.arange(_SAMPLES) - (_SAMPLES - 1) / 2) * 0.5 / _SAMPLES
    x = np.arange(board.columns)[None, :, None, None] + inner[None, None, None, :]
    y = np.arange(board.rows)[:, None, None, None] + inner[None, None, :, None]
    xy = np.stack(np.broadcast_arrays(x, y), -1)
    px = through(H, xy.reshape(-1, 2)).astype(np.float32)
    values = cv2.remap(image, px[:, 0], px[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    cells = np.asarray(values, np.float64).reshape(board.rows, board.columns, -1)
    return np.median(cells, 2), cells.std(2)


def pattern_contrast(level: Array, white_first: bool) -> float | None:
    """Median difference of neighbours (rows, columns); None if a pair contradicts the pattern."""
    rows, columns = np.indices(level.shape)
    sign = np.where((rows + columns) % 2 == 0, 1.0, -1.0) * (1 if white_first else -1)
    across, down = (
        (level[:, :-1] - level[:, 1:]) * sign[:, :-1],
        (level[:-1] - level[1:]) * sign[:-1],
    )
    pairs = np.concatenate([across.ravel(), down.ravel()])
    middle = float(np.median(pairs))
    return middle if middle > 0 and pairs.min() > _WEAKEST * middle else None


def _preference(place: Placed) -> tuple[bool, float]:
    """White first, then upright."""
    along = through(place.px_H_cell, np.array([[0.0, 0.0], [1.0, 0.0]]))
    step = along[1] - along[0]
    return not place.white_first, float(-step[0] / np.linalg.norm(step))


def through(H: Array, xy: Array) -> Array:
    """Points (n, 2) through a homography."""
    mapped = np.column_stack([xy, np.ones(len(xy))]) @ H.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
