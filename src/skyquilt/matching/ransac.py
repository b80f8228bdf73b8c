"""RANSAC with a fixed threshold (Fischler and Bolles 1981), scored as MSAC (Torr and Zisserman
2000).
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from skyquilt.geometry.transforms import Model
from skyquilt.matching.estimate import Estimate, NoEstimate
from skyquilt.matching.frame import estimated
from skyquilt.matching.search import search


@dataclass(frozen=True, kw_only=True)
class Ransac:
    """The model that most matches agree on; ties and near-ties go to the smaller errors."""

    model: Model = "homography"
    """What is estimated."""
    threshold_px: float = 3.0
    """Largest transfer error of an inlier: root mean square of both ways."""
    confidence: float = 0.99
    """That one sample was free of outliers, before the search ends."""
    max_iterations: int = 5000
    """Cap of the samples."""
    minimum: int = 8
    """Fewest inliers of an estimate."""
    seed: int = 0
    """Of the samples: equal seeds give equal results."""
    version: ClassVar[int] = 1

    def __call__(self, a: ArrayLike, b: ArrayLike) -> Estimate | NoEstimate:
        """b_H_a from matches a, b (N, 2) px, or why there is none."""
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
