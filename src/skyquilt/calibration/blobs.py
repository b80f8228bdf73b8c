"""Squares as blobs: adaptive threshold, erosion and dilation, contours, convex hulls, centroids.

Yahyanejad 2013, 5.1.3.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_SOLID = 0.8
_SLIM = 0.25


@dataclass(frozen=True, kw_only=True, eq=False)
class Blobs:
    """Candidates for squares."""

    centre: Array
    """Centroids (n, 2) in px."""
    sides: Array
    """(n, 4, 2) in px: from the centroid to the middle of each side of the square before erosion,
    clockwise in the image.
    """
    white: NDArray[np.bool_]
    """(n,) whether the square is a white one."""

    def __len__(self) -> int:
        return len(self.centre)


def blobs(binary: NDArray[np.uint8], erosion_px: int, *, largest: float) -> Blobs:
    """Black and white blobs of a binary image (H, W) that may be squares of at most `largest` px^2.

    Eroding the white parts separates white squares, eroding the black ones (a dilation) black
    squares.
    """
    kernel = np.ones((2 * erosion_px + 1,) * 2, np.uint8)
    found = []
    for white in (True, False):
        parts = cv2.erode(binary if white else cv2.bitwise_not(binary), kernel)
        outlines = cv2.findContours(parts, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        found += [
            (*s, white)
            for s in (_square(c, erosion_px, largest) for c in outlines)
            if s is not None
        ]
    return Blobs(
        centre=np.array([f[0] for f in found]).reshape(-1, 2),
        sides=np.array([f[1] for f in found]).reshape(-1, 4, 2),
        white=np.array([f[2] for f in found], bool),
    )


def _square(outline: NDArray[Any], erosion_px: int, largest: float) -> tuple[Array, Array] | None:
    """Centroid and sides of a convex blob of four corners."""
    hull = cv2.convexHull(outline)
    area = cv2.contourArea(hull)
    if not 9 <= area <= largest or cv2.contourArea(outline) < _SOLID * area:
        return None
    corners = four_corners(hull)
    if corners is None:
        return None
    moments = cv2.moments(hull)
    centre = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    middle = (corners + np.roll(corners, -1, 0)) / 2 - centre
    length = np.linalg.norm(middle, axis=1, keepdims=True)
    if length.min() < _SLIM * length.max():
        return None
    return centre, middle * (length + erosion_px + 0.5) / length


def four_corners(hull: NDArray[Any]) -> Array | None:
    """Four corners (4, 2) in px of a convex outline, clockwise as seen; None where it has no
    four.
    """
    around = cv2.arcLength(hull, True)
    for share in (0.04, 0.06, 0.08, 0.1, 0.13):
        corners = cv2.approxPolyDP(hull, share * around, True)[:, 0].astype(np.float64)
        if len(corners) == 4:
            x, y = corners.T
            turn = x @ np.roll(y, -1) - y @ np.roll(x, -1)
            return corners if turn > 0 else np.ascontiguousarray(corners[::-1])
        if len(corners) < 4:
            return None
    return None


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
