"""Difference between the centroid of a square's image and the image of its centre."""

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import project
from skyquilt.model.calibration import BoardPose
from skyquilt.model.camera import Camera

Array = NDArray[np.float64]
_PER_SIDE = 10


def centroid_bias(
    camera: Camera, pose: BoardPose, centres: Array, side_m: float, rounding_px: Array | float = 0.0
) -> Array:
    """Centroid of each square's image minus the image of its centre (n, 2) in px.

    Squares (n, 3) in m on the board, projected with perspective and distortion; the outline is
    followed in short straight pieces, so its area and moments are exact for a pinhole and close for
    a lens. `rounding_px` (n,) is the radius by which the corners of the images were rounded off.
    """
    t = np.arange(_PER_SIDE) / _PER_SIDE - 0.5
    half = np.full(_PER_SIDE, 0.5)
    x, y = np.r_[t, half, -t, -half] * side_m, np.r_[-half, t, half, -t] * side_m
    outline = centres[:, None] + np.column_stack([x, y, np.zeros_like(x)])
    px = project(camera, pose(outline.reshape(-1, 3))).reshape(len(centres), -1, 2)
    px -= project(camera, pose(centres))[:, None]
    centroid, area = polygon_centroids(px)
    lost, where = _rounded_off(px, np.broadcast_to(rounding_px, len(px))[:, None])
    return np.asarray(
        (centroid * area[:, None] - (lost[..., None] * where).sum(1))
        / (area - lost.sum(1))[:, None]
    )


def polygon_centroids(points: Array) -> tuple[Array, Array]:
    """Centroids (n, 2) and areas (n,) of polygons (n, k, 2)."""
    following = np.roll(points, -1, axis=1)
    cross = points[..., 0] * following[..., 1] - points[..., 1] * following[..., 0]
    twice = cross.sum(1)
    return ((points + following) * cross[..., None]).sum(1) / (3 * twice[:, None]), np.abs(
        twice
    ) / 2


def _rounded_off(outline: Array, radius: Array) -> tuple[Array, Array]:
    """Area (n, 4) and centroid (n, 4, 2) of the region between a corner of an outline (n, 4 k, 2)
    and a disc that touches both of its sides: a kite minus a sector.
    """
    corner = outline[:, ::_PER_SIDE]
    one = outline[:, 1::_PER_SIDE] - corner
    other = np.roll(outline, 1, axis=1)[:, ::_PER_SIDE] - corner
    one /= np.linalg.norm(one, axis=2, keepdims=True)
    other /= np.linalg.norm(other, axis=2, keepdims=True)
    half = np.arccos(np.clip((one * other).sum(2), -1, 1)) / 2
    kite, sector = 1 / np.tan(half), np.pi / 2 - half  # of a disc of radius 1
    to_kite = (np.cos(half) ** 2 + 1) / (3 * np.sin(half))
    to_sector = 1 / np.sin(half) - 2 * np.cos(half) / (3 * (np.pi / 2 - half))
    lost = kite - sector
    inwards = one + other
    inwards /= np.linalg.norm(inwards, axis=2, keepdims=True)
    inwards *= (radius * (kite * to_kite - sector * to_sector) / lost)[..., None]
    return radius**2 * lost, corner + inwards
