"""Binary features: ORB and AKAZE of OpenCV, distributed over the image."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.grey import full_px, shrink, stretched, to_grey8
from skyquilt.matching.keypoints import spread
from skyquilt.model.features import Features


def binary_features(
    detector: Any, grey: NDArray[np.uint8], full: tuple[int, int], *, count: int, cells: int
) -> Features:
    """At most `count` keypoints of an OpenCV detector with binary descriptors, distributed over the
    image (H, W).
    """
    points, found = detector.detectAndCompute(grey, None)
    bits = (
        np.zeros((0, detector.descriptorSize()), np.uint8)
        if found is None
        else np.asarray(found, np.uint8)
    )
    xy = np.array([p.pt for p in points], np.float64).reshape(-1, 2)
    keep = spread(xy, np.array([p.response for p in points]), grey.shape, count, cells)
    scale = full[1] / grey.shape[1]
    size = np.array([p.size for p in points], np.float32)[keep] * scale
    px = full_px(xy[keep], grey.shape, full)
    return Features(px=px, size=size, descriptors=bits[keep], scale=scale, binary=True)


@dataclass(frozen=True, kw_only=True)
class Orb:
    """ORB: oriented FAST corners, described by 256 comparisons of pixel pairs."""

    count: int = 1500
    """Most keypoints kept per photo."""
    longest: int = 1000
    """Longest side in px of the image searched; smaller photos are searched as they are."""
    factor: float = 1.2
    """Scale factor between levels of the pyramid."""
    levels: int = 8
    """Levels of the pyramid."""
    corner: int = 10
    """Threshold of FAST in grey levels of 255."""
    cells: int = 10
    """The image is divided into cells x cells; each keeps its strongest keypoints.
    """
    version: ClassVar[int] = 1

    def __call__(self, image: NDArray[Any]) -> Features:
        """Features of pixels (H, W[, C]) of a full sensor image."""
        return self.of_shrunken(shrink(image, self.longest)[0], image.shape[:2])

    def counted(self, count: int) -> "Orb":
        """The same with another number of keypoints at most."""
        return replace(self, count=count)

    def of_shrunken(self, small: NDArray[Any], full: tuple[int, int]) -> Features:
        """Features of an image shrunken beforehand; `full` is the (H, W) that the keypoints refer
        to.
        """
        detector = cv2.ORB.create(
            2 * self.count, scaleFactor=self.factor, nlevels=self.levels, fastThreshold=self.corner
        )
        (grey,) = stretched(to_grey8(small))
        return binary_features(detector, grey, full, count=self.count, cells=self.cells)


@dataclass(frozen=True, kw_only=True)
class Akaze:
    """AKAZE keypoints with the M-LDB descriptor of 486 bits."""

    count: int = 1500
    """Most keypoints kept per photo."""
    longest: int = 1000
    """Longest side in px of the image searched; smaller photos are searched as they are."""
    threshold: float = 0.0003
    """Threshold of the detector's response."""
    octaves: int = 4
    """Octaves of scale."""
    upright: bool = False
    """Whether keypoints have no orientation."""
    cells: int = 10
    """The image is divided into cells x cells; each keeps its strongest keypoints.
    """
    version: ClassVar[int] = 1

    def __call__(self, image: NDArray[Any]) -> Features:
        """Features of pixels (H, W[, C]) of a full sensor image."""
        return self.of_shrunken(shrink(image, self.longest)[0], image.shape[:2])

    def counted(self, count: int) -> "Akaze":
        """The same with another number of keypoints at most."""
        return replace(self, count=count)

    def of_shrunken(self, small: NDArray[Any], full: tuple[int, int]) -> Features:
        """Features of an image shrunken beforehand; `full` is the (H, W) that the keypoints refer
        to.
        """
        x: Any = cv2.xfeatures2d
        kind = x.AKAZE_DESCRIPTOR_MLDB_UPRIGHT if self.upright else x.AKAZE_DESCRIPTOR_MLDB
        detector = x.AKAZE_create(
            descriptor_type=kind, threshold=self.threshold, nOctaves=self.octaves
        )
        (grey,) = stretched(to_grey8(small))
        return binary_features(detector, grey, full, count=self.count, cells=self.cells)
