"""What spectra have in common: where edges run, whichever side of them is brighter.

A picture becomes fields of unit-contrast orientation. With g = |g| exp(i t) the gradient, the
fields are w exp(2 i t) and w exp(4 i t): both are the same for t and t + pi, so a reversed contrast
changes nothing; the second tells orientations apart more sharply than the first alone. w is the
gradient's length over its surroundings' RMS, so that faint and strong structure weigh alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from skyquilt.coregistration.usable import Usable
from skyquilt.model.registration import Matrix

Fields = NDArray[Any]
"""(h, w, 4) of 32-bit numbers, see above."""
BLUR = 1.0
"""Standard deviation in px of the smoothing before gradients are taken."""
SURROUNDINGS = 1 / 16
"""Standard deviation of the surroundings that contrast is measured against, as a share of the side.
"""
FLOOR = 0.3
"""Share of the median contrast that is added to every contrast: flat areas stay weak."""
STRONGEST = 2.0
"""Largest weight: one glaring lamp must not decide."""
MARGIN = 5
"""Px: width of the neighbourhood whose pixels must all be picture for a gradient to count."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Orientation:
    """The fields of one picture at one resolution."""

    fields: Fields
    """(h, w, 4): real and imaginary parts of w exp(2 i t), then of w exp(4 i t)."""
    valid: NDArray[Any]
    """(h, w) 1 where a gradient could be taken, else 0."""
    small_S_full: Matrix
    """(3, 3) takes full-size pixels to pixels of this resolution."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in px."""
        return self.fields.shape[0], self.fields.shape[1]


def orientation(grey: NDArray[np.float32], valid: NDArray[np.bool_], side: float) -> Orientation:
    """Fields of a picture (H, W) shrunken to the area of a square of `side` px (never enlarged)."""
    small, whole, small_S_full = shrunken(grey, valid, side)
    return of_bands(small, whole, small_S_full)


def of_bands(small: NDArray[Any], whole: NDArray[np.bool_], small_S_full: Matrix) -> Orientation:
    """Fields of a picture (h, w) or (h, w, bands) at its own resolution; `whole` (h, w) where it is
    known.

    Gradients g of several bands add up as g^2: the direction along which all of them together
    change most (Di Zenzo 1986), whichever way each of them changes.
    """
    inner = cv2.erode(
        whole.astype(np.float32),
        np.ones((MARGIN, MARGIN)),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    smooth = np.asarray(cv2.GaussianBlur(small, (0, 0), BLUR))
    return Orientation(fields=_fields(smooth, inner), valid=inner, small_S_full=small_S_full)


def _fields(small: NDArray[Any], valid: NDArray[Any]) -> Fields:
    bands = small[..., None] if small.ndim == 2 else small
    square = np.zeros(small.shape[:2], np.complex64)
    for band in np.moveaxis(bands, -1, 0):
        band = np.ascontiguousarray(band)
        g = cv2.Sobel(band, cv2.CV_32F, 1, 0) + 1j * cv2.Sobel(band, cv2.CV_32F, 0, 1)
        square += g * g
    strength = np.abs(square)
    length = np.sqrt(strength)
    weight = np.minimum(length / _surroundings(length, valid), STRONGEST) * valid
    double = square / np.maximum(strength, 1e-12)
    first, second = weight * double, weight * double * double
    return np.stack([first.real, first.imag, second.real, second.imag], -1).astype(np.float32)


def _surroundings(length: NDArray[Any], valid: NDArray[Any]) -> NDArray[np.float32]:
    """RMS gradient about each pixel, over valid ones, and the floor."""
    sigma = np.sqrt(length.size) * SURROUNDINGS
    share = cv2.GaussianBlur(valid, (0, 0), sigma) + 1e-3
    rms = np.sqrt(cv2.GaussianBlur(length * length * valid, (0, 0), sigma) / share)
    inside = rms[valid > 0]
    return np.asarray(
        rms + FLOOR * (np.median(inside) if inside.size else 0) + 1e-3 * (rms.max() or 1.0)
    )


def shrunken(
    grey: NDArray[np.float32], valid: NDArray[np.bool_], side: float
) -> tuple[NDArray[Any], NDArray[np.bool_], Matrix]:
    """A picture (H, W) or (H, W, bands) and its validity (H, W) averaged down to the area of a
    square of `side` px (never enlarged), and the (3, 3) that takes its pixels there. Both axes
    shrink alike, so a similarity stays one.
    """
    factor = min(1.0, side / float(np.sqrt(valid.size)))
    small, share = (
        np.asarray(cv2.resize(one, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))
        for one in (grey, valid.astype(np.float32))
    )
    off = (factor - 1) / 2
    return small, share > 0.99, np.array([[factor, 0, off], [0, factor, off], [0, 0, 1.0]])


def between(a: Orientation, b: Orientation, b_H_a: Matrix) -> Matrix:
    """A transform of full-size pixels as one of these two resolutions' pixels."""
    m = b.small_S_full @ b_H_a @ np.linalg.inv(a.small_S_full)
    return np.asarray(m / m[2, 2])


def full_size(a: Orientation, b: Orientation, small: Matrix) -> Matrix:
    """The reverse of `between`."""
    m = np.linalg.inv(b.small_S_full) @ small @ a.small_S_full
    return np.asarray(m / m[2, 2])


def warped(a: Orientation, b_H_a: Matrix, shape: tuple[int, int]) -> tuple[Fields, NDArray[Any]]:
    """a's fields and validity as they would be in b's frame, (h, w, 4) and (h, w); orientations
    turn along.
    """
    size = (shape[1], shape[0])
    fields = cv2.warpPerspective(a.fields, b_H_a, size)
    valid = cv2.warpPerspective(a.valid, b_H_a, size)
    angle = float(np.arctan2(b_H_a[1, 0] - b_H_a[0, 1], b_H_a[0, 0] + b_H_a[1, 1]))
    return turned(fields, angle), valid


def turned(fields: Fields, angle: float) -> Fields:
    """Fields whose orientations are turned by an angle in radians (x towards y); pixels stay."""
    turn = np.exp(np.array([2j, 4j]) * angle).astype(np.complex64)
    out = np.ascontiguousarray(fields).view(np.complex64) * turn
    return out.view(np.float32)


def spectra(fields: Fields, shape: tuple[int, int]) -> NDArray[np.complex64]:
    """Fourier transforms (2, h, w) of both complex fields, padded to `shape`."""
    both = np.ascontiguousarray(fields).view(np.complex64)
    return np.asarray(scipy.fft.fft2(np.moveaxis(both, -1, 0), s=shape, axes=(1, 2)))


class Pyramid:
    """Orientation fields of two pictures, each resolution made when first asked for."""

    def __init__(self, *, a: Usable, b: Usable, sides: Sequence[float]) -> None:
        """`sides`: px of the squares whose areas the pictures are shrunken to."""
        self._pictures, self._sides = (a, b), tuple(sides)
        self._levels: dict[int, tuple[Orientation, Orientation]] = {}

    def finest(self, side: float) -> tuple[Orientation, Orientation] | None:
        """a and b at a side beyond the last level; None where one of them is not that large."""
        if any(one.grey.size < side**2 for one in self._pictures):
            return None
        a, b = (orientation(p.grey, p.valid, side) for p in self._pictures)
        return a, b

    @property
    def last(self) -> int:
        """The finest level."""
        return len(self._sides) - 1

    def at(self, level: int) -> tuple[Orientation, Orientation]:
        """a and b at a level."""
        if level not in self._levels:
            a, b = (orientation(p.grey, p.valid, self._sides[level]) for p in self._pictures)
            self._levels[level] = a, b
        return self._levels[level]

    def moved(self, small: Matrix, source: int, target: int) -> Matrix:
        """A transform in px of one level in those of another."""
        return self.small(self.full(small, source), target)

    def small(self, full: Matrix, level: int) -> Matrix:
        """A transform in px of the pictures in those of a level."""
        return between(*self.at(level), full)

    def full(self, small: Matrix, level: int) -> Matrix:
        """A transform in px of a level in those of the pictures."""
        return full_size(*self.at(level), small)
