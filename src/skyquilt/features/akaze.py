"""AKAZE (Alcantarilla et al. 2013) as OpenCV has it: blobs of a nonlinear scale space, binary."""

from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
from numpy.typing import NDArray

from skyquilt.features.binary import binary_features
from skyquilt.imaging.grey import shrink, to_grey8
from skyquilt.model.features import Features


@dataclass(frozen=True, kw_only=True)
class Akaze:
    """The M-LDB descriptor of 486 bits."""

    count: int = 1500
    """Most keypoints kept per photo."""
    longest: int = 1000
    """Longest side in px of the image searched; smaller photos are searched as they are."""
    threshold: float = 0.0003
    """Of the detector's response."""
    octaves: int = 4
    """Octaves of scale."""
    upright: bool = False
    """No orientation."""
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
        x: Any = cv2.xfeatures2d
        kind = x.AKAZE_DESCRIPTOR_MLDB_UPRIGHT if self.upright else x.AKAZE_DESCRIPTOR_MLDB
        detector = x.AKAZE_create(
            descriptor_type=kind, threshold=self.threshold, nOctaves=self.octaves
        )
        return binary_features(detector, to_grey8(small), full, count=self.count, cells=self.cells)
