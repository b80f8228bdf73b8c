"""Keypoints of phase congruency, described by histograms of the maximum index map, in RIFT2's
manner.

RIFT (Li, Hu and Ai 2020) makes its descriptor independent of rotation by a ring of filter
sequences, RIFT2 (2023) by the patch's dominant index; here the dominant direction is found to a
fraction of an index, the patch is sampled along it and its indices are counted from it. Directions
are known modulo 180 degrees. The opposite direction is tried when descriptors are compared; it
gives the same descriptor with its cells in reverse order.
"""

from dataclasses import dataclass
from typing import Any

import cv2
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


CELLS = 6
"""Cells along each side of a patch."""
_FAST = 4
"""Threshold of FAST corners in levels of 255."""
_BORDER = 6
"""Width in px of the border of the valid area in which no keypoint is taken."""


@dataclass(frozen=True, kw_only=True, eq=False)
class IndexFeatures:
    """Keypoints and descriptors."""

    px: NDArray[np.float64]
    """(n, 2) px of the resolution in which they were found."""
    vectors: NDArray[np.float32]
    """(n, CELLS**2, ORIENTATIONS) descriptors of unit length."""

    def __len__(self) -> int:
        return len(self.px)


def index_features(phase: Phase, valid: NDArray[Any], *, count: int, patch: int) -> IndexFeatures:
    """The strongest keypoints, spread out, with descriptors of patches of `patch` px."""
    px = _keypoints(phase, valid, count)
    if not len(px):  # OpenCV refuses to resample at no places
        return IndexFeatures(px=px, vectors=np.zeros((0, CELLS**2, ORIENTATIONS), np.float32))
    share = [
        cv2.blur(((phase.index == k) * valid).astype(np.float32), (patch // CELLS,) * 2)
        for k in range(ORIENTATIONS)
    ]
    maps = np.stack(share, -1).astype(np.float32)
    whole = cv2.blur(maps, (patch, patch))
    middle = np.rint(px).astype(int)
    direction = _dominant(whole[middle[:, 1], middle[:, 0]])
    return IndexFeatures(px=px, vectors=_vectors(maps, px, direction, patch))


def similarities(a: IndexFeatures, b: IndexFeatures) -> NDArray[np.float32]:
    """(len(a), len(b)) dot products, the better of both opposite directions."""
    fa, fb = a.vectors.reshape(len(a), -1), b.vectors.reshape(len(b), -1)
    turned = b.vectors[:, ::-1].reshape(len(b), -1)
    return np.asarray(np.maximum(fa @ fb.T, fa @ turned.T))


def mutual(a: IndexFeatures, b: IndexFeatures) -> tuple[NDArray[Any], NDArray[Any]]:
    """Indices into a and b of mutual nearest neighbours."""
    if not len(a) or not len(b):
        return np.zeros(0, int), np.zeros(0, int)
    likeness = similarities(a, b)
    there, back = likeness.argmax(1), likeness.argmax(0)
    rows = np.flatnonzero(back[there] == np.arange(len(a)))
    return rows, there[rows]


def _keypoints(phase: Phase, valid: NDArray[Any], count: int) -> NDArray[np.float64]:
    """FAST on both moments, strongest first within each cell of a coarse grid."""
    inner = cv2.erode(valid.astype(np.uint8), np.ones((2 * _BORDER + 1,) * 2), borderValue=0)
    points = []
    for field in (phase.corners, phase.edges):
        top = float(np.percentile(field, 99.5)) or 1.0
        picture = np.clip(field / top * 255, 0, 255).astype(np.uint8)
        found = cv2.FastFeatureDetector.create(_FAST).detect(picture, inner)
        points += [(p.pt[0], p.pt[1], p.response) for p in found]
    table = np.array(points, np.float64).reshape(-1, 3)
    return _spread(table, valid.shape, count)


def _spread(
    table: NDArray[np.float64], shape: tuple[int, ...], count: int, cells: int = 12
) -> NDArray[np.float64]:
    cell = (table[:, 1] * cells // shape[0]) * cells + table[:, 0] * cells // shape[1]
    order = np.lexsort((-table[:, 2], cell))
    starts = (
        np.flatnonzero(np.r_[True, np.diff(cell[order]) != 0]) if len(order) else np.zeros(0, int)
    )
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    return table[order[np.argsort(rank, kind="stable")][:count], :2]


def _dominant(histograms: NDArray[np.float32]) -> NDArray[np.float64]:
    """(n,) direction in indices, by a parabola through the highest bin and its neighbours."""
    n = np.arange(len(histograms))
    top = histograms.argmax(1)
    left, right = histograms[n, top - 1], histograms[n, (top + 1) % ORIENTATIONS]
    bend = left - 2 * histograms[n, top] + right
    return np.asarray(
        top + np.where(bend < -1e-9, (left - right) / (2 * np.minimum(bend, -1e-9)), 0)
    )


def _vectors(
    maps: NDArray[Any], px: NDArray[Any], direction: NDArray[Any], patch: int
) -> NDArray[np.float32]:
    """Cells sampled along each keypoint's direction, indices counted from it."""
    step = patch / CELLS
    y, x = np.mgrid[:CELLS, :CELLS].reshape(2, -1) * step - (CELLS - 1) / 2 * step
    angle = direction * np.pi / ORIENTATIONS
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    u = (px[:, :1] + c * x - s * y).astype(np.float32)
    v = (px[:, 1:] + s * x + c * y).astype(np.float32)
    cells = np.stack(
        [
            cv2.remap(np.ascontiguousarray(maps[..., k]), u, v, cv2.INTER_LINEAR)
            for k in range(ORIENTATIONS)
        ],
        -1,
    )
    whole = np.floor(direction).astype(int)
    part = (direction - whole)[:, None, None].astype(np.float32)
    order = (np.arange(ORIENTATIONS)[None] + whole[:, None]) % ORIENTATIONS
    low = np.take_along_axis(cells, order[:, None, :], 2)
    high = np.take_along_axis(cells, (order[:, None, :] + 1) % ORIENTATIONS, 2)
    vectors = np.sqrt((1 - part) * low + part * high)
    length = np.linalg.norm(vectors.reshape(len(px), -1), axis=1)[:, None, None]
    return np.asarray(vectors / np.maximum(length, 1e-6), np.float32)
