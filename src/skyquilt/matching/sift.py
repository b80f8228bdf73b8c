"""SIFT keypoints with RootSIFT descriptors, distributed over the image."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.grey import full_px, shrink, stretched, to_grey8
from skyquilt.matching.keypoints import spread
from skyquilt.model.features import DESCRIPTOR_UNIT, Features


@dataclass(frozen=True, kw_only=True)
class Sift:
    """SIFT (Lowe 2004) on a reduced image, with descriptors as RootSIFT (Arandjelovic and Zisserman
    2012).
    """

    count: int = 1200
    """Most keypoints kept per photo."""
    longest: int = 512
    """Longest side in px of the image searched; smaller photos are searched as they are."""
    doubled: int = 256
    """Longest side in px of photos that are enlarged to twice their size: those of half of 512 px
    and less would have a fifth of the keypoints.
    """
    contrast: float = 0.015
    """OpenCV's contrast threshold."""
    levels: int = 3
    """Scale levels per octave; the thesis uses 43 for pairs of different spectra [Y 5.2.1]."""
    first_octave: int = -1
    """-1 starts with the image at twice its size, 0 at its own, 1 at half of it: each leaves out
    the smallest features of the one before [Y 5.2.1].
    """
    root: bool = True
    """RootSIFT; False keeps Lowe's descriptors, as the thesis used them."""
    cells: int = 10
    """The image is divided into cells x cells; each keeps its strongest keypoints, so that they are
    distributed over the whole image.
    """
    spare: float = 1.2
    """Number of keypoints described per keypoint kept; `spread` selects from them."""
    version: ClassVar[int] = 6

    def __call__(self, image: NDArray[Any]) -> Features:
        """Features of pixels (H, W[, C]) of a full sensor image."""
        return self.of_shrunken(shrink(image, self.longest)[0], image.shape[:2])

    def counted(self, count: int) -> "Sift":
        """The same with another number of keypoints at most."""
        return replace(self, count=count)

    def of_shrunken(self, small: NDArray[Any], full: tuple[int, int]) -> Features:
        """Features of an image shrunken beforehand; `full` is the (H, W) that the keypoints refer
        to.
        """
        (grey,) = stretched(to_grey8(small))
        if max(grey.shape) <= self.doubled:
            grey = np.asarray(cv2.resize(grey, None, fx=2, fy=2), np.uint8)
        if self.first_octave > -1:  # OpenCV's first octave doubles whatever it is given
            part = 2 ** (self.first_octave + 1)
            size = (max(1, grey.shape[1] // part), max(1, grey.shape[0] // part))
            grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        # without precise upscaling, OpenCV reports keypoints a quarter of a pixel too far down and
        # right
        detector = cv2.SIFT.create(
            int(self.spare * self.count),
            nOctaveLayers=self.levels,
            contrastThreshold=self.contrast,
            enable_precise_upscale=True,
        )
        points, found = detector.detectAndCompute(grey, None)
        descriptors = (
            np.zeros((0, 128), np.float32) if found is None else np.asarray(found, np.float32)
        )
        xy = np.array([p.pt for p in points], np.float64).reshape(-1, 2)
        keep = spread(
            xy, np.array([p.response for p in points]), grey.shape, self.count, self.cells
        )
        scale = full[1] / grey.shape[1]
        size = np.array([p.size for p in points], np.float32)[keep] * scale
        px = full_px(xy[keep], grey.shape, full)
        stored = _root(descriptors[keep]) if self.root else _plain(descriptors[keep])
        return Features(px=px, size=size, descriptors=stored, scale=scale)


def _root(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """RootSIFT: L1 normalisation, then the square root, which has unit length. Stored in 8 bits
    (see Features).
    """
    total = np.maximum(descriptors.sum(1, keepdims=True), 1e-9)
    return np.asarray(
        np.clip(np.rint(DESCRIPTOR_UNIT * np.sqrt(descriptors / total)), 0, 255).astype(np.uint8)
    )


def _plain(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Lowe's descriptors at unit length, stored the same way."""
    length = np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-9)
    return np.asarray(
        np.clip(np.rint(DESCRIPTOR_UNIT * descriptors / length), 0, 255).astype(np.uint8)
    )
