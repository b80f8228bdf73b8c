"""RANSAC with a fixed threshold (Fischler and Bolles 1981), scored as MSAC (Torr and Zisserman 2000)."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from skyquilt.geometry.transforms import Model, symmetric_transfer_errors
from skyquilt.twoview.estimate import Estimate, NoEstimate, matched, polished, too_few, weak
from skyquilt.twoview.search import search


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
        a, b = matched(a, b)
        if (few := too_few(self.model, len(a), self.minimum)) is not None:
            return few
        limit = 2 * self.threshold_px**2
        found = search(
            self.model, a, b, confidence=self.confidence, cap=self.max_iterations, seed=self.seed,
            cost=lambda e: np.minimum(e, limit).sum(1), support=lambda e: int((e < limit).sum()),
        )  # fmt: skip
        if found is None:
            return NoEstimate(reason=f"no {self.model} passes through the matches")
        H, inliers = polished(self.model, found.b_H_a, a, b, limit)
        if (feeble := weak(self.model, int(inliers.sum()), len(a), self.minimum)) is not None:
            return feeble
        return Estimate(
            model=self.model, b_H_a=H, inliers=inliers, iterations=found.iterations, capped=found.capped,
            ste_per_inlier=float(symmetric_transfer_errors(H, a[inliers], b[inliers]).mean()), method="RANSAC",
        )  # fmt: skip
