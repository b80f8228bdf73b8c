"""Shifts, rotations and scales from phases: Kuglin and Hines (1975), Reddy and Chatterji (1996)."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_LOWEST = 0.03
"""Share of the spectrum's radius around its centre that is not used for rotation, since it contains
shading and the window function.
"""


def phase_shift(a: NDArray[Any], b: NDArray[Any]) -> tuple[float, float, float]:
    """(dx, dy, response): b(x + dx, y + dy) corresponds to a(x, y); response 0 to 1, the peak's
    share of the energy.

    Both (H, W), equal shapes; shifts up to half of the size.
    """
    if a.shape != b.shape:
        raise ValueError(f"equal shapes expected, got {a.shape} and {b.shape}")
    first, second = (np.asarray(p, np.float32) - np.float32(np.mean(p)) for p in (a, b))
    (dx, dy), response = cv2.phaseCorrelate(first, second, _window(a.shape))
    return float(dx), float(dy), float(response)


def rotation_and_scale(a: NDArray[Any], b: NDArray[Any]) -> tuple[float, float, float]:
    """(degrees, scale, response) of b against a from the log-polar amplitudes of both spectra.

    b's content is a's rotated by `degrees` from x towards y and magnified by `scale`. The rotation
    is ambiguous by 180 degrees.
    """
    size = 256
    radius = min(a.shape) / 2
    logs = []
    for p in (a, b):
        amplitude = np.abs(np.fft.fftshift(np.fft.fft2((p - np.mean(p)) * _window(p.shape))))
        square = cv2.resize(np.log1p(amplitude).astype(np.float32), (2 * int(radius),) * 2)
        square = np.asarray(square * _highpass(square.shape[0]), np.float32)
        flags = cv2.WARP_POLAR_LOG | cv2.INTER_LINEAR
        logs.append(cv2.warpPolar(square, (size, 2 * size), (radius, radius), radius, flags)[:size])
    window = np.ones((size, 1), np.float32) @ cv2.createHanningWindow((size, 4), cv2.CV_32F)[1:2]
    logs = [(p - p.mean()) * window for p in logs]
    (along, around), response = cv2.phaseCorrelate(*logs)
    # a magnified image has a smaller spectrum
    scale = float(np.exp(-along * np.log(radius) / size))
    return (float(around) * 180 / size + 90) % 180 - 90, scale, float(response)


def _window(shape: tuple[int, ...]) -> NDArray[np.float32]:
    return np.asarray(cv2.createHanningWindow((shape[1], shape[0]), cv2.CV_32F), np.float32)


def _highpass(size: int) -> NDArray[np.float32]:
    """High-pass filter that increases from the centre of a spectrum (Reddy and Chatterji, (12));
    zero below _LOWEST and outside the circle.
    """
    f = (np.arange(size) - size / 2) / size
    x = np.cos(np.pi * f)[:, None] * np.cos(np.pi * f)
    far = np.hypot(f[:, None], f)
    return np.asarray(((1 - x) * (2 - x) * ((far > _LOWEST / 2) & (far < 0.5))).astype(np.float32))
