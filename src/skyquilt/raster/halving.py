"""Reduces 2 x 2 pixels to one: the step between overview levels, which takes validity into
account.
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Valid = NDArray[np.bool_]


def halve(pixels: Array, valid: Valid | None, how: str) -> tuple[Array, Valid | None]:
    """Half-size pixels (ceil(h/2), ceil(w/2), bands) and validity of (h, w, bands) ones.

    A reduced pixel is valid where any of its four pixels is; only valid ones contribute. `valid`
    None = all. Odd edges count twice. All pixels are reduced as if valid; then the few partly valid
    ones are computed again.
    """
    pixels = _even(pixels)
    plain, mixed = RULES[how]
    half = plain(pixels)
    if valid is None:
        return half, None
    quarters = np.stack(_quarters(_even(valid)))
    count = quarters.sum(0, dtype=np.uint8)
    rows, cols = np.nonzero((count > 0) & (count < 4))
    if rows.size:
        values = np.stack([quarter[rows, cols] for quarter in _quarters(pixels)])
        half[rows, cols] = mixed(values, quarters[:, rows, cols])
    return half, count > 0


def _even(array: Array) -> Array:
    """Repeats the last row or column of an odd-sized array."""
    h, w = array.shape[:2]
    if h % 2 == 0 and w % 2 == 0:
        return array
    return np.pad(array, [(0, h % 2), (0, w % 2)] + [(0, 0)] * (array.ndim - 2), mode="edge")


def _quarters(array: Array) -> tuple[Array, Array, Array, Array]:
    """Views of the upper left, upper right, lower left and lower right pixel of every 2 x 2."""
    return array[::2, ::2], array[::2, 1::2], array[1::2, ::2], array[1::2, 1::2]


def _average(pixels: Array) -> Array:
    h, w, bands = pixels.shape
    if pixels.dtype == np.uint32 or bands > 4:
        return _rounded(np.stack(_quarters(pixels)).mean(axis=0, dtype=np.float64), pixels.dtype)
    half = cv2.resize(np.ascontiguousarray(pixels), (w // 2, h // 2), interpolation=cv2.INTER_AREA)
    return half.reshape(h // 2, w // 2, bands)


def _average_mixed(values: Array, valid: Valid) -> Array:
    total = np.where(valid[..., None], values, 0).sum(0, dtype=np.float64)
    return _rounded(total / valid.sum(0)[:, None], values.dtype)


def _rounded(values: Array, dtype: np.dtype) -> Array:
    return values.astype(dtype) if dtype.kind == "f" else np.floor(values + 0.5).astype(dtype)


def _nearest(pixels: Array) -> Array:
    return pixels[::2, ::2].copy()


def _nearest_mixed(values: Array, valid: Valid) -> Array:
    return np.asarray(values[valid.argmax(0), np.arange(values.shape[1])])


def _max(pixels: Array) -> Array:
    a, b, c, d = _quarters(pixels)
    return np.maximum(np.maximum(a, b), np.maximum(c, d))


def _max_mixed(values: Array, valid: Valid) -> Array:
    lowest = -np.inf if values.dtype.kind == "f" else np.iinfo(values.dtype).min
    return np.asarray(np.where(valid[..., None], values, lowest).max(0).astype(values.dtype))


def _mode(pixels: Array) -> Array:
    a, b, c, d = _quarters(pixels)
    first = (a == b) | (a == c) | (a == d)
    second = (b == c) | (b == d)
    return np.where(first, a, np.where(second, b, np.where(c == d, c, a)))


def _mode_mixed(values: Array, valid: Valid) -> Array:
    votes = (values[:, None] == values[None]) & valid[None, ..., None]
    score = np.where(valid[..., None], votes.sum(1), -1)
    return np.asarray(np.take_along_axis(values, score.argmax(0)[None], axis=0)[0])


RULES: dict[str, tuple[Callable[[Array], Array], Callable[[Array, Valid], Array]]] = {
    "average": (_average, _average_mixed),
    "nearest": (_nearest, _nearest_mixed),
    "max": (_max, _max_mixed),
    "mode": (_mode, _mode_mixed),
}
