"""Finds the board in a frame automatically, in front of any background."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.blobs import Blobs, Wellner, blobs
from skyquilt.calibration.board_pose import Misplaced, Placed, place
from skyquilt.calibration.lattice import lattices
from skyquilt.calibration.measure import Measure, corners
from skyquilt.imaging.grey import shrink
from skyquilt.model.board import Board, BoardView, RejectedView

Image = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class FindBoard:
    """Finds squares as blobs at several sizes, orders them by their neighbours, and checks the
    pattern.

    Nothing is assumed about the surroundings of the board. Six touching squares are enough to find
    the others.
    """

    version: ClassVar[int] = 1
    longest_px: int = 960
    """Frames are searched at this size or less; centroids and corners are measured in the frame
    itself.
    """
    smallest_px: float = 7.0
    """Side of the smallest squares searched, in px of the searched image."""
    erosions: tuple[float, ...] = (0.06, 0.12, 0.18)
    """Radii of erosion, in sides of the squares searched."""
    measure: Measure = field(default_factory=Measure)
    """Sub-pixel measurement."""

    def __call__(
        self, name: str, image: NDArray[Any], board: Board, *, frames: int = 1
    ) -> BoardView | RejectedView:
        """The board in a frame (H, W) of any type, NaN where nothing was measured."""
        whole = grey_float(image)
        if (reason := blankness(whole)) is not None:
            return RejectedView(name=name, reason=reason)
        small, scale = shrink(whole, self.longest_px)
        found = self._search(small, board)
        if isinstance(found, Misplaced):
            return RejectedView(name=name, reason=found.reason)
        height, width = whole.shape
        up = np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]])
        placed = Placed(
            px_H_cell=up @ found.px_H_cell,
            white_first=found.white_first,
            contrast=found.contrast,
            texture=found.texture,
        )
        centroids, H, rounding = self.measure.centroids(whole, placed, board)
        inner = np.isfinite(centroids[board.inner][:, 0]).mean()
        if inner < 0.5:
            return RejectedView(
                name=name, reason=f"only {inner:.0%} of its inner squares could be measured"
            )
        return BoardView(
            name=name,
            width=width,
            height=height,
            centroids=centroids,
            corners=corners(whole, H, board),
            rounding_px=rounding,
            contrast=found.contrast / max(found.texture, 1e-9),
            frames=frames,
        )

    def _search(self, image: Image, board: Board) -> Placed | Misplaced:
        best = Misplaced(reason="no chess pattern was found in it", squares=0)
        for found in self._candidates(image, board):
            for grid in lattices(found)[:3]:
                placed = place(image, grid, board)
                if placed:
                    return placed
                if isinstance(placed, Misplaced) and placed.squares > best.squares:
                    best = placed
        return best

    def _candidates(self, image: Image, board: Board) -> Iterator[Blobs]:
        """Blobs at decreasing sizes, from a board that fills the image."""
        height, width = image.shape
        short, long = sorted((board.columns, board.rows))
        side = min(min(width, height) / short, max(width, height) / long) / 1.3
        while side >= self.smallest_px:
            smooth: Image = np.asarray(
                cv2.GaussianBlur(image, (0, 0), max(0.04 * side, 0.5)), np.float32
            )
            binary = Wellner(window_px=round(2 * side))(smooth)
            for erosion in dict.fromkeys(max(1, round(e * side)) for e in self.erosions):
                yield blobs(binary, erosion, largest=4 * side * side)
            side *= 0.7


def grey_float(image: NDArray[Any]) -> Image:
    """(H, W) float32 of a frame of one band or three; invalid pixels get the median."""
    if image.ndim == 3:
        image = (
            image[..., 0]
            if image.shape[2] == 1
            else cv2.cvtColor(image[..., :3], cv2.COLOR_RGB2GRAY)
        )
    grey = np.array(image, np.float32)
    finite = np.isfinite(grey)
    if not finite.all():
        grey[~finite] = np.median(grey[finite]) if finite.any() else 0.0
    return grey


def blankness(image: Image) -> str | None:
    """Why a frame is blank; None if it is not."""
    low, high = np.percentile(image, [1, 99])
    if image.max() <= image.min():
        return f"it is blank: every pixel is {image.flat[0]:g}"
    if high <= low:
        return f"it is blank: 98 of 100 pixels are {low:g}"
    return None
