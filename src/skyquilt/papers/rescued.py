"""An estimator with a second one that is used if the first one fails completely."""

from dataclasses import dataclass
from typing import ClassVar

from numpy.typing import ArrayLike

from skyquilt.matching.estimate import Estimate, Estimator, NoEstimate


@dataclass(frozen=True, kw_only=True)
class Rescued:
    """The first estimate; if its error per inlier is too large for any registration, the second.

    A's threshold increases with the outliers (A 9). If more than a few matches are wrong, for
    example in forest, nearly all become inliers of a wrong model, with errors of 10^5 px^2 per
    inlier. Such a result is useless.
    """

    first: Estimator
    """The estimator as published."""
    second: Estimator
    """The estimator used if the first fails."""
    hopeless_px2: float = 5.0
    """STE per inlier above which the first one failed."""
    version: ClassVar[int] = 1

    def __call__(self, a: ArrayLike, b: ArrayLike) -> Estimate | NoEstimate:
        """b_H_a from matches a, b (N, 2) px, or why there is none."""
        found = self.first(a, b)
        if isinstance(found, Estimate) and found.ste_per_inlier <= self.hopeless_px2:
            return found
        other = self.second(a, b)
        return (
            other
            if isinstance(other, Estimate)
            else found
            if isinstance(found, NoEstimate)
            else other
        )
