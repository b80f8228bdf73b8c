"""Selection of keypoints distributed over the whole image."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def spread(
    xy: NDArray[Any], response: NDArray[Any], shape: tuple[int, ...], count: int, cells: int
) -> NDArray[np.int64]:
    """Indices of `count` points: in each round, the strongest remaining point of every cell of the
    image is taken.
    """
    if len(xy) <= count:
        return np.arange(len(xy))
    column, row = (xy / (shape[1], shape[0]) * cells).astype(int).clip(0, cells - 1).T
    cell = row * cells + column
    order = np.lexsort((-response, cell))
    starts = np.flatnonzero(np.r_[True, np.diff(cell[order]) != 0])
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    best = np.lexsort((-response[order], rank))[:count]
    return np.sort(order[best])
