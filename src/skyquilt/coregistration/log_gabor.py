"""Log-Gabor responses, phase congruency and the maximum index map.

Kovesi (1999), "Image features from phase congruency", and (2003) for the moments; Li, Hu and Ai
(2020), RIFT, for the map of the orientation with the strongest response, which hardly depends on
the brightness on either side of an edge.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

SCALES = 4
"""Number of wavelengths."""
ORIENTATIONS = 6
"""Number of directions, 30 degrees apart."""
_SHORTEST = 3.0
_FACTOR = 1.6
_BANDWIDTH = 0.75
_NOISE = 2.0
"""Number of standard deviations of the noise energy that are subtracted."""
_CUTOFF, _SHARP = 0.45, 15
"""Low-pass filter that excludes the corners of the spectrum: cut-off as a share of the sampling
rate, and order.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Phase:
    """Filter responses of an image."""

    index: NDArray[np.uint8]
    """(h, w) index of the strongest of the `ORIENTATIONS` over all scales: the maximum index
    map.
    """
    edges: NDArray[np.float32]
    """(h, w) maximum moment of phase congruency: edges and corners, about in [0, 1]."""
    corners: NDArray[np.float32]
    """(h, w) minimum moment: corners alone."""


def phase(grey: NDArray[np.float32]) -> Phase:
    """Filters an image (h, w)."""
    spectrum = scipy.fft.fft2(grey.astype(np.float32))
    radius, angle = _polar(grey.shape)
    bands = _bands(radius)
    strengths, congruent = [], []
    for k in range(ORIENTATIONS):
        amplitude, energy = _oriented(spectrum, bands, angle, k * np.pi / ORIENTATIONS)
        strengths.append(amplitude)
        congruent.append(energy / (amplitude + 1e-4 * amplitude.max() + 1e-9))
    edges, corners = _moments(np.stack(congruent))
    return Phase(index=np.argmax(strengths, 0).astype(np.uint8), edges=edges, corners=corners)


def _polar(shape: tuple[int, ...]) -> tuple[NDArray[Any], NDArray[Any]]:
    y, x = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])[None]
    radius = np.hypot(x, y)
    radius[0, 0] = 1.0
    return radius, np.arctan2(y, x) + 0 * radius


def _bands(radius: NDArray[Any]) -> list[NDArray[np.float32]]:
    low = 1 / (1 + (radius / _CUTOFF) ** (2 * _SHARP))
    bands = []
    for s in range(SCALES):
        centre = 1 / (_SHORTEST * _FACTOR**s)
        band = np.exp(-(np.log(radius / centre) ** 2) / (2 * np.log(_BANDWIDTH) ** 2)) * low
        band[0, 0] = 0
        bands.append(band.astype(np.float32))
    return bands


def _oriented(
    spectrum: NDArray[Any], bands: list[NDArray[np.float32]], angle: NDArray[Any], direction: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Summed amplitude over scales, and energy above the noise, both (h, w), of one direction."""
    off = np.abs(np.angle(np.exp(1j * (angle - direction))))
    spread = (np.cos(np.minimum(off * ORIENTATIONS / 2, np.pi)) + 1) / 2
    spread = spread.astype(np.float32)
    total: NDArray[Any] = np.zeros(spectrum.shape, np.complex64)
    amplitude, noise = np.zeros(spectrum.shape, np.float32), 0.0
    for s, band in enumerate(bands):
        response = scipy.fft.ifft2(spectrum * (band * spread))
        size = np.abs(response)
        amplitude += size
        total = total + response
        if s == 0:  # mostly noise: its Rayleigh parameter gives the noise of all scales
            tau = float(np.median(size)) / np.sqrt(np.log(4))
            sums = tau * (1 - _FACTOR**-SCALES) / (1 - 1 / _FACTOR)
            noise = sums * (np.sqrt(np.pi / 2) + _NOISE * np.sqrt((4 - np.pi) / 2))
    return amplitude, np.maximum(np.abs(total) - noise, 0).astype(np.float32)


def _moments(congruent: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Maximum and minimum moment of phase congruency (orientations, h, w)."""
    angles = np.arange(len(congruent)) * np.pi / len(congruent)
    x, y = congruent * np.cos(angles)[:, None, None], congruent * np.sin(angles)[:, None, None]
    xx, yy, xy = ((p * q).sum(0) * 2 / len(congruent) for p, q in ((x, x), (y, y), (x, y)))
    root = np.sqrt(4 * xy**2 + (xx - yy) ** 2)
    return ((xx + yy + root) / 2).astype(np.float32), ((xx + yy - root) / 2).astype(np.float32)
