"""Candidate transforms between two images, best first: over all shifts, or near a guess."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from skyquilt.coregistration.orientation import Orientation, between, spectra, turned
from skyquilt.model.registration import Guess, Matrix

SUPPRESS = 4
"""Radius in px around a peak in which no other peak is searched."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A transform and its score."""

    b_H_a: Matrix
    """(3, 3) in px of the resolution in which it was found."""
    score: float
    """Higher is better; comparable only among candidates of one search."""


def distinct(
    candidates: Sequence[Candidate], shape: tuple[int, int], apart: float, most: int
) -> list[Candidate]:
    """The best candidates that differ from each other: any two move a's corners to positions at
    least `apart` px (RMS) apart.

    `shape` is a's height and width; candidates need not be in order.
    """
    order = sorted(candidates, key=lambda c: -c.score)
    kept: list[Candidate] = []
    places = np.zeros((0, 4, 2))
    for candidate in order:
        place = corners(candidate.b_H_a, shape)
        if (((places - place) ** 2).sum(2).mean(1) <= apart**2).any():
            continue
        kept.append(candidate)
        places = np.concatenate([places, place[None]])
        if len(kept) == most:
            break
    return kept


def corners(b_H_a: Matrix, shape: tuple[int, int]) -> np.ndarray:
    """The transformed corners of an image of `shape`: (4, 2) in px of b."""
    height, width = shape
    ends = np.array(
        [[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1.0]]
    )
    moved = ends @ b_H_a.T
    return np.asarray(moved[:, :2] / moved[:, 2:])


def similarity(scale: float, angle: float, from_px: np.ndarray, to_px: np.ndarray) -> Matrix:
    """Similarity with a scale and rotation (radians, x towards y) that maps one point to
    another.
    """
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    shift = np.asarray(to_px) - turn @ np.asarray(from_px)
    return np.array([[c, -s, shift[0]], [s, c, shift[1]], [0, 0, 1.0]])


def middle(shape: tuple[int, int]) -> np.ndarray:
    """The middle pixel (2,): x, y."""
    return np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])


def peaks(z: NDArray[np.float32], most: int) -> Iterator[tuple[float, int, int]]:
    """The highest peaks (score, x, y) of a field that wraps around; the field is modified."""
    height, width = z.shape
    near = np.arange(-SUPPRESS, SUPPRESS + 1)
    for _ in range(most):
        y, x = divmod(int(z.argmax()), width)
        if z[y, x] <= 0:
            return
        yield float(z[y, x]), x, y
        z[np.ix_((y + near) % height, (x + near) % width)] = -1


def same_view(a: tuple[int, int], b: tuple[int, int]) -> Guess:
    """The guess for two cameras side by side: equal fields of view, for images of shapes (H, W)."""
    scale = float(np.sqrt(b[0] * b[1] / (a[0] * a[1])))
    return Guess(b_H_a=similarity(scale, 0.0, middle(a), middle(b)), source="equal fields of view")


@dataclass(frozen=True, kw_only=True)
class Nearby:
    """Correlation of orientation fields over small rotations, scales and shifts from a guess."""

    step_deg: float = 2.0
    """Step between rotations in degrees."""
    step_scale: float = 1.0355
    """Factor between scales."""
    per_turn: int = 2
    """Number of peaks kept for each rotation and scale."""
    version: ClassVar[int] = 1

    def __call__(self, a: Orientation, b: Orientation, guess: Guess) -> list[Candidate]:
        """Candidates in px of the given resolution, unsorted."""
        reach = max(1, round(guess.reach * max(b.shape)))
        shape = tuple(scipy.fft.next_fast_len(side + 2 * reach) for side in b.shape)
        conjugate = np.conj(spectra(b.fields, (shape[0], shape[1])))
        first = between(a, b, guess.b_H_a)
        found: list[Candidate] = []
        for step in self._steps(guess, b.shape):
            start = step @ first
            found += self._shifts(a, b, start, conjugate, reach)
        return found

    def _steps(self, guess: Guess, shape: tuple[int, int]) -> list[Matrix]:
        """Small rotations and scalings about b's middle."""
        turns = int(guess.rotation_deg / self.step_deg)
        factors = int(np.log(guess.scale) / np.log(self.step_scale))
        return [
            similarity(
                self.step_scale**k, np.radians(t * self.step_deg), middle(shape), middle(shape)
            )
            for k in range(-factors, factors + 1)
            for t in range(-turns, turns + 1)
        ]

    def _shifts(
        self, a: Orientation, b: Orientation, start: Matrix, conjugate: np.ndarray, reach: int
    ) -> list[Candidate]:
        """The best shifts of one transform."""
        moved = start.copy()
        moved = np.array([[1, 0, reach], [0, 1, reach], [0, 0, 1.0]]) @ moved
        height, width = conjugate.shape[1:]
        angle = float(np.arctan2(start[1, 0] - start[0, 1], start[0, 0] + start[1, 1]))
        fields = turned(cv2.warpPerspective(a.fields, moved, (width, height)), angle)
        field = scipy.fft.ifft2((spectra(fields, (height, width)) * conjugate).sum(0)).real
        valid = cv2.warpPerspective(a.valid, start, (b.shape[1], b.shape[0]))
        z = field[: 2 * reach + 1, : 2 * reach + 1] / np.sqrt(
            max(float((valid * b.valid).sum()), 1.0)
        )
        return [
            Candidate(
                b_H_a=np.array([[1, 0, reach - x], [0, 1, reach - y], [0, 0, 1.0]]) @ start,
                score=score,
            )
            for score, x, y in peaks(z.copy(), self.per_turn)
        ]
