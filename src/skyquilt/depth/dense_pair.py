"""Heights of two photos from the disparity of every pixel, instead of that of their features.

The thesis interpolates between the features of a pair [Yahyanejad 2013, 5.2.3, Fig. 5.12]. Here the
two placed photos are rectified and matched densely (`ortho.pair_matching`), which is its disparity
along the baseline for every pixel, and heights are counted from the dominant plane as there. What
one photo hides from the other, and what is no patch of steady heights, stays unknown: filled in, it
cost more than the matching itself (r 0.78 to 0.89 instead of 0.93 to 0.99 with the true heights of
five simulated pairs).
"""

import math
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import View
from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface
from skyquilt.ortho.fill import nearest_known
from skyquilt.ortho.fusion import splatted, surface_of, without_specks
from skyquilt.ortho.ground import GreyPicture
from skyquilt.ortho.pair_matching import matched_points, pair_of

LONGEST = 1000
"""Largest longer side in px of the pictures that are compared."""
WINDOW = 5
"""Side in px of the windows that are compared."""
BELOW, ABOVE = 0.1, 0.35
"""Range searched below and above the ground, as shares of the flying height."""
STEADY, PATCH = 0.005, 40
"""Heights are kept in patches of so many cells whose neighbours differ by less than this share of
the flying height.
"""
LEAST_SHARE = 0.05
"""Least share of the cells of the map that must get a height, or the features' heights stay."""
ROUNDS = 6
"""Rounds of reweighting of the dominant plane."""


def dense_heights(
    views: tuple[View, View], grey: GreyPicture, z: float, grid: Grid
) -> tuple[Surface, Surface] | None:
    """Heights above the pair's dominant plane on cells of the map, and 1 where they were measured,
    0 elsewhere; None where the photos do not give any. `z`: level in m of the ground in the map
    frame.
    """
    a, b = views
    if a.pose.cam_H_map is not None or b.pose.cam_H_map is not None:
        return None
    height = float(a.pose.map_C[2]) - z
    longest = min(LONGEST, *(max(v.camera.width, v.camera.height) for v in views))
    gsd = height * max(a.camera.width, a.camera.height) / a.camera.focal / longest
    pair = pair_of(a, b, z, gsd) if height > 0 else None
    if pair is None:
        return None
    pictures = grey(a.photo, longest), grey(b.photo, longest)
    points = matched_points(pair, *pictures, -BELOW * height, ABOVE * height, WINDOW)
    # cells wider than pixels: narrower ones would miss some of them
    cells = grid.coarser(max(1, math.ceil(1.4 * gsd / grid.gsd)))
    if not len(points):
        return None
    found = np.full((cells.height, cells.width), np.nan, np.float32)
    cell, heights_m = splatted(points, pair.origin, cells)
    found.flat[cell] = heights_m
    known = without_specks(found, STEADY * height, PATCH)
    if known.mean() < LEAST_SHARE:
        return None
    heights = np.asarray(cv2.medianBlur(nearest_known(found, known), 5), np.float32)
    surface = surface_of((heights - _plane(heights, known)).astype(np.float32), cells)
    measured = surface_of(known.astype(np.float32), cells)
    return replace(surface, source="dense disparities"), measured


def _plane(z: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The plane (h, w) on which most of the known heights lie, by weights that fall with the
    distance from it.
    """
    rows, columns = np.indices(z.shape) / max(z.shape)
    terms = np.stack([np.ones(z.shape), rows, columns], -1)
    few = max(1, int(known.sum()) // 20000)
    A, h = terms[known][::few], z[known][::few].astype(np.float64)
    weight = np.ones(len(h))
    solved = np.zeros(3)
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        solved = np.linalg.lstsq(A * root[:, None], h * root, rcond=None)[0]
        left = np.abs(h - A @ solved)
        weight = 1 / (1 + (left / (np.median(left) + 1e-6)) ** 2)
    return np.asarray(terms @ solved)
