"""A height surface from tie points, robust to the wrong ones, and level ground."""

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.neighbours import nearest
from skyquilt.model.surface import WIDEST, Surface

Array = NDArray[np.float64]
AT_ONCE = 400_000
"""Cells that are interpolated at once, about."""


@dataclass(frozen=True, kw_only=True)
class FromTiePoints:
    """Removes outliers, interpolates nearest points by inverse distance, and smooths the result
    slightly.
    """

    neighbours: int = 8
    """Number of nearest points from which a cell is interpolated."""
    smoothing_cells: float = 1.2
    """Standard deviation of the final Gaussian in cells."""
    outlier: float = 4.0
    """Points further than this many robust deviations from their neighbours' median height are
    dropped.
    """
    version: ClassVar[int] = 1

    def __call__(self, xyz: Array, bounds: tuple[float, float, float, float]) -> Surface:
        """The surface over bounds (west, south, east, north) in m from points (P, 3) in the map
        frame.
        """
        if len(xyz) < 4:
            return level(float(np.median(xyz[:, 2])) if len(xyz) else 0.0)
        points = without_outliers(xyz, self.outlier)
        cell = grid_spacing(points, bounds)
        columns = max(2, int(np.ceil((bounds[2] - bounds[0]) / cell)) + 1)
        rows = max(2, int(np.ceil((bounds[3] - bounds[1]) / cell)) + 1)
        x = bounds[0] + np.arange(columns) * cell
        y = bounds[1] + np.arange(rows) * cell
        strip = max(1, AT_ONCE // columns)
        z = np.concatenate(
            [
                self._interpolate(
                    points, np.stack(np.meshgrid(x, y[k : k + strip]), -1).reshape(-1, 2), cell
                ).reshape(-1, columns)
                for k in range(0, rows, strip)
            ]
        )
        smooth = np.asarray(
            cv2.GaussianBlur(z.astype(np.float32), (0, 0), self.smoothing_cells), np.float32
        )
        return Surface(z=smooth, x0=bounds[0], y0=bounds[1], cell=cell, source="tie points")

    def _interpolate(self, points: Array, at: Array, cell: float) -> Array:
        k = min(self.neighbours, len(points))
        distance, index = nearest(points[:, :2], at, k)
        # beyond the points, the search radius grows with the distance to them, so that the rim
        # continues an average instead of a single point
        weight = 1.0 / (distance + 0.5 * cell + 0.5 * distance[:, :1]) ** 2
        return np.asarray((weight * points[index, 2]).sum(1) / weight.sum(1))


def without_outliers(xyz: Array, limit: float = FromTiePoints.outlier) -> Array:
    """Points (P, 3) whose height agrees with their neighbours' median within `limit` robust
    deviations of the survey; all of them where there are fewer than four.
    """
    if len(xyz) < 4:
        return xyz
    k = min(10, len(xyz))
    _, index = nearest(xyz[:, :2], xyz[:, :2], k)
    around = xyz[index, 2]
    median = np.median(around, axis=1)
    spread = 1.48 * np.median(np.abs(around - median[:, None]), axis=1)
    floor = 1.48 * np.median(np.abs(xyz[:, 2] - median)) + 1e-6
    return np.asarray(xyz[np.abs(xyz[:, 2] - median) < limit * np.maximum(spread, floor)])


def grid_spacing(points: Array, bounds: tuple[float, float, float, float]) -> float:
    """About half the typical distance of points in m, but no more than four million cells."""
    distance, _ = nearest(points[:, :2], points[:, :2], 2)
    typical = max(0.6 * float(np.median(distance[:, 1])) + 1e-3, 1e-3)
    area = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1])
    density = np.sqrt((np.ptp(points[:, 0]) * np.ptp(points[:, 1]) + 1e-6) / len(points))
    longest = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    return float(max(typical, 0.5 * density, np.sqrt(area / 4e6), longest / WIDEST))


def level(z: float) -> Surface:
    """A level surface at height z in m."""
    return Surface(z=np.full((2, 2), z, np.float32), x0=0.0, y0=0.0, cell=1.0, source="plane")
