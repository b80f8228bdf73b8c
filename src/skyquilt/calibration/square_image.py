"""The centroid of a square's image is not the image of its centre: by how much."""

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import project
from skyquilt.model.calibration import BoardPose
from skyquilt.model.camera import Camera

Array = NDArray[np.float64]
_PER_SIDE = 6


def centroid_bias(camera: Camera, pose: BoardPose, centres: Array, side_m: float) -> Array:
    """Centroid of each square's image less the image of its centre (n, 2) in px.

    Squares (n, 3) in m on the board, projected with perspective and distortion; the outline is followed in
    short straight pieces, so its area and moments are exact for a pinhole and close for a lens.
    """
    t = np.arange(_PER_SIDE) / _PER_SIDE - 0.5
    half = np.full(_PER_SIDE, 0.5)
    x, y = np.r_[t, half, -t, -half] * side_m, np.r_[-half, t, half, -t] * side_m
    outline = centres[:, None] + np.column_stack([x, y, np.zeros_like(x)])
    px = project(camera, pose(outline.reshape(-1, 3))).reshape(len(centres), -1, 2)
    middle = project(camera, pose(centres))
    return polygon_centroids(px - middle[:, None])


def polygon_centroids(points: Array) -> Array:
    """Centroids (n, 2) of the areas of polygons (n, k, 2)."""
    following = np.roll(points, -1, axis=1)
    cross = points[..., 0] * following[..., 1] - points[..., 1] * following[..., 0]
    return np.asarray(((points + following) * cross[..., None]).sum(1) / (3 * cross.sum(1)[:, None]))
