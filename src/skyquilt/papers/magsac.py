"""MAGSAC++ (Barath et al. 2020): the threshold is marginalised over all noise levels up to a
largest one.
"""

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gamma, gammaincc

from skyquilt.geometry.transforms import Model, fit, symmetric_transfer_errors
from skyquilt.matching.estimate import Estimate, NoEstimate
from skyquilt.matching.frame import estimated
from skyquilt.matching.search import Found, search

Doubles = NDArray[np.float64]

_FAR = 9.21
"""99 % quantile of a chi-square of two degrees of freedom: squared distances over sigma^2 beyond it
are outliers.
"""


@dataclass(frozen=True, kw_only=True)
class Magsac:
    """For daily use. Homographies by OpenCV's USAC_MAGSAC; it has no other plane models, so those
    are found by a random search of our own with the same sigma-marginalised loss and reweighting.
    """

    model: Model = "homography"
    """What is estimated."""
    threshold_px: float = 3.0
    """Transfer error beyond which a match is an outlier at the largest noise level: root mean
    square of both ways.
    """
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
            "MAGSAC",
            self.model,
            a,
            b,
            minimum=self.minimum,
            find=self._usac if self.model == "homography" else self._search,
            finalise=lambda H, a, b: (self._reweighted(H, a, b), limit),
        )

    @property
    def _variance(self) -> float:
        """Square of the largest noise level, px^2."""
        return self.threshold_px**2 / _FAR

    def _usac(self, a: Doubles, b: Doubles) -> Found | None:
        """OpenCV does not tell how many samples it took: the cap is given, and no cap reported."""
        parameters = cv2.UsacParams()
        parameters.score, parameters.loMethod = cv2.SCORE_METHOD_MAGSAC, cv2.LOCAL_OPTIM_SIGMA
        parameters.threshold, parameters.confidence = self.threshold_px, self.confidence
        parameters.maxIterations, parameters.randomGeneratorState = self.max_iterations, self.seed
        try:
            H, _ = cv2.findHomography(a, b, parameters)
        except cv2.error:  # fewer than four distinct points
            return None
        if H is None or not np.isfinite(H).all():
            return None
        return Found(b_H_a=np.asarray(H, np.float64), iterations=self.max_iterations, capped=False)

    def _search(self, a: Doubles, b: Doubles) -> Found | None:
        return search(
            self.model,
            a,
            b,
            confidence=self.confidence,
            cap=self.max_iterations,
            seed=self.seed,
            cost=lambda e: _loss(e / 2 / self._variance).sum(1),
            support=lambda e: int((e / 2 < self.threshold_px**2).sum()),
        )

    def _reweighted(self, H: Doubles, a: Doubles, b: Doubles, *, rounds: int = 10) -> Doubles:
        """Least squares, each match weighted by how likely it is an inlier over all noise levels,
        until they stay.
        """
        for _ in range(rounds):
            weights = _weight(symmetric_transfer_errors(H, a, b) / 2 / self._variance)
            new = fit(self.model, a, b, weights)
            if new is None:
                return H
            H, moved = new, np.abs(new - H).max()
            if moved < 1e-6:
                break
        return H


def _upper(s: float, x: Doubles | np.float64) -> Doubles:
    return np.asarray(gammaincc(s, x) * gamma(s))


def _weight(z: Doubles) -> Doubles:
    """MAGSAC++ (9) of squared distances z over the largest variance, two degrees of freedom; 1 at
    0, 0 beyond _FAR.
    """
    z = np.minimum(z, _FAR)
    outer = _upper(0.5, np.float64(_FAR / 2))
    return np.asarray((_upper(0.5, z / 2) - outer) / (np.sqrt(np.pi) - outer))


def _loss(z: Doubles) -> Doubles:
    """MAGSAC++ (10), the integral of r weight(r) dr, as a share of an outlier's: 0 at 0, 1 beyond
    _FAR.
    """
    z = np.minimum(z, _FAR)
    return np.asarray(_area(z) / _area(np.float64(_FAR)))


def _area(z: Doubles | np.float64) -> Doubles:
    """Integral of weight over z from 0, up to a factor: int G(s, t) dt = t G(s, t) - G(s + 1, t) +
    G(s + 1, 0).
    """
    t = z / 2
    outer = _upper(0.5, np.float64(_FAR / 2))
    return np.asarray(t * (_upper(0.5, t) - outer) - _upper(1.5, t) + gamma(1.5))
