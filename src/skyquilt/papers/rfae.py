"""The thesis's registration between spectra: features of pictures or of their edges (RFAE),
matches, outliers removed, nine inliers believed [Y 5.2.1, 5.2.2, 6.4.1].

Nine inliers are no proof: random matches at a loose ratio reach them easily. These methods are here
to be compared with; `Auto` is the one to work with.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.usable import both_usable
from skyquilt.imaging.grey import to_grey8
from skyquilt.model.estimate import Estimate, NoEstimate
from skyquilt.model.features import Features, Matches
from skyquilt.model.registration import Guess, Picture, RefusedRegistration, Registers, Registration

THRESHOLDS = (0.2, 0.4, 0.6)
"""Shares of the largest gradient above which a pixel is an edge [Y 5.2.2]."""


def gradient_magnitude(values: NDArray[Any]) -> NDArray[np.float32]:
    """(H, W) in [0, 1]: length of Sobel's gradient (5.5) over its largest value; 0 where nothing
    changes.
    """
    grey = to_grey8(values).astype(np.float32)
    x = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.25)
    y = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.25)
    length = np.hypot(x, y)
    return np.asarray(length / max(float(length.max()), 1e-6), np.float32)


def binary_edges(magnitude: NDArray[np.float32], theta: float) -> NDArray[np.uint8]:
    """(H, W) 255 where the normalised magnitude exceeds theta, else 0 (5.6)."""
    return np.where(magnitude > theta, 255, 0).astype(np.uint8)


Outcome = Registration | RefusedRegistration
Detector = Callable[[NDArray[Any]], Features]
Matcher = Callable[[Features, Features], Matches]
Estimator = Callable[[NDArray[Any], NDArray[Any]], Estimate | NoEstimate]
DELTA = 0.1
"""Radius about an inlier that it covers, as a share of a's width [Y 6.4.1]."""


class Quality(Protocol):
    """Q of (6.3)."""

    def __call__(self, inliers: NDArray[Any], width: int, height: int, *, delta: float) -> float:
        """Spread of inliers (n, 2) over a picture, in [0, 1]."""
        ...


@dataclass(frozen=True, kw_only=True)
class Outliers:
    """Features of two pictures to a registration: RANSAC and LMedS, the better of them by Q."""

    match: Matcher
    """Matching."""
    estimators: tuple[Estimator, ...]
    """Each gives a similarity from matches, or none."""
    quality: Quality
    """Q."""

    def __call__(self, a: Features, b: Features, shape: tuple[int, int]) -> Outcome:
        """The registration; `shape` is a's height and width."""
        found = self.match(a, b)
        pa, pb = a.px[found.index_a], b.px[found.index_b]
        outcomes = [self._outcome(estimate(pa, pb), pa, pb, shape) for estimate in self.estimators]
        return best(outcomes)

    def _outcome(
        self,
        estimate: Estimate | NoEstimate,
        pa: NDArray[Any],
        pb: NDArray[Any],
        shape: tuple[int, int],
    ) -> Outcome:
        evidence = {"matches": float(len(pa))}
        if isinstance(estimate, NoEstimate):
            return RefusedRegistration(reason=estimate.reason, evidence=evidence)
        inliers = pa[estimate.inliers]
        q = self.quality(inliers, shape[1], shape[0], delta=DELTA * shape[1])
        return Registration(
            model="similarity",
            b_H_a=estimate.b_H_a,
            px_a=inliers,
            px_b=pb[estimate.inliers],
            q=q,
            evidence=evidence,
        )


@dataclass(frozen=True, kw_only=True)
class ByFeatures:
    """SIFT, SURF or upright SURF on the pictures themselves."""

    detect: Detector
    """Features of an 8-bit picture."""
    relate: Outliers
    """Features to a registration."""
    version: ClassVar[int] = 1

    def __call__(self, a: Picture, b: Picture, guess: Guess | None = None) -> Outcome:
        """The registration of b to a; a guess is not used."""
        if isinstance(refused := both_usable(a, b), RefusedRegistration):
            return refused
        return self.relate(self.detect(a.values), self.detect(b.values), a.shape)


@dataclass(frozen=True, kw_only=True)
class Rfae:
    """Robust features along the edge [Y 5.2.2]: features of binary edge images, each picture's
    threshold chosen by the highest Q of all pairs of thresholds.
    """

    detect: Detector
    """SIFT or SURF."""
    relate: Outliers
    """Features to a registration."""
    thresholds: tuple[float, ...] = THRESHOLDS
    """Shares of the largest gradient."""
    version: ClassVar[int] = 1

    def __call__(self, a: Picture, b: Picture, guess: Guess | None = None) -> Outcome:
        """The registration of b to a; a guess is not used."""
        if isinstance(refused := both_usable(a, b), RefusedRegistration):
            return refused
        in_a, in_b = self._features(a), self._features(b)
        return best([self.relate(fa, fb, a.shape) for fa in in_a for fb in in_b])

    def _features(self, picture: Picture) -> list[Features]:
        magnitude = gradient_magnitude(picture.values)
        return [self.detect(binary_edges(magnitude, theta)) for theta in self.thresholds]


@dataclass(frozen=True, kw_only=True)
class BetterByQ:
    """Several methods, the highest Q wins [Y 6.4.1: SURF + RFAE]."""

    methods: tuple[Registers, ...]
    """The methods."""
    version: ClassVar[int] = 1

    def __call__(self, a: Picture, b: Picture, guess: Guess | None = None) -> Outcome:
        """The best registration of b to a."""
        return best([method(a, b, guess) for method in self.methods])


def best(outcomes: Sequence[Outcome]) -> Outcome:
    """The highest Q; of refusals the one with most matches."""
    accepted = [o for o in outcomes if isinstance(o, Registration)]
    if accepted:
        return max(accepted, key=lambda o: o.q)
    return max(outcomes, key=lambda o: o.evidence.get("matches", 0.0))
