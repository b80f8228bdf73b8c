"""Error of a registration relative to the truth."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_ACROSS = 64
"""Number of points along the longer side of the reference at which both are compared."""


def overlap_error(
    b_H_a: NDArray[Any], truth: NDArray[Any], shape_a: tuple[int, int], shape_b: tuple[int, int]
) -> float:
    """RMS distance in px of b between the positions by two transforms (3, 3), over the points of a
    (H, W) that are truly inside b (H, W). Infinite if there are none, or if the transform maps one
    to infinity.
    """
    step = max(max(shape_a) / _ACROSS, 1.0)
    y, x = np.mgrid[0 : shape_a[0] - 1 : step, 0 : shape_a[1] - 1 : step]
    px = np.c_[x.ravel(), y.ravel(), np.ones(x.size)]
    there = _projected(px @ truth.T)
    inside = ((there >= -0.5) & (there <= np.array([shape_b[1], shape_b[0]]) - 0.5)).all(1)
    if not inside.any():
        return float("inf")
    distance = ((_projected(px[inside] @ b_H_a.T) - there[inside]) ** 2).sum(1)
    return float(np.sqrt(distance.mean())) if np.isfinite(distance).all() else float("inf")


def _projected(points: NDArray[Any]) -> NDArray[np.float64]:
    with np.errstate(all="ignore"):
        return np.asarray(points[:, :2] / points[:, 2:], np.float64)
