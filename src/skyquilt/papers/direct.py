"""Direct registration of two images by normalised cross-correlation over an image pyramid, without
features.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.grey import to_grey8
from skyquilt.model.estimate import NoEstimate, Registration
from skyquilt.papers.climb import at_level, climb, levels, motion, reduced
from skyquilt.papers.picture_similarity import ncc, ncc_of_shifts, summit, warped

Doubles = NDArray[np.float64]

_COARSE = 128
"""Longer side in px of the images for the exhaustive search."""


class Direct(Protocol):
    """Interface of direct registration: `Ncc`, `PhaseCorrelation`, `Ecc`, `MutualInformation`.
    `start`: (3, 3) b_H_a or None.
    """

    def __call__(
        self, a: NDArray[Any], b: NDArray[Any], start: Doubles | None = None
    ) -> Registration | NoEstimate:
        """b_H_a with its score, or the reason why there is none."""
        ...


@dataclass(frozen=True, kw_only=True)
class Ncc:
    """Searches all shifts (and the requested rotations and scales) in small images, then refines
    the best in larger ones.
    """

    turn: float = 0.0
    """Largest rotation tried, in degrees in both directions from the start; 0 searches for a
    translation, unless `zoom` is given.
    """
    zoom: float = 1.0
    """Largest scale factor tried, in both directions."""
    minimum: float = 0.3
    """Least accepted correlation."""
    clear: float = 0.95
    """Largest correlation of a second place, as a share of that of the best (at the coarsest
    level).
    """
    overlap: float = 0.2
    """Least share of a's pixels that overlap b."""
    version: ClassVar[int] = 1

    def __call__(
        self, a: NDArray[Any], b: NDArray[Any], start: Doubles | None = None
    ) -> Registration | NoEstimate:
        """b_H_a of two images (H, W[, C]), with shifts of any size from `start`; or the reason why
        there is none.
        """
        a, b = to_grey8(a), to_grey8(b)
        first = np.eye(3) if start is None else start
        factors = levels((*a.shape, *b.shape), coarsest=_COARSE)
        found = self._everything(
            reduced(a, factors[0]), reduced(b, factors[0]), at_level(first, factors[0])
        )
        if isinstance(found, NoEstimate):
            return found
        similarity = self.turn > 0 or self.zoom > 1
        H, score, share = climb(
            ncc,
            a,
            b,
            at_level(found, 1 / factors[0]),
            similarity=similarity,
            overlap=self.overlap,
            factors=factors,
        )
        if score < self.minimum:
            return NoEstimate(reason=f"weak peak ({score:.2f} of {self.minimum:g})")
        model = "similarity" if similarity else "translation"
        return Registration(model=model, b_H_a=H, score=score, overlap=share, method="NCC")

    def _everything(self, a: NDArray[Any], b: NDArray[Any], start: Doubles) -> Doubles | NoEstimate:
        """The best of all shifts, rotations and scales of small images, close enough for local
        maximisation.
        """
        best: tuple[float, float, Doubles] = (-1.0, -1.0, start)
        size = (int(2 * max(b.shape)),) * 2
        middle = np.array(
            [[1, 0, (b.shape[1] - size[1]) / 2], [0, 1, (b.shape[0] - size[0]) / 2], [0, 0, 1.0]]
        )
        centre = np.array([(a.shape[1] - 1) / 2, (a.shape[0] - 1) / 2, 1.0])
        for angle, scale in self._tried(max(a.shape)):
            H = start @ motion(np.array([0, 0, np.radians(angle), np.log(scale)]), a.shape)
            H[:2, 2] += np.array([(b.shape[1] - 1) / 2, (b.shape[0] - 1) / 2]) - (H @ centre)[:2]
            # a rotated to b's orientation on a canvas around b
            turned, inside = warped(a, np.linalg.inv(H) @ middle, size)
            field, zero = ncc_of_shifts(turned, b, inside, overlap=self.overlap)
            row, column, value, second = summit(field)
            if value > best[0]:
                shift = np.array([[1, 0, column - zero[1]], [0, 1, row - zero[0]], [0, 0, 1.0]])
                best = (value, second, shift @ np.linalg.inv(middle) @ H)
        if best[0] < self.minimum:
            return NoEstimate(reason=f"weak peak ({best[0]:.2f} of {self.minimum:g})")
        if best[1] > self.clear * best[0]:
            return NoEstimate(
                reason=f"ambiguous (correlations of {best[0]:.2f} and {best[1]:.2f} apart)"
            )
        return best[2]

    def _tried(self, longest: int) -> list[tuple[float, float]]:
        """(degrees, scale) in steps at which a corner moves by at most 3 px."""
        step = 6 / longest
        turns = int(np.ceil(np.radians(self.turn) / step))
        zooms = int(np.ceil(np.log(self.zoom) / step)) if self.zoom > 1 else 0
        angles = np.linspace(-self.turn, self.turn, 2 * turns + 1)
        scales = self.zoom ** np.linspace(-1, 1, 2 * zooms + 1) if zooms else np.ones(1)
        return [(float(angle), float(scale)) for scale in scales for angle in angles]


def by_ncc(model: str) -> Ncc:
    """Cross-correlation for photos of any heading: a `translation`, or a `similarity`."""
    return Ncc() if model == "translation" else Ncc(turn=180.0)
