"""Blobs by the determinant of box-filtered second derivatives: SURF's fast Hessian (Bay et al.
2008, section 3).

A lobe of l px gives a filter of side 3 l, which approximates a Gaussian of sigma 1.2 * 3 l / 9. In
each octave four filters are compared; lobes grow by 2, 4, 8, ... px from filter to filter, from
octave to octave, and so do the steps.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_LAYERS = 4
_CROSS = 0.9
"""Weight of the mixed derivative, which balances boxes against Gaussians [Bay (3)]."""
_ROWS = 48
"""Number of rows processed at a time, so that they fit in the processor's cache."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Blobs:
    """Maxima of the determinant over place and scale."""

    xy: NDArray[np.float64]
    """(N, 2) px, centres at integers."""
    sigma: NDArray[np.float64]
    """(N,) scale in px: that of the Gaussian approximated by the filter."""
    response: Floats
    """(N,) determinant, grey levels squared."""


def octave_lobes(initial: int, octaves: int) -> Iterator[tuple[int, list[int]]]:
    """(growth, lobes) of each octave: 3, 5, 7, 9; 5, 9, 13, 17; 9, 17, ... for an initial lobe of
    3.
    """
    first, growth = initial, 2
    for _ in range(octaves):
        yield growth, [first + k * growth for k in range(_LAYERS)]
        first, growth = first + growth, 2 * growth


def blobs(
    grey: NDArray[np.uint8], *, octaves: int, lobe: int, step: int, threshold: float
) -> Blobs:
    """Blobs of an image (H, W). `lobe` and `step` in px are those of the first octave; both
    increase in later octaves.
    """
    integral = np.asarray(
        cv2.integral(grey, sdepth=cv2.CV_32S), np.int32
    )  # overflows beyond 8 Mpx; differences remain right
    found = []
    for k, (growth, lobes) in enumerate(octave_lobes(lobe, octaves)):
        if 3 * lobes[2] >= min(grey.shape):
            break
        stack = [determinants(integral, size, step << k) for size in lobes]
        found += [
            _maxima(stack[i - 1 : i + 2], lobes[i], growth, step << k, threshold) for i in (1, 2)
        ]
    xy, sigma, response = (
        (np.concatenate(parts) for parts in zip(*found, strict=True)) if found else _NONE
    )
    return Blobs(xy=xy, sigma=sigma, response=response)


_NONE = (np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.float32))


def determinants(integral: NDArray[np.int32], lobe: int, step: int) -> Floats:
    """Determinant at each step-th pixel, (ceil(H / step), ceil(W / step)); 0 where the filter does
    not fit.

    Each lobe is represented by its mean grey level, so that values do not depend on the filter's
    size.
    """
    height, width = integral.shape[0] - 1, integral.shape[1] - 1
    reach = (3 * lobe - 1) // 2
    out = np.zeros((-(-height // step), -(-width // step)), np.float32)
    first = -(-reach // step)
    rows, columns = (height - 1 - reach) // step + 1, (width - 1 - reach) // step + 1
    for top in range(first, rows, _ROWS):
        bottom = min(top + _ROWS, rows)
        if columns > first:
            at = _Boxes(integral, top * step, bottom - top, first * step, columns - first, step)
            out[top:bottom, first:columns] = _determinant(at, lobe)
    return out


class _Boxes:
    """Differences of an integral image around a grid of centres."""

    def __init__(
        self, integral: NDArray[Any], y: int, rows: int, x: int, columns: int, step: int
    ) -> None:
        self.integral, self.y, self.rows, self.x, self.columns, self.step = (
            integral,
            y,
            rows,
            x,
            columns,
            step,
        )

    def band(self, low: int, high: int, left: int, right: int) -> NDArray[np.int32]:
        """Sums of rows low..high - 1 off the centres, integrated along columns from `left` to
        `right` off them.
        """
        columns = slice(self.x + left, self.x + (self.columns - 1) * self.step + right + 1)
        return np.asarray(
            self.integral[self._rows(high), columns] - self.integral[self._rows(low), columns]
        )

    def pillar(self, left: int, right: int, low: int, high: int) -> NDArray[np.int32]:
        """The same with rows and columns exchanged."""
        rows = slice(self.y + low, self.y + (self.rows - 1) * self.step + high + 1)
        return np.asarray(
            self.integral[rows, self._columns(right)] - self.integral[rows, self._columns(left)]
        )

    def _rows(self, off: int) -> slice:
        return slice(self.y + off, self.y + off + (self.rows - 1) * self.step + 1, self.step)

    def _columns(self, off: int) -> slice:
        return slice(self.x + off, self.x + off + (self.columns - 1) * self.step + 1, self.step)

    def across(self, band: NDArray[Any], off: int) -> NDArray[np.int32]:
        """A band at columns `off` from its first."""
        return band[:, off : off + (self.columns - 1) * self.step + 1 : self.step]

    def along(self, pillar: NDArray[Any], off: int) -> NDArray[np.int32]:
        """A pillar at rows `off` from its first."""
        return pillar[off : off + (self.rows - 1) * self.step + 1 : self.step]


def _determinant(at: _Boxes, lobe: int) -> Floats:
    reach, half = (3 * lobe - 1) // 2, lobe - 1
    band = at.band(-half, lobe, -reach, reach + 1)
    pillar = at.pillar(-half, lobe, -reach, reach + 1)
    xx = _second(*(at.across(band, k * lobe) for k in range(4)))
    yy = _second(*(at.along(pillar, k * lobe) for k in range(4)))
    below, above = at.band(1, lobe + 1, -lobe, lobe + 1), at.band(-lobe, 0, -lobe, lobe + 1)
    mixed = below - above
    xy = at.across(mixed, 2 * lobe + 1) - at.across(mixed, lobe + 1)
    xy -= at.across(mixed, lobe)
    xy += at.across(mixed, 0)
    area = lobe * (2 * lobe - 1)
    product = xx.astype(np.float32)
    product *= yy.astype(np.float32)
    product *= np.float32(1 / area**2)
    cross = xy.astype(np.float32)
    cross *= np.float32(_CROSS / lobe**2)
    cross *= cross
    product -= cross
    return np.asarray(product)


def _second(
    a: NDArray[Any], b: NDArray[Any], c: NDArray[Any], d: NDArray[Any]
) -> NDArray[np.int32]:
    """Outer lobes minus twice the inner one, from running sums at their four edges: (d - a) - 3 (c
    - b).
    """
    inner = c - b
    inner *= -3
    inner += d
    inner -= a
    return np.asarray(inner)


def _maxima(
    stack: list[Floats], lobe: int, growth: int, step: int, threshold: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], Floats]:
    """(xy, sigma, response) of the maxima of a middle layer among 26 neighbours, with subpixel
    accuracy in position and scale.
    """
    kernel = np.ones((3, 3), np.uint8)
    middle = stack[1]
    summit = middle > threshold
    for layer in stack:
        summit &= middle >= cv2.dilate(layer, kernel)
    summit[[0, -1]] = False
    summit[:, [0, -1]] = False
    rows, columns = np.nonzero(summit)
    cube = np.stack(
        [
            layer[rows[:, None, None] + _AROUND[:, None], columns[:, None, None] + _AROUND]
            for layer in stack
        ],
        1,
    )
    off, inside = summits(cube)
    rows, columns, off = rows[inside], columns[inside], off[inside]
    xy = np.column_stack([columns + off[:, 2], rows + off[:, 1]]) * step
    sigma = 1.2 / 3 * (lobe + growth * off[:, 0])
    return xy, sigma, middle[rows, columns]


_AROUND = np.arange(-1, 2)


def summits(cube: Floats) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Maxima of quadratics through (N, 3, 3, 3) values (scale, y, x): offsets (N, 3) from the
    middle, and whether they are close enough to it (Brown and Lowe 2002).
    """
    c = cube.astype(np.float64)
    slope = (
        np.stack(
            [
                c[:, 2, 1, 1] - c[:, 0, 1, 1],
                c[:, 1, 2, 1] - c[:, 1, 0, 1],
                c[:, 1, 1, 2] - c[:, 1, 1, 0],
            ],
            1,
        )
        / 2
    )
    bend = np.empty((len(c), 3, 3))
    bend[:, 0, 0], bend[:, 1, 1], bend[:, 2, 2] = (
        c[:, 2, 1, 1] + c[:, 0, 1, 1] - 2 * c[:, 1, 1, 1],
        c[:, 1, 2, 1] + c[:, 1, 0, 1] - 2 * c[:, 1, 1, 1],
        c[:, 1, 1, 2] + c[:, 1, 1, 0] - 2 * c[:, 1, 1, 1],
    )
    bend[:, 0, 1] = bend[:, 1, 0] = (
        c[:, 2, 2, 1] - c[:, 2, 0, 1] - c[:, 0, 2, 1] + c[:, 0, 0, 1]
    ) / 4
    bend[:, 0, 2] = bend[:, 2, 0] = (
        c[:, 2, 1, 2] - c[:, 2, 1, 0] - c[:, 0, 1, 2] + c[:, 0, 1, 0]
    ) / 4
    bend[:, 1, 2] = bend[:, 2, 1] = (
        c[:, 1, 2, 2] - c[:, 1, 2, 0] - c[:, 1, 0, 2] + c[:, 1, 0, 0]
    ) / 4
    usable = np.abs(np.linalg.det(bend)) > 1e-12
    bend[~usable] = np.eye(3)
    off = np.linalg.solve(bend, -slope[..., None])[..., 0]
    return np.asarray(off, np.float64), np.asarray(usable & (np.abs(off) <= 0.75).all(1), np.bool_)
