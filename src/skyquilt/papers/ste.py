"""RANSAC by the symmetric transfer error per inlier, Arteaga et al. (2019), section 2.5 and figure
8.

As printed, with five interpretations: (10) has (1 - eps)^s with s = 4 in the place of its exponent
S; the errors are sums of squares, so 0.2, 0.5 and t are px^2; the four distant points are those of
the two longest of random pairs; a model whose error exceeds ten times that of the best so far is
skipped; RANSAC-2-OPT runs once and four times more. Photos must first be reduced to at most
1500 x 1000 px, since the thresholds are for this size. `RansacSte(literal=True)` takes (10) and the
rule of ten times word for word.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyquilt.geometry.refine import refine
from skyquilt.geometry.transforms import MINIMAL, Model, fit_many, symmetric_transfer_errors
from skyquilt.matching.estimate import (
    Estimate,
    Estimator,
    NoEstimate,
    matched,
    needed,
    samples,
    too_few,
    weak,
)


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


Doubles = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Reference:
    """The best model of a run so far."""

    H: Doubles
    inliers: NDArray[np.bool_]
    ste: float
    sigma: float
    iterations: int = 0
    capped: bool = False

    @property
    def count(self) -> int:
        return int(self.inliers.sum())

    def beats(self, other: "_Reference") -> bool:
        """Whether it has more inliers, or as many with no larger scatter."""
        return self.count > other.count or (self.count == other.count and self.sigma <= other.sigma)


@dataclass(frozen=True, kw_only=True)
class RansacSte:
    """A's complete estimator: RANSAC-1-OPT up to five times, else the best of five RANSAC-2-OPT."""

    model: Model = "homography"
    """Type of the transformation. A uses the homography; the others are estimated in the
    same way.
    """
    threshold_px2: float | None = None
    """Largest symmetric transfer error of an inlier in px^2. None is (9), t = sqrt(5.99) sigma over
    all matches, which increases with the outliers; a fixed number is our extension that avoids
    this.
    """
    confidence: float = 0.99
    """p_o: probability that at least one sample was free of outliers."""
    max_iterations: int = 1000
    """Largest number of samples of one RANSAC-2; a tenth of it for RANSAC-1, whose samples are each
    refined over all matches.
    """
    minimum: int = 8
    """Fewest inliers of an estimate."""
    literal: bool = False
    """Whether (10) has the number of matches S for its exponent, and the reference of the rule of
    ten times is the last error that met it, both as printed.
    """
    seed: int = 0
    """Seed of the samples; equal seeds give equal results."""
    accept_ste: ClassVar[float] = 0.2
    accept_share: ClassVar[float] = 0.75
    retry_ste: ClassVar[float] = 0.5
    tries: ClassVar[int] = 5
    version: ClassVar[int] = 2

    def __call__(self, a: ArrayLike, b: ArrayLike) -> Estimate | NoEstimate:
        """b_H_a from matches a, b (N, 2) px, or why there is none."""
        a, b = matched(a, b)
        if (few := too_few(self.model, len(a), self.minimum)) is not None:
            return few
        rng = np.random.default_rng(self.seed)
        spent, capped = 0, False
        for attempt in range(self.tries):
            found = self._optimised(self._ransac_1(rng, a, b), a, b)
            if found is None:
                break
            spent, capped = spent + found.iterations, capped or found.capped
            if found.ste < self.accept_ste and found.count > self.accept_share * len(a):
                return self._told(
                    replace(found, iterations=spent, capped=capped), a, "RANSAC-1-OPT"
                )
            # step 2 tests the error of step 1 only; later tries repeat until 2 (a) holds
            if attempt == 0 and found.ste >= self.retry_ste:
                break
        return self._second(rng, a, b, spent, capped)

    def _second(
        self, rng: np.random.Generator, a: Doubles, b: Doubles, spent: int, capped: bool
    ) -> Estimate | NoEstimate:
        """Steps 3 and 4: RANSAC-2-OPT once and four times more, the result with the least error per
        inlier is used.
        """
        best: _Reference | None = None
        for _ in range(self.tries):
            found = self._optimised(self._ransac_2(rng, a, b), a, b)
            if found is None:
                continue
            spent, capped = spent + found.iterations, capped or found.capped
            if found.count >= max(self.minimum, MINIMAL[self.model] + 1) and (
                best is None or found.ste < best.ste
            ):
                best = found
        if best is None:
            return NoEstimate(
                reason=f"weak inliers (fewer than {self.minimum} of {len(a)} matches)"
            )
        return self._told(replace(best, iterations=spent, capped=capped), a, "RANSAC-2-OPT")

    def _told(self, found: _Reference, a: Doubles, method: str) -> Estimate | NoEstimate:
        if (feeble := weak(self.model, found.count, len(a), self.minimum)) is not None:
            return feeble
        return Estimate(
            model=self.model,
            b_H_a=found.H,
            inliers=found.inliers,
            ste_per_inlier=found.ste,
            iterations=found.iterations,
            capped=found.capped,
            method=method,
        )

    def _optimised(self, found: _Reference | None, a: Doubles, b: Doubles) -> _Reference | None:
        """OPT (12), (13): the model refined over its inliers, which are not changed; `ste` becomes
        (15), per inlier.
        """
        if found is None or found.count < MINIMAL[self.model]:
            return None
        a, b = a[found.inliers], b[found.inliers]
        H = refine(self.model, found.H, a, b)
        return replace(found, H=H, ste=float(symmetric_transfer_errors(H, a, b).mean()))

    def _ransac_1(self, rng: np.random.Generator, a: Doubles, b: Doubles) -> _Reference | None:
        """Samples of distant points, each model refined over all matches."""
        size, cap = MINIMAL[self.model], max(1, self.max_iterations // 10)
        best: _Reference | None = None
        least, done, wanted = np.inf, 0, 1
        while done < min(wanted, cap):
            done += 1
            index = _distant(rng, a, size)
            H = fit_many(self.model, a[None, index], b[None, index])[0]
            new = self._judged(refine(self.model, H, a, b), a, b) if np.isfinite(H).all() else None
            if new is not None and new.ste <= 10 * least:
                least = new.ste if self.literal else min(least, new.ste)
                best = new if best is None or new.beats(best) else best
            wanted = self._needed(best, len(a), size, cap)
        return None if best is None else replace(best, iterations=done, capped=done < wanted)

    def _ransac_2(self, rng: np.random.Generator, a: Doubles, b: Doubles) -> _Reference | None:
        """Samples of any points, models without refinement."""
        size, cap = MINIMAL[self.model], self.max_iterations
        best: _Reference | None = None
        done, wanted = 0, 1
        while done < min(wanted, cap):
            batch = min(64, cap - done)
            index = samples(rng, len(a), size, batch)
            for H in fit_many(self.model, a[index], b[index]):
                done += 1
                new = self._judged(H, a, b) if np.isfinite(H).all() else None
                best = new if new is not None and (best is None or new.beats(best)) else best
                wanted = self._needed(best, len(a), size, cap)
                if done >= wanted:
                    break
        return None if best is None else replace(best, iterations=done, capped=done < wanted)

    def _needed(self, best: _Reference | None, matches: int, size: int, cap: int) -> int:
        """Number of samples by (10), at most cap + 1."""
        if best is None:
            return cap + 1
        if self.literal:
            return needed_as_printed(self.confidence, best.count / matches, matches, cap)
        return needed(self.confidence, best.count / matches, size, cap)

    def _judged(self, H: Doubles, a: Doubles, b: Doubles) -> _Reference | None:
        """Steps iii and iv: errors, the threshold (9), the inliers with the sum and the scatter of
        their errors.
        """
        errors = symmetric_transfer_errors(H, a, b)
        if not np.isfinite(errors).all():
            return None
        t = np.sqrt(5.99) * errors.std() if self.threshold_px2 is None else self.threshold_px2
        inliers = errors <= t if errors.std() == 0 else errors < t
        if not inliers.any():
            return None
        return _Reference(
            H=H,
            inliers=inliers,
            ste=float(errors[inliers].sum()),
            sigma=float(errors[inliers].std()),
        )


def needed_as_printed(confidence: float, share: float, matches: int, cap: int) -> int:
    """(10) word for word, log(1 - p) / log(1 - (1 - eps^S)), at most cap + 1: 1 or 2
    unless hardly any of the S matches are inliers.
    """
    if share >= 1 or share <= 0:
        return 1 if share >= 1 else cap + 1
    return min(cap + 1, math.ceil(math.log(1 - confidence) / (matches * math.log1p(-share))))


def literal(**options: Any) -> RansacSte:
    """The estimator as printed, word for word."""
    return RansacSte(literal=True, **options)


def _distant(rng: np.random.Generator, a: Doubles, size: int) -> NDArray[np.int64]:
    """(size,) matches far apart: all are paired at random, and the longest pairs are taken (step
    i).
    """
    order = rng.permutation(len(a))[: len(a) // 2 * 2].reshape(-1, 2)
    longest = np.argsort(-np.linalg.norm(a[order[:, 0]] - a[order[:, 1]], axis=1), kind="stable")
    return order[longest[: (size + 1) // 2]].ravel()[:size]
