"""RANSAC with a fixed threshold (Fischler and Bolles 1981), scored as MSAC (Torr and Zisserman
2000).
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from skyquilt.geometry.transforms import Model
from skyquilt.matching.estimate import Estimate, NoEstimate, estimated, search


@dataclass(frozen=True, kw_only=True)
class Ransac:
    """The model with the lowest MSAC cost: the number of inliers decides, then their errors."""

    model: Model = "homography"
    """Type of the transformation."""
    threshold_px: float = 3.0
    """Largest transfer error of an inlier in px: root mean square of both directions."""
    confidence: float = 0.99
    """Probability that at least one sample was free of outliers; the search ends when it is
    reached.
    """
    max_iterations: int = 5000
    """Largest number of samples."""
    minimum: int = 8
    """Fewest inliers of an estimate."""
    seed: int = 0
    """Seed of the samples; equal seeds give equal results."""
    version: ClassVar[int] = 1

    def __call__(self, a: ArrayLike, b: ArrayLike) -> Estimate | NoEstimate:
        """b_H_a from matches a, b (N, 2) px, or the reason why there is none."""
        limit = 2 * self.threshold_px**2
        return estimated(
            "RANSAC",
            self.model,
            a,
            b,
            minimum=self.minimum,
            finalise=lambda H, a, b: (H, limit),
            find=lambda a, b: search(
                self.model,
                a,
                b,
                confidence=self.confidence,
                cap=self.max_iterations,
                seed=self.seed,
                cost=lambda e: np.minimum(e, limit).sum(1),
                support=lambda e: int((e < limit).sum()),
            ),
        )
