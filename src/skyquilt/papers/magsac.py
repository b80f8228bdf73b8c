"""MAGSAC++ (Barath et al. 2020), by OpenCV: the threshold is marginalised over all noise levels up
to a maximum.
"""

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyquilt.geometry.transforms import Model, fit
from skyquilt.matching.estimate import Estimate, Found, NoEstimate, estimated

Doubles = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Magsac:
    """The estimator for general use. OpenCV estimates homographies and affine transformations in
    this way. A similarity or translation is fitted to the inliers of an affine transformation, so
    the matches must not lie on one line.
    """

    model: Model = "homography"
    """Type of the transformation."""
    threshold_px: float = 3.0
    """Transfer error beyond which a match is an outlier at the largest noise level: root mean
    square of both directions, in px.
    """
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
    version: ClassVar[int] = 2

    def __call__(self, a: ArrayLike, b: ArrayLike) -> Estimate | NoEstimate:
        """b_H_a from matches a, b (N, 2) px, or why there is none."""
        limit = 2 * self.threshold_px**2
        return estimated(
            "MAGSAC",
            self.model,
            a,
            b,
            minimum=self.minimum,
            find=self._find,
            finalise=lambda H, a, b: (H, limit),
        )

    def _find(self, a: Doubles, b: Doubles) -> Found | None:
        """OpenCV does not report the number of samples: the limit is returned instead, and never
        reported as reached.
        """
        try:
            H = self._homography(a, b) if self.model == "homography" else self._linear(a, b)
        except cv2.error:  # fewer distinct points than one sample needs
            return None
        if H is None or not np.isfinite(H).all():
            return None
        return Found(b_H_a=H, iterations=self.max_iterations, capped=False)

    def _homography(self, a: Doubles, b: Doubles) -> Doubles | None:
        H, _ = cv2.findHomography(a, b, self._parameters())
        return None if H is None else np.asarray(H, np.float64)

    def _linear(self, a: Doubles, b: Doubles) -> Doubles | None:
        """An affine transformation, or one with fewer parameters fitted to its inliers."""
        rows, inliers = cv2.estimateAffine2D(a, b, self._parameters())
        if rows is None:
            return None
        if self.model == "affine":
            return np.vstack([np.asarray(rows, np.float64), [0.0, 0.0, 1.0]])
        right = np.asarray(inliers).ravel() > 0
        return fit(self.model, a[right], b[right])

    def _parameters(self) -> cv2.UsacParams:
        found = cv2.UsacParams()
        found.score, found.loMethod = cv2.SCORE_METHOD_MAGSAC, cv2.LOCAL_OPTIM_SIGMA
        found.threshold, found.confidence = self.threshold_px, self.confidence
        found.maxIterations, found.randomGeneratorState = self.max_iterations, self.seed
        return found
