"""The plane that most tie points lie near: the level of a map of photos that report neither
positions nor angles.
"""

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.frames import turning
from skyquilt.model.poses import Alignment

Array = NDArray[np.float64]
NEAR = 0.03
"""Points within this share of the median flying height are near a plane."""
TRIES = 400
"""Planes tried, each through three points."""


def dominant_normal(xyz: Array, near_m: float) -> Array:
    """The upward unit normal (3,) of the plane with the most points (n, 3), at least three, within
    a distance in m; refined on those (Fischler and Bolles 1981).
    """
    rng = np.random.default_rng(0)
    a, b, c = xyz[rng.integers(len(xyz), size=(3, TRIES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    fit = length > 1e-9
    normals, a = normals[fit] / length[fit, None], a[fit]
    if not len(normals):
        return np.array([0.0, 0.0, 1.0])
    some = xyz[:: max(1, len(xyz) // 4000)]
    number = [(np.abs((some - p) @ n) < near_m).sum() for n, p in zip(normals, a, strict=True)]
    normal, place = normals[int(np.argmax(number))], a[int(np.argmax(number))]
    for _ in range(5):
        mine = xyz[np.abs((xyz - place) @ normal) < near_m]
        place = mine.mean(0)
        normal = np.linalg.svd(mine - place, full_matrices=False)[2][2]
    return np.asarray(normal if normal[2] > 0 else -normal)


def levelled(alignment: Alignment) -> Alignment:
    """The alignment turned so that its dominant plane is level; unchanged without tie points."""
    xyz = alignment.ties.xyz
    if len(xyz) < 3:
        return alignment
    C = np.array([p.map_C for p in alignment.poses.values()])
    normal = dominant_normal(xyz, NEAR * _height(C, xyz))
    up = np.array([0.0, 0.0, 1.0])
    side = np.cross(normal, up)
    Q = turning(np.array([normal, side, np.cross(normal, side)]), _frame(up, side))
    if np.linalg.norm(side) < 1e-9:
        return alignment
    return alignment.carried(Q, 1.0, np.median(xyz, axis=0))


def _frame(up: Array, side: Array) -> Array:
    return np.array([up, side, np.cross(up, side)])


def _height(C: Array, xyz: Array) -> float:
    """Median distance of the centres from the median point, in m."""
    return float(np.median(np.linalg.norm(C - np.median(xyz, axis=0), axis=1)))
