"""Search without prior knowledge: all rotations, a range of scales, all shifts."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from skyquilt.coregistration.candidates import Candidate, middle, peaks, similarity
from skyquilt.coregistration.orientation import Orientation, spectra, turned

_COARSE = 4
"""Px per px of the coarse grid on which overlaps are computed."""


@dataclass(frozen=True, kw_only=True)
class Everywhere:
    """Correlation of orientation fields by FFT over a grid of rotations and scales.

    The score is the sum of the correlation divided by the root of the overlap, so that scores by
    chance are equal for large and small overlaps. Scales are relative to equal areas: images with
    the same field of view have scale 1, whatever their sizes.
    """

    step_deg: float = 4.0
    """Step between rotations in degrees."""
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
    version: ClassVar[int] = 1

    def __call__(self, a: Orientation, b: Orientation) -> list[Candidate]:
        """Candidates in px of the given resolution, unsorted."""
        plane = _Plane.of(a, b)
        found: list[Candidate] = []
        for scale in self._scales(a, b):
            for angle in np.radians(np.arange(0, 180, self.step_deg)):
                least = self.overlap * min(float(a.valid.sum()) * scale**2, float(b.valid.sum()))
                for turn, field, overlap in plane.correlations(a, scale, float(angle)):
                    z = np.where(overlap >= least, field / np.sqrt(np.maximum(overlap, 1)), -1)
                    for score, x, y in peaks(z, self.per_turn):
                        place = plane.place(x, y, flipped=turn > angle)
                        transform = similarity(scale, turn, middle(a.shape), place)
                        found.append(Candidate(b_H_a=transform, score=score))
        return found

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
    b: tuple[NDArray[np.complex64], NDArray[np.complex64]]
    """Conjugate spectra (2, side, side) of b, and of b rotated by 180 degrees about the origin."""
    b_valid: tuple[NDArray[np.complex64], NDArray[np.complex64]]
    """The same of b's validity, on the coarse grid."""
    b_middle: NDArray[np.float64]
    """(2,) middle of b in px."""

    @classmethod
    def of(cls, a: Orientation, b: Orientation) -> "_Plane":
        reach = max(b.shape) + 0.35 * np.hypot(*a.shape)
        unit = 2 * _COARSE
        side = unit * scipy.fft.next_fast_len(int(np.ceil(reach / unit)))
        fields = np.conj(spectra(b.fields, (side, side)))
        coarse = side // _COARSE
        valid = np.conj(scipy.fft.fft2(b.valid[::_COARSE, ::_COARSE], s=(coarse, coarse)))
        return cls(
            side=side,
            b=(fields, _reversed(fields)),
            b_valid=(valid, _reversed(valid)),
            b_middle=middle(b.shape),
        )

    def correlations(
        self, a: Orientation, scale: float, angle: float
    ) -> Iterator[tuple[float, NDArray[np.float32], NDArray[np.float32]]]:
        """Angle, correlation and overlap (side, side) for `angle` and for `angle` + 180 degrees.

        A rotation by 180 degrees leaves orientations unchanged and mirrors positions. So both
        angles share the transform of a: for the second angle it is correlated with the rotated b.
        """
        half = np.array([self.side / 2, self.side / 2])
        turn = similarity(scale, angle, middle(a.shape), half)[:2]
        fields = spectra(
            turned(cv2.warpAffine(a.fields, turn, (self.side, self.side)), angle), (self.side,) * 2
        )
        coarse = self.side // _COARSE
        valid = scipy.fft.fft2(cv2.warpAffine(a.valid, turn / _COARSE, (coarse, coarse)))
        for extra, b, b_valid in zip((0.0, np.pi), self.b, self.b_valid, strict=True):
            overlap = scipy.fft.ifft2(valid * b_valid).real * _COARSE**2
            field = scipy.fft.ifft2((fields * b).sum(0)).real
            yield angle + extra, field, overlap.repeat(_COARSE, 0).repeat(_COARSE, 1)

    def place(self, x: int, y: int, *, flipped: bool) -> NDArray[np.float64]:
        """Position of a's middle in b in px, for a peak of the correlation at (x, y)."""
        shift = np.array([x, y], np.float64)
        at = self.side / 2 + shift if flipped else self.side / 2 - shift
        low = self.b_middle - self.side / 2
        return np.asarray((at - low) % self.side + low)


def _reversed(spectrum: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """The spectrum of the same image rotated by 180 degrees about pixel (0, 0)."""
    return np.roll(spectrum[..., ::-1, ::-1], 1, (-2, -1)).copy()
