"""Direct registration from a start: phase correlation, ECC, mutual information. The interface is
that of `direct.Ncc`.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.transforms import transfer
from skyquilt.imaging.grey import to_grey8
from skyquilt.model.estimate import NoEstimate, Registration
from skyquilt.papers.direct import Direct, at_level, by_ncc, climb, levels, motion, reduced
from skyquilt.papers.picture_similarity import (
    mutual_information,
    ncc,
    phase_shift,
    rotation_and_scale,
    warped,
)

Doubles = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PhaseCorrelation:
    """Shift, and optionally rotation and scale, from the phases of the spectra. No start is
    needed.
    """

    similarity: bool = False
    """Whether rotation and scale are estimated too, from log-polar spectra."""
    minimum: float = 0.3
    """Least accepted correlation of the registered images."""
    overlap: float = 0.2
    """Least share of a's pixels that overlap b."""
    version: ClassVar[int] = 1

    def __call__(
        self, a: NDArray[Any], b: NDArray[Any], start: Doubles | None = None
    ) -> Registration | NoEstimate:
        """b_H_a of two pictures (H, W[, C]); `start` is applied first; the remaining shift may be
        up to half of the image.
        """
        a, b = to_grey8(a), to_grey8(b)
        first = np.eye(3) if start is None else start
        turns: list[tuple[float, float]] = [(0.0, 1.0)]
        if self.similarity:
            degrees, scale, _ = rotation_and_scale(a, warped(b, first, a.shape)[0])
            turns = [(degrees, scale), (degrees + 180, scale)]
        moves = [motion(np.array([0, 0, np.radians(t), np.log(s)]), a.shape) for t, s in turns]
        tried = [self._shifted(a, b, first @ move) for move in moves]
        H, response, score, share = max(tried, key=lambda result: result[2])
        if share < self.overlap:
            return NoEstimate(reason=f"too little overlap ({share:.2f} of {self.overlap:g})")
        if score < self.minimum:
            return NoEstimate(reason=f"weak peak (correlation {score:.2f} of {self.minimum:g})")
        model = "similarity" if self.similarity else "translation"
        return Registration(model=model, b_H_a=H, score=response, overlap=share, method="phase")

    def _shifted(
        self, a: NDArray[Any], b: NDArray[Any], H: Doubles
    ) -> tuple[Doubles, float, float, float]:
        """(b_H_a, response, correlation, overlap) after two rounds: the second uses the overlap
        found by the first.
        """
        response = 0.0
        for _ in range(2):
            dx, dy, response = phase_shift(a, warped(b, H, a.shape)[0])
            H = H @ np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]])
        H = H / H[2, 2]
        seen, inside = warped(b, H, a.shape)
        return H, response, ncc(a, seen, inside), float(inside.mean())


@dataclass(frozen=True, kw_only=True)
class Ecc:
    """The enhanced correlation coefficient (Evangelidis and Psarakis 2008), OpenCV's, over a
    pyramid, from a start.
    """

    model: Literal["translation", "euclidean", "affine", "homography"] = "homography"
    """Type of the transformation; OpenCV has no similarity."""
    minimum: float = 0.3
    """Least correlation that is trusted."""
    coarsest: int = 256
    """Longer side in px at which it begins; the start must be right to a few px there."""
    reach: float = 0.2
    """Largest shift of a corner from the start, as a share of the diagonal; beyond it the search
    has diverged.
    """
    iterations: int = 60
    """Largest number of iterations per level."""
    version: ClassVar[int] = 1

    def __call__(
        self, a: NDArray[Any], b: NDArray[Any], start: Doubles | None = None
    ) -> Registration | NoEstimate:
        """b_H_a of two pictures (H, W[, C]) near `start`, or why there is none."""
        a, b = to_grey8(a), to_grey8(b)
        first = np.eye(3) if start is None else np.asarray(start, np.float64)
        H, score = first, 0.0
        for factor in levels((*a.shape, *b.shape), coarsest=self.coarsest):
            small = at_level(H, factor)
            try:
                score, small = self._level(
                    reduced(a, factor), reduced(b, factor), small / small[2, 2]
                )
            except cv2.error:  # no common pixel, or no convergence
                return NoEstimate(reason="the iteration does not converge")
            H = at_level(small, 1 / factor)
            H = H / H[2, 2]
        if not score >= self.minimum:
            return NoEstimate(reason=f"weak peak ({score:.2f} of {self.minimum:g})")
        if not self._near(H, first, a.shape):
            return NoEstimate(
                reason=f"moved by more than {self.reach:g} of the diagonal from the start"
            )
        share = float(warped(b, H, a.shape)[1].mean())
        return Registration(model=self.model, b_H_a=H, score=score, overlap=share, method="ECC")

    def _near(self, H: Doubles, start: Doubles, shape: tuple[int, ...]) -> bool:
        corners = np.array([[0, 0], [shape[1], 0], [0, shape[0]], [shape[1], shape[0]]], np.float64)
        moved = np.linalg.norm(transfer(H, corners) - transfer(start, corners), axis=1)
        diagonal = np.linalg.norm(np.diff(transfer(start, corners[[0, 3]]), axis=0))
        return bool(moved.max() <= self.reach * diagonal)

    def _level(self, a: NDArray[Any], b: NDArray[Any], H: Doubles) -> tuple[float, Doubles]:
        kind = getattr(cv2, f"MOTION_{self.model.upper()}")
        rows = 3 if self.model == "homography" else 2
        stop: Any = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, self.iterations, 1e-6)
        matrix = np.ascontiguousarray(H[:rows], np.float32)
        search: Any = cv2.findTransformECC  # OpenCV's type hints lack the call without a mask
        score, found = search(a, b, matrix, kind, stop, None, 5)
        return float(score), np.vstack([np.asarray(found, np.float64), [[0, 0, 1]]])[:3]


@dataclass(frozen=True, kw_only=True)
class MutualInformation:
    """Refinement by mutual information, for images whose grey values are not linearly related, such
    as different spectral bands.
    """

    similarity: bool = True
    """Whether rotation and scale are estimated too, besides a translation."""
    bins: int = 32
    """Number of histogram bins of each image's grey values."""
    minimum: float = 0.05
    """Least accepted normalised mutual information."""
    overlap: float = 0.2
    """Least share of a's pixels that overlap b."""
    coarsest: int = 160
    """Longer side in px at which it begins; the start must be right to a few px there."""
    finest: int = 1
    """Reduction at which it ends."""
    version: ClassVar[int] = 1

    def __call__(
        self, a: NDArray[Any], b: NDArray[Any], start: Doubles | None = None
    ) -> Registration | NoEstimate:
        """b_H_a of two pictures (H, W[, C]) near `start`, or why there is none."""
        a, b = to_grey8(a), to_grey8(b)
        first = np.eye(3) if start is None else start
        factors = levels((*a.shape, *b.shape), coarsest=self.coarsest, finest=self.finest)
        H, score, share = climb(
            lambda x, y, m: mutual_information(x, y, m, bins=self.bins),
            a,
            b,
            first,
            similarity=self.similarity,
            overlap=self.overlap,
            factors=factors,
        )
        if score < self.minimum:
            return NoEstimate(reason=f"weak peak ({score:.3f} of {self.minimum:g})")
        model = "similarity" if self.similarity else "translation"
        return Registration(model=model, b_H_a=H, score=score, overlap=share, method="MI")


@dataclass(frozen=True, kw_only=True)
class Started:
    """A refinement that starts from the result of another registration."""

    start: Direct
    """Finds the approximate transform."""
    refine: Direct
    """Refines it."""
    version: ClassVar[int] = 1

    def __call__(
        self, a: NDArray[Any], b: NDArray[Any], start: Doubles | None = None
    ) -> Registration | NoEstimate:
        """b_H_a of two pictures (H, W[, C]), or why there is none."""
        rough = self.start(a, b, start)
        return rough if isinstance(rough, NoEstimate) else self.refine(a, b, rough.b_H_a)


def by_phase(model: str) -> PhaseCorrelation:
    """Phase correlation: a `translation`, or a `similarity`."""
    return PhaseCorrelation(similarity=model == "similarity")


def by_ecc(model: Literal["translation", "affine", "homography"]) -> Started:
    """ECC from the result of cross-correlation."""
    return Started(start=by_ncc("similarity"), refine=Ecc(model=model))


def by_mutual_information(model: str) -> Started:
    """Mutual information from the result of cross-correlation."""
    similarity = model == "similarity"
    return Started(start=by_ncc(model), refine=MutualInformation(similarity=similarity))
