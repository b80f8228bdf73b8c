"""Search about what is known beforehand: fewer places, so fainter likeness suffices."""

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
import scipy.fft

from skyquilt.model.registration import Guess, Matrix
from skyquilt.spectral.candidates import Candidate, middle, peaks, similarity
from skyquilt.spectral.orientation import Orientation, between, spectra, turned


def same_view(a: tuple[int, int], b: tuple[int, int]) -> Guess:
    """The guess for two cameras side by side: equal fields of view, of pictures of shapes (H,
    W).
    """
    scale = float(np.sqrt(b[0] * b[1] / (a[0] * a[1])))
    return Guess(b_H_a=similarity(scale, 0.0, middle(a), middle(b)), source="equal fields of view")


@dataclass(frozen=True, kw_only=True)
class Nearby:
    """Correlation of orientation fields over small rotations, scales and shifts from a guess."""

    step_deg: float = 2.0
    """Between rotations."""
    step_scale: float = 1.0355
    """Factor between scales."""
    per_turn: int = 2
    """Peaks kept of each rotation and scale."""
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
        """Small turns and scalings about b's middle."""
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
