"""Least median of squares (Rousseeuw 1984). It needs no threshold, but more than half of the
matches must be right.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from skyquilt.geometry.transforms import MINIMAL, Model, symmetric_transfer_errors
from skyquilt.matching.estimate import Doubles, Estimate, NoEstimate, estimated, search

_MEDIAN = 2 * np.log(2)
"""Median of a chi-square of two degrees of freedom: a transfer error in x and y, divided by its
variance.
"""
_FAR = 9.21
"""99 % quantile of the same distribution."""


@dataclass(frozen=True, kw_only=True)
class Lmeds:
    """The model with the least median symmetric transfer error; inliers are selected by the
    standard deviation estimated from the median.
    """

    model: Model = "homography"
    """Type of the transformation."""
    confidence: float = 0.9999
    """Probability that a sample is free of outliers if half of the matches are outliers; determines
    the number of samples.
    """
    max_iterations: int = 5000
    """Largest number of samples."""
    max_sigma_px: float = 10.0
    """Largest accepted standard deviation of the inliers per axis; it is larger if more than half
    of the matches are outliers.
    """
    minimum: int = 8
    """Fewest inliers of an estimate."""
    seed: int = 0
    """Seed of the samples; equal seeds give equal results."""
    version: ClassVar[int] = 1

    def __call__(self, a: ArrayLike, b: ArrayLike) -> Estimate | NoEstimate:
        """b_H_a from matches a, b (N, 2) px, or why there is none."""
        return estimated(
            "LMedS",
            self.model,
            a,
            b,
            minimum=self.minimum,
            finalise=self._limit,
            find=lambda a, b: search(
                self.model,
                a,
                b,
                confidence=self.confidence,
                cap=self.max_iterations,
                seed=self.seed,
                cost=lambda e: np.median(e, 1),
                support=lambda e: len(e) // 2,
            ),
        )

    def _limit(self, H: Doubles, a: Doubles, b: Doubles) -> tuple[Doubles, float] | NoEstimate:
        variance = self._variance(float(np.median(symmetric_transfer_errors(H, a, b))), len(a))
        if not variance <= self.max_sigma_px**2:
            scatter = f"{np.sqrt(variance):.1f} px, above {self.max_sigma_px:g} px"
            return NoEstimate(
                reason=f"the matches scatter by {scatter}: half of them or more are wrong"
            )
        return H, 2 * _FAR * variance

    def _variance(self, median: float, count: int) -> float:
        """Variance of the inliers' transfer errors per axis in px^2. Half of the STE is the squared
        error of one direction; the factor 1 + 5 / (n - p) corrects for few matches (Rousseeuw and
        Leroy 1987, 5.1).
        """
        small = 1 + 5 / max(count - MINIMAL[self.model], 1)
        return float(max(median / 2 / _MEDIAN * small**2, 1e-6))
