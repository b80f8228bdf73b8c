"""Features of a fisheye's photo, found in its picture as a pinhole would show it.

A fisheye shows ground far from its axis foreshortened, and more so along the radius than across it:
descriptors of the same place in the middle of one photo and near the rim of another differ. Through
a pinhole photos of level ground differ by a similarity, wherever in them it lies.
"""

from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import project
from skyquilt.imaging.grey import shrunken_px
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features

MOST_AWAY_RAD = 1.05
"""Angle from the axis, across and down, up to which a fisheye's picture is straightened: at 60
degrees a pinhole shows it four times as large as in the middle.
"""


class Detector(Protocol):
    """Finds features of pictures."""

    @property
    def longest(self) -> int:
        """Longest side in px of the pictures that are searched."""
        ...

    def of_shrunken(self, small: NDArray[Any], full: tuple[int, int]) -> Features:
        """Features of a picture; `full` is the (H, W) that they refer to."""
        ...


def straightened_features(
    lens: Camera, picture: NDArray[Any], full: tuple[int, int], detector: Detector
) -> Features:
    """Features of a fisheye's picture (h, w), px of its full size (H, W): found in what a pinhole
    would show of it, in the middle as large as in the pictures that the detector searches.
    """
    focal = lens.focal * min(1.0, detector.longest / max(full))
    across, down = (
        int(2 * focal * np.tan(min(side / (2 * lens.focal), MOST_AWAY_RAD)))
        for side in (full[1], full[0])
    )
    middle = np.array([(across - 1) / 2, (down - 1) / 2])

    def seen(px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (n, 2) of the photo that the pinhole shows at px (n, 2)."""
        rays = np.column_stack([(px - middle) / focal, np.ones(len(px))])
        return np.asarray(project(lens, rays), np.float64)

    v, u = np.indices((down, across)).reshape(2, -1)
    at = seen(np.column_stack([u, v]).astype(np.float64))
    x, y = (
        np.asarray(axis, np.float32).reshape(down, across)
        for axis in shrunken_px(at[:, 0], at[:, 1], picture.shape, full)
    )
    straight = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    features = detector.of_shrunken(straight, (down, across))
    scale = lens.focal / focal
    return Features(
        px=seen(features.px),
        size=features.size * np.float32(scale),
        descriptors=features.descriptors,
        scale=features.scale * scale,
    )
