"""Gradients of patches, and whether they suffice to determine a shift."""

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

NOISE = 1.5
"""Assumed standard deviation of the noise of a pixel value, for images of 0 to 255."""
TEXTURE = 2.0
"""A patch has texture where its gradient in every direction exceeds this multiple of the noise's
own gradient.
"""
RIM = 2
"""Width in px of a patch's border where its gradient is not used."""
_PLAIN = 0.6745
"""Median of the absolute value of a normal variable, in standard deviations."""
_LAPLACIANS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_DERIVE = np.array([-1, -2, 0, 2, 1], np.float32) / 8
_SMOOTH = np.array([1, 4, 6, 4, 1], np.float32) / 16

Stack = NDArray[np.float32]
Spectra = NDArray[np.complex64]


def gradients(patches: NDArray[Any]) -> Spectra:
    """Complex gradients (n, S, S), gx + i gy per px, of patches (n, S, S), lightly smoothed; 0 at
    the border.
    """
    n, size, _ = patches.shape
    if not n:
        return np.zeros(patches.shape, np.complex64)
    tall = np.ascontiguousarray(patches, np.float32).reshape(n * size, size)
    g = np.zeros((n, size, size), np.complex64)
    inner = (slice(None), slice(RIM, -RIM), slice(RIM, -RIM))
    g.real[inner] = cv2.sepFilter2D(tall, cv2.CV_32F, _DERIVE, _SMOOTH).reshape(n, size, size)[
        inner
    ]
    g.imag[inner] = cv2.sepFilter2D(tall, cv2.CV_32F, _SMOOTH, _DERIVE).reshape(n, size, size)[
        inner
    ]
    return g


def weakest_gradient(patches: NDArray[Any]) -> NDArray[np.float64]:
    """RMS gradient (n,) per px of patches (n, S, S) along the direction in which each varies least.

    A patch with one straight edge varies along one direction only and does not determine the shift
    along the other.
    """
    g = gradients(patches) * np.sqrt(window(patches.shape[1]))
    xx, yy = (g.real**2).sum((1, 2)), (g.imag**2).sum((1, 2))
    xy = (g.real * g.imag).sum((1, 2))
    least = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    return np.asarray(np.sqrt(np.maximum(least, 0) / window(patches.shape[1]).sum()), np.float64)


def has_texture(patches: NDArray[Any], *, noise: float = NOISE) -> NDArray[np.bool_]:
    """Whether each of n patches (n, S, S) varies enough in every direction to determine a shift.

    `noise` is the standard deviation of a value's noise in the patches' own unit.
    """
    of_noise = noise * float(np.linalg.norm(_DERIVE) * np.linalg.norm(_SMOOTH))
    return weakest_gradient(patches) > TEXTURE * of_noise


def noise_in(values: NDArray[Any]) -> float:
    """Standard deviation of the noise of values (h, w), in their unit: the median of Immerkaer's
    (1996) difference of Laplacians, which edges hardly change.
    """
    rest = np.abs(cv2.filter2D(values.astype(np.float32, copy=False), cv2.CV_32F, _LAPLACIANS))
    return float(np.median(rest)) / _PLAIN / float(np.linalg.norm(_LAPLACIANS))


@lru_cache(maxsize=8)
def window(size: int) -> Stack:
    """Weights (S, S): 1 in the middle, falling to 0 over a quarter of the patch at each side."""
    edge = (np.arange(size) + 0.5 - RIM) / (size / 4)
    ramp = np.sin(np.pi / 2 * np.clip(edge, 0, 1)) ** 2
    side = ramp * ramp[::-1]
    return np.asarray(np.outer(side, side), np.float32)
