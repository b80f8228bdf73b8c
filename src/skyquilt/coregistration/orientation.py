"""Edge orientation fields: what different spectral bands have in common is the direction of edges,
whichever side is brighter.

An image is converted to fields of orientation with normalised contrast. With g = |g| exp(i t) the
gradient, the fields are w exp(2 i t) and w exp(4 i t): both are equal for t and t + pi, so reversed
contrast has no effect. The second field distinguishes orientations more sharply than the first
alone. w is the gradient's length divided by the RMS of its surroundings, so that faint and strong
structure have equal weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from skyquilt.coregistration.usable import Usable
from skyquilt.model.registration import Matrix

Fields = NDArray[Any]
"""(h, w, 4) 32-bit floats, see above."""
BLUR = 1.0
"""Standard deviation in px of the smoothing before gradients are taken."""
SURROUNDINGS = 1 / 16
"""Standard deviation of the window in which contrast is normalised, as a share of the image
side.
"""
FLOOR = 0.3
"""Share of the median contrast that is added to every contrast, so that flat areas stay weak."""
STRONGEST = 2.0
"""Largest weight, so that a single bright object does not dominate."""
_OWN = 0.03
"""Share of the image around a place that belongs to its peak."""
MARGIN = 5
"""Width in px of the neighbourhood that must be valid for a gradient to be used."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Orientation:
    """The fields of one image at one resolution."""

    fields: Fields
    """(h, w, 4): real and imaginary parts of w exp(2 i t), then of w exp(4 i t)."""
    valid: NDArray[Any]
    """(h, w) 1 where a gradient could be computed, else 0."""
    small_S_full: Matrix
    """(3, 3) from full-size pixels to pixels of this resolution."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in px."""
        return self.fields.shape[0], self.fields.shape[1]

    @cached_property
    def channels(self) -> NDArray[np.float32]:
        """(4, h, w) the fields."""
        return channels(self.fields)

    @cached_property
    def strength(self) -> NDArray[np.float32]:
        """(h, w) sum of the squares of the fields."""
        return strength(self.fields)


def channels(fields: Fields) -> NDArray[np.float32]:
    """(4, h, w) fields."""
    return np.ascontiguousarray(np.moveaxis(fields, -1, 0))


def strength(fields: Fields) -> NDArray[np.float32]:
    """(h, w) sum of the squares of fields."""
    return np.asarray(np.einsum("ijk,ijk->ij", fields, fields))


def orientation(
    grey: NDArray[np.float32],
    valid: NDArray[np.bool_],
    side: float,
    blur: float = BLUR,
    *,
    quick: bool = False,
) -> Orientation:
    """Fields of an image (H, W) reduced to the area of a square of `side` px (never enlarged).

    `quick`: contrast is normalised by that of the surroundings at a quarter of the size, which
    changes fields by 0.015 at most (of 2) and takes a quarter of the time.
    """
    small, whole, small_S_full = shrunken(grey, valid, side)
    return of_bands(small, whole, small_S_full, blur, quick=quick)


def of_bands(
    small: NDArray[Any],
    whole: NDArray[np.bool_],
    small_S_full: Matrix,
    blur: float = BLUR,
    *,
    quick: bool = False,
) -> Orientation:
    """Fields of an image (h, w) or (h, w, bands) at its own resolution; `whole` (h, w): its valid
    pixels; `blur`: standard deviation in px of the smoothing before gradients are taken.

    Gradients g of several bands add up as g^2: the direction along which all of them together
    change most (Di Zenzo 1986), whichever way each of them changes.
    """
    inner = cv2.erode(
        whole.astype(np.float32),
        np.ones((MARGIN, MARGIN)),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    smooth = np.asarray(cv2.GaussianBlur(small, (0, 0), blur))
    return Orientation(fields=_fields(smooth, inner, quick), valid=inner, small_S_full=small_S_full)


def _fields(small: NDArray[Any], valid: NDArray[Any], quick: bool) -> Fields:
    bands = small[..., None] if small.ndim == 2 else small
    square = np.zeros(small.shape[:2], np.complex64)
    for band in np.moveaxis(bands, -1, 0):
        band = np.ascontiguousarray(band)
        g = cv2.Sobel(band, cv2.CV_32F, 1, 0) + 1j * cv2.Sobel(band, cv2.CV_32F, 0, 1)
        square += g * g
    strength = np.abs(square)
    length = np.sqrt(strength)
    weight = np.minimum(length / _surroundings(length, valid, quick), STRONGEST) * valid
    double = square / np.maximum(strength, 1e-12)
    first, second = weight * double, weight * double * double
    return np.stack([first.real, first.imag, second.real, second.imag], -1).astype(np.float32)


def _surroundings(length: NDArray[Any], valid: NDArray[Any], quick: bool) -> NDArray[np.float32]:
    """RMS gradient around each pixel, over valid ones, plus the floor."""
    sigma = np.sqrt(length.size) * SURROUNDINGS
    square = length * length * valid
    if quick:
        share, rms = (_far_blurred(v, sigma) for v in (valid, square))
    else:
        share, rms = (cv2.GaussianBlur(v, (0, 0), sigma) for v in (valid, square))
    rms = np.sqrt(rms / (share + 1e-3))
    inside = rms[valid > 0]
    return np.asarray(
        rms + FLOOR * (np.median(inside) if inside.size else 0) + 1e-3 * (rms.max() or 1.0)
    )


_QUARTER = 4


def _far_blurred(values: NDArray[Any], sigma: float) -> NDArray[Any]:
    """Values (h, w) blurred over many pixels, at a quarter of their size."""
    h, w = values.shape
    size = (max(1, w // _QUARTER), max(1, h // _QUARTER))
    small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), sigma / _QUARTER)
    return np.asarray(cv2.resize(blurred, (w, h), interpolation=cv2.INTER_LINEAR))


def shrunken(
    grey: NDArray[np.float32], valid: NDArray[np.bool_], side: float
) -> tuple[NDArray[Any], NDArray[np.bool_], Matrix]:
    """An image (H, W) or (H, W, bands) and its validity (H, W) averaged to the area of a square of
    `side` px (never enlarged), and the (3, 3) transform to its pixels. Both axes are scaled
    equally, so that a similarity remains one.
    """
    factor = min(1.0, side / float(np.sqrt(valid.size)))
    small, share = (
        np.asarray(cv2.resize(one, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))
        for one in (grey, valid.astype(np.float32))
    )
    off = (factor - 1) / 2
    return small, share > 0.99, np.array([[factor, 0, off], [0, factor, off], [0, 0, 1.0]])


def between(a: Orientation, b: Orientation, b_H_a: Matrix) -> Matrix:
    """Converts a transform of full-size pixels to pixels of these two resolutions."""
    m = b.small_S_full @ b_H_a @ np.linalg.inv(a.small_S_full)
    return np.asarray(m / m[2, 2])


def full_size(a: Orientation, b: Orientation, small: Matrix) -> Matrix:
    """The inverse of `between`."""
    m = np.linalg.inv(b.small_S_full) @ small @ a.small_S_full
    return np.asarray(m / m[2, 2])


def warped(a: Orientation, b_H_a: Matrix, shape: tuple[int, int]) -> tuple[Fields, NDArray[Any]]:
    """a's fields (h, w, 4) and validity (h, w) resampled to b's frame; orientations are rotated
    accordingly.
    """
    size = (shape[1], shape[0])
    fields = cv2.warpPerspective(a.fields, b_H_a, size)
    valid = cv2.warpPerspective(a.valid, b_H_a, size)
    angle = float(np.arctan2(b_H_a[1, 0] - b_H_a[0, 1], b_H_a[0, 0] + b_H_a[1, 1]))
    return turned(fields, angle), valid


def turned(fields: Fields, angle: float) -> Fields:
    """Fields (h, w, 4), or the first of both alone (h, w, 2), with orientations rotated by an angle
    in radians (x towards y); pixels are not moved.
    """
    turn = np.exp(np.array([2j, 4j]) * angle).astype(np.complex64)
    both = np.ascontiguousarray(fields).view(np.complex64)
    out = np.empty_like(both)
    for k in range(both.shape[-1]):  # one after the other: two thirds of the time of pairs
        np.multiply(both[..., k], turn[k], out=out[..., k])
    return out.view(np.float32)


def spectra(fields: Fields, shape: tuple[int, int]) -> NDArray[np.complex64]:
    """Fourier transforms (2, h, w) of both complex fields, padded to `shape`."""
    both = np.ascontiguousarray(fields).view(np.complex64)
    return np.asarray(scipy.fft.fft2(np.moveaxis(both, -1, 0), s=shape, axes=(1, 2)))


def own_radius(shape: tuple[int, int]) -> int:
    """Radius in px around a place that belongs to its peak, in pictures of this shape."""
    return max(4, int(_OWN * shape[0]))


def at_all_shifts(
    a: Orientation, b: Orientation, b_H_a: Matrix, overlap: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """How well a fits b at all shifts of a transform: the sum of products over the root of the
    overlap, and whether the overlap is above a share of that at the transform; 0 where it is not.

    Element (y, x), counted from the end where negative, compares a at p + (x, y) with b at p.
    """
    fields, valid = warped(a, b_H_a, b.shape)
    shape = (scipy.fft.next_fast_len(2 * b.shape[0]), scipy.fft.next_fast_len(2 * b.shape[1]))
    cross = (spectra(fields, shape) * np.conj(spectra(b.fields, shape))).sum(0)
    masks = scipy.fft.fft2(valid, s=shape) * np.conj(scipy.fft.fft2(b.valid, s=shape))
    shared = scipy.fft.ifft2(masks).real
    field = scipy.fft.ifft2(cross).real
    enough = shared > overlap * shared[0, 0]
    return np.where(enough, field / np.sqrt(np.maximum(shared, 1)), 0), enough


class Pyramid:
    """Orientation fields of two images that show about the same ground; each resolution is computed
    when first needed. Both have about as many pixels, those of the smaller image at most: in fields
    of finer pixels, resampled to coarser ones, other edges are the strong ones.
    """

    def __init__(self, *, a: Usable, b: Usable, sides: Sequence[float]) -> None:
        """`sides`: sides in px of the squares to whose areas the images are reduced."""
        self._pictures, self._sides = (a, b), tuple(sides)
        self._levels: dict[int, tuple[Orientation, Orientation]] = {}

    @property
    def least(self) -> int:
        """Pixels of the smaller image."""
        return min(p.grey.size for p in self._pictures)

    def finer(self, side: float, blur: float) -> tuple[Orientation, Orientation]:
        """a and b at another resolution than those of the levels, smoothed otherwise."""
        side = min(side, float(np.sqrt(self.least)))
        a, b = (orientation(p.grey, p.valid, side, blur) for p in self._pictures)
        return a, b

    @property
    def last(self) -> int:
        """The finest level."""
        return len(self._sides) - 1

    def at(self, level: int) -> tuple[Orientation, Orientation]:
        """a and b at a level."""
        if level not in self._levels:
            self._levels[level] = self.finer(self._sides[level], BLUR)
        return self._levels[level]

    def moved(self, small: Matrix, source: int, target: int) -> Matrix:
        """Converts a transform in px of one level to px of another."""
        return self.small(self.full(small, source), target)

    def small(self, full: Matrix, level: int) -> Matrix:
        """Converts a transform in px of the images to px of a level."""
        return between(*self.at(level), full)

    def full(self, small: Matrix, level: int) -> Matrix:
        """Converts a transform in px of a level to px of the images."""
        return full_size(*self.at(level), small)
