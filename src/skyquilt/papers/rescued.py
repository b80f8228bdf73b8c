"""An estimator and a second one for where the first one's result is no registration at all."""

from dataclasses import dataclass
from typing import ClassVar

from numpy.typing import ArrayLike

from skyquilt.matching.estimate import Estimate, Estimator, NoEstimate


@dataclass(frozen=True, kw_only=True)
class Rescued:
    """The first estimate where it is one; where its error per inlier is beyond any registration's,
    the second.

    A's threshold grows with the outliers (A 9). Where more than a few of the matches are wrong, in
    forest say, nearly all become inliers of a model that fits none, at 10^5 px^2 an inlier. That
    much is no accuracy worth keeping.
    """

    first: Estimator
    """As published."""
    second: Estimator
    """What helps out."""
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
