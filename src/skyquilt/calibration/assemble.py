"""Combines frames of one board pose, heated part by part, to one image of high contrast.

Bimodality and weights: Yahyanejad 2013, 5.1.2, (5.1) to (5.3).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.find_board import grey_float
from skyquilt.model.board import Board

Image = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Assemble:
    """Weighted mean of the frames (5.3), cell by cell; the weight increases with bimodality.

    As printed, (5.3) weights by phi, which is low where black and white are well separated; the
    weight here is phi to the power of -`power`. docs/papers.md gives the effect of this power on
    simulated sweeps, and of what sigma is.
    """

    version: ClassVar[int] = 2
    power: float = 0.5
    """Exponent of 1 / phi."""
    variance: bool = False
    """Whether sigma in (5.1) is the variance, as the text of the thesis says."""
    cell_px: int | None = None
    """Side of a cell in px; None = two of the largest squares that the board can have in the frame.
    """

    def __call__(self, frames: Iterable[NDArray[Any]], board: Board) -> Image:
        """The assembled image (H, W) of frames (H, W) of equal size."""
        total, weights = np.zeros(1), np.zeros(1)
        for frame in frames:
            image = grey_float(frame)
            weight = self.weight(image, board)
            total, weights = total + weight * image, weights + weight
        return np.asarray(total / np.maximum(weights, 1e-30), np.float32)

    def weight(self, image: Image, board: Board) -> Image:
        """The weight function (5.2) of a frame (H, W), smooth between the middles of cells."""
        side = self.cell_px or cell_of(image.shape, board)
        cells = separation(image, side, variance=self.variance) ** self.power
        step = max(1, side // 2)
        rows = (np.arange(image.shape[0]) - (side - 1) / 2) / step
        columns = (np.arange(image.shape[1]) - (side - 1) / 2) / step
        x, y = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
        smooth = cv2.remap(
            cells.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(smooth + np.float32(1e-6 * max(float(cells.max()), 1e-20)), np.float32)


def cell_of(shape: tuple[int, ...], board: Board) -> int:
    """Width in px of two squares (the least width of a cell in the thesis) of a board that fills
    the frame. If the board is smaller, a cell contains more than two squares.
    """
    short, long = sorted((board.columns, board.rows))
    return max(4, int(2 * min(min(shape[:2]) / short, max(shape[:2]) / long)))


def as_printed() -> Assemble:
    """(5.3) word for word: weighted by phi, whose sigma is the variance."""
    return Assemble(power=-1.0, variance=True)


WEIGHTS: dict[str, Callable[[], Assemble]] = {"contrast": Assemble, "printed": as_printed}
"""Ways of weighting frames by name."""


def bimodality(cell: NDArray[Any], *, variance: bool = False) -> float:
    """phi of (5.1): spread of the pixels below the mean plus spread of those above it, over the
    squared distance of the two means. Low values mean good separation; infinite for a cell without
    contrast. Unit: 1 / unit of the cell; with the variance as the spread it has none.
    """
    values = np.asarray(cell, np.float64).ravel()
    values = values[np.isfinite(values)]
    if not values.size:
        return float("inf")
    middle = values.mean()
    below, above = values[values < middle], values[values > middle]
    if not below.size or not above.size:
        return float("inf")
    spread = below.var() + above.var() if variance else below.std() + above.std()
    return float(spread / (below.mean() - above.mean()) ** 2)


def separation(
    image: NDArray[np.float32], cell_px: int, *, variance: bool = False
) -> NDArray[np.float64]:
    """1 / phi (m, n) on overlapping cells of an image (H, W), `cell_px` wide at steps of half of
    it.

    phi is low where black and white are well separated, so a weight must increase with its inverse.
    """
    step = max(1, cell_px // 2)
    rows, columns = (max(1, 1 + (size - cell_px + step - 1) // step) for size in image.shape)
    out = np.zeros((rows, columns))
    for i, j in np.ndindex(rows, columns):
        top, left = (
            min(i * step, max(image.shape[0] - cell_px, 0)),
            min(j * step, max(image.shape[1] - cell_px, 0)),
        )
        phi = bimodality(image[top : top + cell_px, left : left + cell_px], variance=variance)
        out[i, j] = 1 / phi if phi > 0 else 0.0
    return out
