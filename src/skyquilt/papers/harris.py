"""Corners (Harris and Stephens 1988), described by SURF, with or without orientation, at one fixed
scale.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.grey import full_px, shrink, to_grey8
from skyquilt.matching.keypoints import spread
from skyquilt.model.features import Features
from skyquilt.papers.surf import signed_bytes
from skyquilt.papers.surf_descriptors import Means, descriptors, orientations


@dataclass(frozen=True, kw_only=True)
class Harris:
    """Maxima of det - k trace^2 of the structure tensor. Corners have no scale, so photos must have
    the same scale.
    """

    count: int = 1500
    """Most keypoints kept per photo."""
    longest: int = 1000
    """Longest side in px of the image searched; smaller photos are searched as they are."""
    block: int = 5
    """Side in px of the window that the tensor is averaged over, odd."""
    k: float = 0.04
    """Weight of the squared trace."""
    quality: float = 1e-4
    """Least response of a corner over the strongest corner's."""
    sigma: float = 2.0
    """Scale in px at which corners are described; the window's side is 20 times as long."""
    upright: bool = True
    """Whether keypoints have no orientation; then photos must not be rotated against each other."""
    cells: int = 10
    """The image is divided into cells x cells; each keeps its strongest keypoints."""
    version: ClassVar[int] = 1

    def __call__(self, image: NDArray[Any]) -> Features:
        """Features of pixels (H, W[, C]) of a full sensor image."""
        return self.of_shrunken(shrink(image, self.longest)[0], image.shape[:2])

    def counted(self, count: int) -> "Harris":
        """The same with another number of keypoints at most."""
        return replace(self, count=count)

    def of_shrunken(self, small: NDArray[Any], full: tuple[int, int]) -> Features:
        """Features of an image shrunken beforehand; `full` is the (H, W) that the keypoints refer
        to.
        """
        grey = to_grey8(small)
        xy, response = self._corners(grey)
        xy = xy[spread(xy, response, grey.shape, self.count, self.cells)]
        means, sigma = Means(grey), np.full(len(xy), self.sigma)
        angle = np.zeros(len(xy)) if self.upright else orientations(means, xy, sigma)
        vectors = descriptors(means, xy, sigma, angle, extended=False)
        scale = full[1] / grey.shape[1]
        size = np.full(len(xy), 20 * self.sigma * scale, np.float32)
        px = full_px(xy, grey.shape, full)
        return Features(px=px, size=size, descriptors=signed_bytes(vectors), scale=scale)

    def _corners(self, grey: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """(N, 2) px with subpixel accuracy, by parabolas through the maxima, and (N,) responses."""
        field = np.asarray(
            cv2.cornerHarris(grey.astype(np.float32), self.block, 3, self.k), np.float32
        )
        top = max(float(field.max(initial=0.0)) * self.quality, 1e-6)
        summit = (field >= cv2.dilate(field, np.ones((3, 3), np.uint8))) & (field > top)
        summit[[0, -1]] = False
        summit[:, [0, -1]] = False
        y, x = np.nonzero(summit)
        off = [
            _vertex(field[y - j, x - i], field[y, x], field[y + j, x + i])
            for i, j in ((1, 0), (0, 1))
        ]
        return np.column_stack([x + off[0], y + off[1]]).astype(np.float64), field[y, x]


def _vertex(before: NDArray[Any], at: NDArray[Any], after: NDArray[Any]) -> NDArray[np.float64]:
    """Position of the maximum of a parabola through three neighbouring values, relative to the
    middle one, within half a step.
    """
    bend = 2.0 * at - before - after
    return np.where(bend > 0, (after - before) / 2 / np.maximum(bend, 1e-30), 0).clip(-0.5, 0.5)
