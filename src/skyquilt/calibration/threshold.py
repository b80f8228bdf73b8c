"""Black or white by the neighbourhood [Wellner 1993; Yahyanejad 2013, 5.1.3]."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Wellner:
    """Adaptive threshold: a pixel is white where it exceeds the moving average around it.

    Wellner averages along the scan line and lowers the mean by some percent of its level. The level of thermal
    values is arbitrary (counts, kelvin), so the offset is a share of the neighbourhood's own spread here, and
    the average is taken over a square, which has no direction.
    """

    window_px: int
    """Side of the neighbourhood in px: about two squares of the board, where black and white balance."""
    offset: float = 0.0
    """Added to the average, in standard deviations of the neighbourhood."""

    def __call__(self, image: NDArray[np.float32]) -> NDArray[np.uint8]:
        """255 for white, 0 for black, (H, W) of an image (H, W)."""
        side = (self.window_px | 1, self.window_px | 1)
        mean = cv2.blur(image, side, borderType=cv2.BORDER_REFLECT)
        if self.offset:
            square = cv2.blur(image * image, side, borderType=cv2.BORDER_REFLECT)
            mean += np.float32(self.offset) * np.sqrt(np.maximum(square - mean * mean, 0))
        return np.asarray((image > mean) * np.uint8(255))
