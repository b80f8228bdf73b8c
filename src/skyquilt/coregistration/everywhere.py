"""Search without prior knowledge: all rotations, a range of scales, all shifts."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from skyquilt.coregistration.candidates import SUPPRESS, Candidate, middle, similarity
from skyquilt.coregistration.orientation import Orientation, turned

_COARSE = 4
"""Px per px of the coarse grid on which overlaps are computed."""
_QUARTERS = (
    np.array([[1, 0], [0, 1]]),
    np.array([[0, -1], [1, 0]]),
    np.array([[-1, 0], [0, -1]]),
    np.array([[0, 1], [-1, 0]]),
)
"""Turns by 0, 90, 180 and 270 degrees, x towards y."""
_BY_QUARTER = (-1, -1, 1, 1)
"""What a quarter of a turn multiplies each part of the fields by."""


@dataclass(frozen=True, kw_only=True)
class Everywhere:
    """Correlation of orientation fields by FFT over a grid of rotations and scales.

    The score is the sum of the correlation divided by the root of the overlap, so that scores by
    chance are equal for large and small overlaps. Scales are relative to equal areas: images with
    the same field of view have scale 1, whatever their sizes.
    """

    turns: float = 1.15
    """Rotations for each px along the side of the smaller image, since what matters is how far a
    step moves its rim: 92, in steps of 4 degrees, at 80 px.
    """
    step_scale: float = 1.0725
    """Factor between scales."""
    smallest: float = 0.7
    """Smallest scale from a to b, relative to equal areas."""
    largest: float = 1.45
    """Largest scale."""
    overlap: float = 0.4
    """Least overlap as a share of the smaller picture's valid area."""
    per_turn: int = 2
    """Number of peaks kept for each rotation and scale."""
    first_only: bool = False
    """Whether the first field (`Orientation.fields`) is correlated alone, which takes four fifths
    of the time.
    """
    version: ClassVar[int] = 3

    def __call__(self, a: Orientation, b: Orientation) -> list[Candidate]:
        """Candidates in px of the given resolution, unsorted."""
        plane = _Plane.of(a, b, parts=2 if self.first_only else 4)
        found: list[Candidate] = []
        for scale in self._scales(a, b):
            least = self.overlap * min(float(a.valid.sum()) * scale**2, float(b.valid.sum()))
            for angle in np.linspace(0, np.pi / 2, self._turns(a, b, scale), endpoint=False):
                field, overlap = plane.correlations(a, scale, float(angle))
                weight = np.where(overlap >= least, 1 / np.sqrt(np.maximum(overlap, 1)), 0)
                for quarter, score, x, y in highest(widened(weight, field), self.per_turn):
                    transform = similarity(
                        scale,
                        float(angle) + quarter * np.pi / 2,
                        middle(a.shape),
                        plane.place(x, y, quarter),
                    )
                    found.append(Candidate(b_H_a=transform, score=score))
        return found

    def _turns(self, a: Orientation, b: Orientation, scale: float) -> int:
        """Rotations within a quarter of a turn."""
        side = min(scale * float(np.sqrt(a.valid.size)), float(np.sqrt(b.valid.size)))
        return int(np.ceil(self.turns / 4 * side))

    def _scales(self, a: Orientation, b: Orientation) -> NDArray[np.float64]:
        same = np.sqrt(b.valid.size / a.valid.size)
        low, high, step = np.log([self.smallest, self.largest, self.step_scale])
        return np.asarray(same * np.exp(np.arange(low, high + 1e-9, step)))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Plane:
    """Square of `side` px for the correlation: a is rotated about its middle, b is placed in the
    corner.
    """

    side: int
    """A multiple of 2 * _COARSE."""
    b: NDArray[np.complex64]
    """(4, 4 or 2, side, side / 2 + 1) conjugate spectra of b's fields, turned back by each quarter
    about the origin.
    """
    b_valid: NDArray[np.complex64]
    """(4, coarse, coarse / 2 + 1) the same of b's validity, on the coarse grid."""
    b_middle: NDArray[np.float64]
    """(2,) middle of b in px."""

    @classmethod
    def of(cls, a: Orientation, b: Orientation, parts: int = 4) -> "_Plane":
        reach = max(b.shape) + 0.35 * np.hypot(*a.shape)
        unit = 2 * _COARSE
        side = unit * scipy.fft.next_fast_len(int(np.ceil(reach / unit)), real=True)
        return cls(
            side=side,
            b=_spectra(_quarters(np.moveaxis(b.fields[..., :parts], -1, 0), side, by=_BY_QUARTER)),
            b_valid=_spectra(
                _quarters(b.valid[None, ::_COARSE, ::_COARSE], side // _COARSE, by=(1,))
            )[:, 0],
            b_middle=middle(b.shape),
        )

    def correlations(
        self, a: Orientation, scale: float, angle: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Correlation (4, side, side), and overlap on the coarse grid, for `angle` and for one,
        two and three quarters of a turn more.

        A quarter of a turn of the plane moves pixels onto pixels, and turns orientations by 180 and
        360 degrees of their fields. So four angles share the transform of a: it is correlated with
        b turned back by each.
        """
        half = np.array([self.side / 2, self.side / 2])
        turn = similarity(scale, angle, middle(a.shape), half)[:2]
        moved = cv2.warpAffine(a.fields, turn, (self.side, self.side))  # of two parts it is slow
        moved = turned(moved[..., : self.b.shape[1]], angle)
        fields = scipy.fft.rfft2(np.ascontiguousarray(np.moveaxis(moved, -1, 0)))
        coarse = self.side // _COARSE
        valid = scipy.fft.rfft2(cv2.warpAffine(a.valid, turn / _COARSE, (coarse, coarse)))
        product = fields[0] * self.b[:, 0]
        for k in range(1, len(fields)):
            product += fields[k] * self.b[:, k]
        overlap = scipy.fft.irfft2(valid * self.b_valid, s=(coarse, coarse)) * _COARSE**2
        return scipy.fft.irfft2(product, s=(self.side, self.side)), overlap

    def place(self, x: int, y: int, quarter: int) -> NDArray[np.float64]:
        """Position of a's middle in b in px, for a peak of the correlation at (x, y)."""
        at = _QUARTERS[quarter] @ (self.side / 2 - np.array([x, y], np.float64))
        low = self.b_middle - self.side / 2
        return np.asarray((at - low) % self.side + low)


def _quarters(fields: NDArray[Any], side: int, by: tuple[int, ...]) -> NDArray[np.float32]:
    """(4, c, side, side) fields (c, h, w) in the corner of a plane that wraps around, turned back
    about the origin by each quarter; each quarter multiplies field c by `by[c]`.
    """
    plane = np.zeros((len(fields), side, side), np.float32)
    plane[:, : fields.shape[1], : fields.shape[2]] = fields
    y, x = np.mgrid[:side, :side]
    signs = np.array(by, np.float32)[:, None, None]
    return np.stack(
        [
            signs[: len(fields)] ** k
            * plane[:, (q[1, 0] * x + q[1, 1] * y) % side, (q[0, 0] * x + q[0, 1] * y) % side]
            for k, q in enumerate(_QUARTERS)
        ]
    )


def _spectra(fields: NDArray[np.float32]) -> NDArray[np.complex64]:
    """Conjugate spectra (..., h, w / 2 + 1) of real fields (..., h, w)."""
    return np.asarray(np.conj(scipy.fft.rfft2(fields)))


def widened(weight: NDArray[np.float32], field: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fields (n, h, w) times weights on the coarse grid."""
    count, height, width = weight.shape
    parts = field.reshape(count, height, _COARSE, width, _COARSE)
    return (parts * weight[:, :, None, :, None]).reshape(field.shape)


def highest(z: NDArray[np.float32], most: int) -> Iterator[tuple[int, float, int, int]]:
    """Field, score, x and y of the highest peaks of each of several fields (n, h, w) that wrap
    around, if above 0; the fields are modified.
    """
    count, height, width = z.shape
    near = np.arange(-SUPPRESS, SUPPRESS + 1)
    number = np.arange(count)
    for _ in range(most):
        y, x = np.divmod(z.reshape(count, -1).argmax(1), width)
        for k, score in enumerate(z[number, y, x].tolist()):
            if score > 0:
                yield k, score, int(x[k]), int(y[k])
        z[
            number[:, None, None],
            (y[:, None] + near)[:, :, None] % height,
            (x[:, None] + near)[:, None, :] % width,
        ] = -1
