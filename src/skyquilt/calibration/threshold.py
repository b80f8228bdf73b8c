"""Black or white by the neighbourhood [Wellner 1993; Yahyanejad 2013, 5.1.3]."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Wellner:
    """Adaptive threshold: a pixel is white where it exceeds the moving average around it.

    Wellner averages along the scan line and lowers the mean by some percent of its level. The level
    of thermal values is arbitrary (counts, kelvin), so the plain mean decides here, taken over a
    square, which has no direction: as wide as two squares of the board, it lies half-way between
    black and white.
    """

    window_px: int
    """Side of the neighbourhood in px: about two squares of the board."""

    def __call__(self, image: NDArray[np.float32]) -> NDArray[np.uint8]:
        """255 for white, 0 for black, (H, W) of an image (H, W)."""
        side = (self.window_px | 1, self.window_px | 1)
        mean = cv2.blur(image, side, borderType=cv2.BORDER_REFLECT)
        return np.asarray((image > mean) * np.uint8(255))
