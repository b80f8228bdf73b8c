"""What OpenCV's binary detectors find, as Features."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.features.spread import spread
from skyquilt.imaging.grey import full_px
from skyquilt.model.features import Features


def binary_features(
    detector: Any, grey: NDArray[np.uint8], full: tuple[int, int], *, count: int, cells: int
) -> Features:
    """At most `count` keypoints of an OpenCV detector with binary descriptors, spread over the
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
