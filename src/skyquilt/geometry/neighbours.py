"""Exact nearest neighbours in the plane, by OpenCV, and pairs within reach: for few photos, loading
SciPy's tree takes longer than the search.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_SINGLE_TREE = 4
"""FLANN_INDEX_KDTREE_SINGLE: a single tree with exact search, unlike FLANN's other indices."""
_TO_THE_END = -1
_AT_ONCE = 100_000
"""Places that are looked up at once, to bound memory."""


def nearest(
    points: NDArray[Any], at: NDArray[Any], k: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The k points (n, 2) nearest to each place `at` (m, 2): distances (m, k), ascending, and
    indices (m, k).

    Distances are computed in single precision about the centre of the points; k may not exceed n.
    """
    if not 0 < k <= len(points):
        raise ValueError(
            f"1 to {len(points)} neighbours of {len(points)} points can be requested, not {k}"
        )
    points, at = np.asarray(points, np.float64), np.asarray(at, np.float64)
    middle = points.mean(0)
    tree = cv2.flann.Index(
        _single(points - middle), {"algorithm": _SINGLE_TREE, "leaf_max_size": 10}
    )
    distances, indices = np.empty((len(at), k)), np.empty((len(at), k), np.int64)
    for low in range(0, len(at), _AT_ONCE):
        some = slice(low, low + _AT_ONCE)
        index, _ = tree.knnSearch(_single(at[some] - middle), k, params={"checks": _TO_THE_END})
        distance = np.linalg.norm(points[index] - at[some, None], axis=2)
        order = np.argsort(distance, axis=1, kind="stable")
        distances[some] = np.take_along_axis(distance, order, 1)
        indices[some] = np.take_along_axis(index, order, 1)
    return distances, indices


def pairs_within(points: NDArray[Any], reach: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices i (n,) and j (n,) of all pairs i < j of points (m, 2) at most `reach` apart, in
    order of i and j; in memory of the pairs found, not of all pairs.
    """
    points = np.asarray(points, np.float64)
    if len(points) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    longer = np.ptp(points, axis=0).argmax()
    order = np.argsort(points[:, longer], kind="stable")
    xy = points[order]
    along = xy[:, longer]
    last = np.searchsorted(along, along + reach * (1 + 1e-9), side="right")
    found = []
    for k, end in enumerate(last.tolist()):
        apart = np.hypot(*(xy[k + 1 : end] - xy[k]).T)
        found.append(k + 1 + np.flatnonzero(apart <= reach))
    a = order[np.repeat(np.arange(len(xy)), [len(f) for f in found])]
    b = order[np.concatenate(found)]
    i, j = np.minimum(a, b), np.maximum(a, b)
    by = np.lexsort((j, i))
    return i[by], j[by]


def _single(xy: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(xy, np.float32)
