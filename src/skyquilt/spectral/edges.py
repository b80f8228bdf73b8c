"""Binary edge images [Y 5.2.2, (5.5), (5.6)]."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.grey import to_grey8

THRESHOLDS = (0.2, 0.4, 0.6)
"""Shares of the largest gradient above which a pixel is an edge [Y 5.2.2]."""


def gradient_magnitude(values: NDArray[Any]) -> NDArray[np.float32]:
    """(H, W) in [0, 1]: length of Sobel's gradient (5.5) over its largest value; 0 where nothing
    changes.
    """
    grey = to_grey8(values).astype(np.float32)
    x = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.25)
    y = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.25)
    length = np.hypot(x, y)
    return np.asarray(length / max(float(length.max()), 1e-6), np.float32)


def binary_edges(magnitude: NDArray[np.float32], theta: float) -> NDArray[np.uint8]:
    """(H, W) 255 where the normalised magnitude exceeds theta, else 0 (5.6)."""
    return np.where(magnitude > theta, 255, 0).astype(np.uint8)
