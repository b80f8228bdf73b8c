"""Groups frames by pose: either the camera was fixed while the board was heated, or each frame is a
view.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.find_board import grey_float
from skyquilt.imaging.grey import shrink

Image = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class StoodStill:
    """Detects whether the camera moved between two frames, by the correlation of their fine
    structure without shift.
    """

    version: ClassVar[int] = 1
    correlation: float = 0.8
    """Least correlation of frames of one pose."""
    longest_px: int = 320
    """Size at which frames are compared."""

    def structure(self, image: NDArray[Any]) -> Image:
        """A frame's structure of 2 to 8 px, reduced (h, w)."""
        small = shrink(grey_float(image), self.longest_px)[0]
        return np.asarray(
            cv2.GaussianBlur(small, (0, 0), 1.2) - cv2.GaussianBlur(small, (0, 0), 4.0), np.float32
        )

    def __call__(self, a: Image, b: Image) -> bool:
        """Whether two frames' structures show the same pose."""
        return a.shape == b.shape and correlation(a, b) > self.correlation


def correlation(a: Image, b: Image) -> float:
    """Correlation of two images of zero mean and equal size without shift; 0 for a blank one."""
    scale = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum() / scale) if scale > 0 else 0.0


def runs(structures: Iterable[Image], still: StoodStill) -> list[list[int]]:
    """Indices of frames in order, split where the camera moved."""
    groups: list[list[int]] = []
    last: Image | None = None
    for i, now in enumerate(structures):
        if last is not None and still(last, now):
            groups[-1].append(i)
        else:
            groups.append([i])
        last = now
    return groups


def mostly_still(groups: Sequence[Sequence[int]]) -> bool:
    """Whether more than half of the steps between frames kept the pose: a series with a few bad
    frames.
    """
    frames = sum(len(g) for g in groups)
    return frames > 2 and frames - len(groups) > (frames - 1) / 2
