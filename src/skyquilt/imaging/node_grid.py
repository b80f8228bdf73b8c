"""Grids of nodes from corner to corner of a picture, linear between them."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def nodes_around(
    place: NDArray[Any], shape: tuple[int, int]
) -> list[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Number and weight (N,) of each of the four nodes of a grid (h, w) around places (N, 2), x and
    y in shares of its sides: 0 to 1.
    """
    height, width = shape
    x, y = (np.clip(p, 0, 1) * (n - 1) for p, n in zip(place.T, (width, height), strict=True))
    left, top = (
        np.minimum(np.floor(p).astype(np.int64), n - 2) for p, n in ((x, width), (y, height))
    )
    right, low = x - left, y - top
    at = top * width + left
    return [
        (at, (1 - right) * (1 - low)),
        (at + 1, right * (1 - low)),
        (at + width, (1 - right) * low),
        (at + width + 1, right * low),
    ]


def over(grid: NDArray[np.float32], x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float32]:
    """A grid of nodes at places x, y (h, w), in shares of its sides: 0 to 1."""
    u, v = (
        (np.clip(p, 0, 1) * (n - 1)).astype(np.float32)
        for p, n in ((x, grid.shape[1]), (y, grid.shape[0]))
    )
    return np.asarray(cv2.remap(grid, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
