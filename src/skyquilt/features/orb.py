"""ORB (Rublee et al. 2011) as OpenCV has it: fast, binary."""

from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
from numpy.typing import NDArray

from skyquilt.features.binary import binary_features
from skyquilt.imaging.grey import shrink, to_grey8
from skyquilt.model.features import Features


@dataclass(frozen=True, kw_only=True)
class Orb:
    """Turned corners with 256 compared pairs of pixels."""

    count: int = 1500
    """Most keypoints kept per photo."""
    longest: int = 1000
    """Longest side in px of the image searched; smaller photos are searched as they are."""
    factor: float = 1.2
    """From one level of the pyramid to the next."""
    levels: int = 8
    """Of the pyramid."""
    corner: int = 10
    """FAST's threshold, grey levels of 255."""
    cells: int = 10
    """The image is cut into cells x cells; each keeps its strongest, so that no corner stays bare.
    """
    version: ClassVar[int] = 1

    def __call__(self, image: NDArray[Any]) -> Features:
        """Features of pixels (H, W[, C]) of a full sensor image."""
        return self.of_shrunken(shrink(image, self.longest)[0], image.shape[:2])

    def of_shrunken(self, small: NDArray[Any], full: tuple[int, int]) -> Features:
        """Features of an image shrunken beforehand; `full` is the (H, W) that the keypoints refer
        to.
        """
        detector = cv2.ORB.create(
            2 * self.count, scaleFactor=self.factor, nlevels=self.levels, fastThreshold=self.corner
        )
        return binary_features(detector, to_grey8(small), full, count=self.count, cells=self.cells)
