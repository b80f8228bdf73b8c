"""Registration between spectral bands as in the thesis: features of images or of their edges
(RFAE), matches, removal of outliers; nine inliers are accepted [Y 5.2.1, 5.2.2, 6.4.1].

Nine inliers do not prove a registration: random matches with a loose ratio test often reach this
number. These methods are for comparison; use `Auto` in practice.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.decision import Decide
from skyquilt.coregistration.marks import WithoutMarks
from skyquilt.coregistration.methods import INLIERS, SAMPLES
from skyquilt.coregistration.orientation import Pyramid
from skyquilt.coregistration.structure import sharpened
from skyquilt.coregistration.usable import both_usable
from skyquilt.imaging.gradients import noise_in
from skyquilt.imaging.grey import to_grey8
from skyquilt.matching.matchers import OneWay
from skyquilt.matching.ransac import Ransac
from skyquilt.matching.sift import Sift
from skyquilt.model.estimate import Estimate, NoEstimate
from skyquilt.model.features import Features, Matches
from skyquilt.model.registration import (
    Guess,
    Outcome,
    Picture,
    RefusedRegistration,
    Registers,
    Registration,
)
from skyquilt.papers.lmeds import Lmeds
from skyquilt.papers.surf import Surf
from skyquilt.quality.registration_quality import spread_quality

THRESHOLDS = (0.2, 0.4, 0.6)
"""Shares of the largest gradient above which a pixel is an edge [Y 5.2.2]."""
LARGEST = 95.0
"""Percentile of the gradients that counts as the largest: the single largest one is that of a lamp
or a hot object, and leaves no edges elsewhere.
"""
FALSE_EDGES = 0.01
"""Share of the pixels of plain noise that the threshold from the sensor's noise takes for edges."""


def gradient_magnitude(values: NDArray[Any], largest: float = LARGEST) -> NDArray[np.float32]:
    """(H, W) in [0, 1]: length of Sobel's gradient (5.5) over the percentile `largest` of its
    values; 0 for a constant image.
    """
    grey = to_grey8(values).astype(np.float32)
    x = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.25)
    y = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.25)
    length = np.hypot(x, y)
    scale = float(np.percentile(length, largest)) or float(length.max())
    return np.asarray(np.minimum(length / max(scale, 1e-6), 1), np.float32)


def noise_threshold(values: NDArray[Any], largest: float = LARGEST) -> float:
    """The gradient that noise alone exceeds in `FALSE_EDGES` of the pixels, in units of
    `gradient_magnitude`: the thesis's threshold from the statistics of a sensor [Y 5.2.2].

    A gradient of normal noise has a Rayleigh distribution.
    """
    grey = to_grey8(values).astype(np.float32)
    gradient = noise_in(grey) * np.sqrt(12) / 4  # Sobel's norm, with its factor 1/4
    x = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.25)
    y = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.25)
    scale = float(np.percentile(np.hypot(x, y), largest))
    return float(np.sqrt(-2 * np.log(FALSE_EDGES)) * gradient / max(scale, 1e-6))


def binary_edges(magnitude: NDArray[np.float32], theta: float) -> NDArray[np.uint8]:
    """(H, W) 255 where the normalised magnitude exceeds theta, else 0 (5.6)."""
    return np.where(magnitude > theta, 255, 0).astype(np.uint8)


Detector = Callable[[NDArray[Any]], Features]
Matcher = Callable[[Features, Features], Matches]
Estimator = Callable[[NDArray[Any], NDArray[Any]], Estimate | NoEstimate]
DELTA = 0.1
"""Radius of the area covered by an inlier, as a share of a's width [Y 6.4.1]."""


class Quality(Protocol):
    """Q of (6.3)."""

    def __call__(self, inliers: NDArray[Any], width: int, height: int, *, delta: float) -> float:
        """Spread of inliers (n, 2) over an image, in [0, 1]."""
        ...


@dataclass(frozen=True, kw_only=True)
class Outliers:
    """Registration from the features of two images by RANSAC and LMedS; the better result by Q is
    used.
    """

    match: Matcher
    """Matching."""
    estimators: tuple[Estimator, ...]
    """Estimators of a similarity from matches."""
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


LOBES = (1, 3, 5, 7)
"""Initial lobes of SURF that are tried: filters of 3, 9, 15 and 21 px."""


def off_rims(features: Features, picture: Picture) -> Features:
    """Without features that lie on what was not measured or at its rim: outlines of two maps are
    alike at their corners, wherever these lie.
    """
    band = picture.values if picture.values.ndim == 2 else picture.values.max(2)
    measured = np.isfinite(band)
    if picture.valid is not None:
        measured &= picture.valid
    if measured.all() or not len(features):
        return features
    room = cv2.distanceTransform(measured.astype(np.uint8), cv2.DIST_L2, 3)
    x, y = np.rint(features.px).astype(int).T
    here = room[np.clip(y, 0, band.shape[0] - 1), np.clip(x, 0, band.shape[1] - 1)]
    kept = here > features.size / 2
    return replace(
        features,
        px=features.px[kept],
        size=features.size[kept],
        descriptors=features.descriptors[kept],
    )


@dataclass(frozen=True, kw_only=True)
class ByFeatures:
    """SIFT, SURF or upright SURF on the images themselves."""

    detect: Detector
    """Detector of features in an 8-bit image."""
    relate: Outliers
    """Features to a registration."""
    version: ClassVar[int] = 2

    def __call__(self, a: Picture, b: Picture, guess: Guess | None = None) -> Outcome:
        """The registration of b to a; a guess is not used."""
        if isinstance(refused := both_usable(a, b), RefusedRegistration):
            return refused
        in_a, in_b = (off_rims(self.detect(p.values), p) for p in (a, b))
        return self.relate(in_a, in_b, a.shape)


@dataclass(frozen=True, kw_only=True)
class Rfae:
    """Robust features along the edge [Y 5.2.2]: features of binary edge images, the thresholds are
    the pair with the highest Q.
    """

    detect: Detector
    """SIFT or SURF."""
    relate: Outliers
    """Features to a registration."""
    thresholds: tuple[float, ...] = THRESHOLDS
    """Shares of the largest gradient."""
    largest: float = LARGEST
    """Percentile of the gradients that counts as the largest; 100 as printed."""
    of_noise: bool = True
    """Whether a threshold from the noise of each picture is tried too."""
    version: ClassVar[int] = 3

    def __call__(self, a: Picture, b: Picture, guess: Guess | None = None) -> Outcome:
        """The registration of b to a; a guess is not used."""
        if isinstance(refused := both_usable(a, b), RefusedRegistration):
            return refused
        in_a, in_b = self._features(a), self._features(b)
        return best([self.relate(fa, fb, a.shape) for fa in in_a for fb in in_b])

    def _features(self, picture: Picture) -> list[Features]:
        magnitude = gradient_magnitude(picture.values, self.largest)
        tried = list(self.thresholds)
        if self.of_noise:
            tried.append(float(np.clip(noise_threshold(picture.values, self.largest), 0.02, 0.9)))
        return [off_rims(self.detect(binary_edges(magnitude, theta)), picture) for theta in tried]


@dataclass(frozen=True, kw_only=True)
class BetterByQ:
    """Several methods, of which the result with the highest Q is used [Y 6.4.1: SURF + RFAE]."""

    methods: tuple[Registers, ...]
    """The methods."""
    version: ClassVar[int] = 1

    def __call__(self, a: Picture, b: Picture, guess: Guess | None = None) -> Outcome:
        """The best registration of b to a."""
        return best([method(a, b, guess) for method in self.methods])


@dataclass(frozen=True, kw_only=True)
class Refined:
    """What a method of the thesis finds, refined on orientation fields and accepted only if patches
    confirm it: nine inliers in a part of the picture leave an error of several px elsewhere.
    """

    method: Registers
    """The method."""
    decide: Decide = field(default_factory=Decide)
    """The decision."""
    sides: tuple[float, float] = (160.0, 256.0)
    """Sides in px of the squares to whose areas the images are reduced: for refinement,
    decision.
    """
    version: ClassVar[int] = 1

    def __call__(self, a: Picture, b: Picture, guess: Guess | None = None) -> Outcome:
        """The registration of b to a; a guess is not used."""
        found, pictures = self.method(a, b, guess), both_usable(a, b)
        if isinstance(found, RefusedRegistration):
            return found
        if isinstance(pictures, RefusedRegistration):
            return pictures
        pyramid = Pyramid(a=pictures[0], b=pictures[1], sides=self.sides)
        return self.decide(pyramid, [sharpened(pyramid, found.b_H_a, pyramid.last - 1)])


def best(outcomes: Sequence[Outcome]) -> Outcome:
    """The outcome with the highest Q; if all are refused, the one with most matches."""
    accepted = [o for o in outcomes if isinstance(o, Registration)]
    if accepted:
        return max(accepted, key=lambda o: o.q)
    return max(outcomes, key=lambda o: o.evidence.get("matches", 0.0))


def sift() -> ByFeatures:
    """SIFT with 43 levels."""
    return ByFeatures(detect=_sift(), relate=_outliers())


def surf() -> ByFeatures:
    """SURF with an initial lobe and a sampling step of 1."""
    return ByFeatures(detect=_surf(), relate=_outliers())


def usurf() -> ByFeatures:
    """The same without orientation."""
    return ByFeatures(detect=_surf(upright=True), relate=_outliers())


def sift_from_own_size() -> ByFeatures:
    """SIFT with 43 levels whose first octave is 0: the image is not doubled [Y 5.2.1]."""
    return ByFeatures(detect=replace(_sift(), first_octave=0), relate=_outliers())


def surf_by_lobe() -> BetterByQ:
    """SURF with the initial lobe that gives the highest Q [Y 6.4.1, Fig. 6.11]."""
    return BetterByQ(
        methods=tuple(
            ByFeatures(detect=replace(_surf(), lobe=lobe), relate=_outliers()) for lobe in LOBES
        )
    )


def rfae() -> Rfae:
    """SURF along edges."""
    return Rfae(detect=_surf(), relate=_outliers())


def rfae_as_printed() -> Rfae:
    """The same with the single largest gradient and the three thresholds only [Y 5.2.2]."""
    return Rfae(detect=_surf(), relate=_outliers(), largest=100.0, of_noise=False)


def rfae_sift() -> Rfae:
    """SIFT along edges."""
    return Rfae(detect=_sift(), relate=_outliers())


def surf_and_rfae() -> BetterByQ:
    """The better of SURF and RFAE by Q [Y 6.4.1]."""
    return BetterByQ(methods=(surf(), rfae()))


def rfae_refined() -> WithoutMarks:
    """SURF along edges, refined and confirmed by patches."""
    return WithoutMarks(method=Refined(method=rfae()))


def _sift() -> Sift:
    return Sift(levels=43, root=False, longest=1000, count=3000)


def _surf(*, upright: bool = False) -> Surf:
    return Surf(lobe=1, step=1, upright=upright)


def _outliers() -> Outliers:
    return Outliers(
        match=OneWay(),
        quality=spread_quality,
        estimators=(
            Ransac(model="similarity", minimum=INLIERS, max_iterations=SAMPLES),
            Lmeds(model="similarity", minimum=INLIERS, max_iterations=SAMPLES),
        ),
    )
