"""What all estimators of a plane transformation share: checks of the points, the random search, the
final fit, and the record of a transformation with its inliers.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyquilt.geometry.refine import refine
from skyquilt.geometry.transforms import MINIMAL, fit, fit_many, symmetric_transfer_errors
from skyquilt.model.estimate import Estimate, NoEstimate

Doubles = NDArray[np.float64]

_FIRST, _LARGEST = 16, 256


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """The best model of a search."""

    b_H_a: Doubles
    """(3, 3) transformation."""
    iterations: int
    """Samples tried."""
    capped: bool
    """True if more samples would have been needed."""


def samples(rng: np.random.Generator, total: int, size: int, count: int) -> NDArray[np.int64]:
    """(count, size) indices below `total`, those of a row distinct."""
    drawn = np.empty((count, size), np.int64)
    for k in range(size):
        new = rng.integers(total - k, size=count)
        for earlier in np.sort(drawn[:, :k], axis=1).T:  # skip indices already drawn
            new += new >= earlier
        drawn[:, k] = new
    return drawn


def needed(confidence: float, share: float, size: int, cap: int) -> int:
    """Number of samples until one is free of outliers with that confidence, at most cap + 1 [A
    (10), with its exponent S read as (1 - eps)^s].
    """
    clean = share**size
    if clean >= 1:
        return 1
    if clean <= 0 or (count := math.log(1 - confidence) / math.log1p(-clean)) > cap:
        return cap + 1
    return max(1, math.ceil(count))


def search(
    model: str,
    a: Doubles,
    b: Doubles,
    *,
    cost: Callable[[Doubles], Doubles],
    support: Callable[[Doubles], int],
    confidence: float,
    cap: int,
    seed: int,
) -> Found | None:
    """The model with the lowest cost among those from random minimal samples; None if no sample
    determines one.

    `cost` maps symmetric transfer errors (M, N) px^2 to costs (M,). `support` maps those of one
    model (N,) to its number of inliers, which determines how many samples are enough. Equal seeds
    give equal results.
    """
    rng, size = np.random.default_rng(seed), MINIMAL[model]
    best, least, done, wanted, batch = None, np.inf, 0, cap + 1, _FIRST
    while done < min(wanted, cap):
        index = samples(rng, len(a), size, min(batch, min(wanted, cap) - done))
        H = fit_many(model, a[index], b[index])
        errors = symmetric_transfer_errors(H, a, b)
        costs = cost(errors)
        top = int(costs.argmin())
        if costs[top] < least and np.isfinite(H[top]).all():
            best, least = H[top], costs[top]
            wanted = needed(confidence, support(errors[top]) / len(a), size, cap)
        done, batch = done + len(index), min(2 * batch, _LARGEST)
    return None if best is None else Found(b_H_a=best, iterations=done, capped=done < wanted)


Search = Callable[[Doubles, Doubles], Found | None]
"""Finds the best model from random samples of matches a, b (N, 2) px; None if no sample determines
one.
"""
Finalise = Callable[[NDArray[Any], Doubles, Doubles], tuple[Doubles, float] | NoEstimate]
"""b_H_a of a search -> the one to refine, and the largest symmetric transfer error of an inlier in
px^2.
"""


def estimated(
    name: str,
    model: str,
    a: ArrayLike,
    b: ArrayLike,
    *,
    minimum: int,
    find: Search,
    finalise: Finalise,
) -> Estimate | NoEstimate:
    """b_H_a from matches a, b (N, 2) px by the loss of `find` and `finalise`, or the reason why
    there is none.
    """
    a, b = matched(a, b)
    if (few := too_few(model, len(a), minimum)) is not None:
        return few
    found = find(a, b)
    if found is None:
        return NoEstimate(reason=f"no {model} fits the matches")
    final = finalise(found.b_H_a, a, b)
    if isinstance(final, NoEstimate):
        return final
    H, inliers = polished(model, final[0], a, b, final[1])
    if (feeble := weak(model, int(inliers.sum()), len(a), minimum)) is not None:
        return feeble
    return Estimate(
        model=model,
        b_H_a=H,
        inliers=inliers,
        iterations=found.iterations,
        capped=found.capped,
        ste_per_inlier=float(symmetric_transfer_errors(H, a[inliers], b[inliers]).mean()),
        method=name,
    )


class Estimator(Protocol):
    """Interface of the estimators of a transformation from matches a, b (N, 2) px: `Ransac`,
    `Lmeds`, `Magsac`, `RansacSte`.
    """

    def __call__(self, a: ArrayLike, b: ArrayLike) -> Estimate | NoEstimate:
        """b_H_a with its inliers, or the reason why there is none."""
        ...


def matched(a: ArrayLike, b: ArrayLike) -> tuple[Doubles, Doubles]:
    """Both as (N, 2) float; ValueError if they are not matches."""
    pa, pb = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if pa.ndim != 2 or pa.shape[1] != 2 or pa.shape != pb.shape:
        raise ValueError(f"two equal (N, 2) expected, got {pa.shape} and {pb.shape}")
    if not (np.isfinite(pa).all() and np.isfinite(pb).all()):
        raise ValueError("points must be finite")
    return pa, pb


def too_few(model: str, count: int, minimum: int) -> NoEstimate | None:
    """Why `count` matches are not enough; None if they are. At least one match more than the
    minimal sample is needed, since the sample itself always agrees.
    """
    least = max(minimum, MINIMAL[model] + 1)
    return NoEstimate(reason=f"too few matches ({count} of {least})") if count < least else None


def weak(model: str, count: int, total: int, minimum: int) -> NoEstimate | None:
    """Why `count` inliers of `total` matches are not enough; None if they are."""
    if count >= max(minimum, MINIMAL[model] + 1):
        return None
    return NoEstimate(reason=f"weak inliers ({count} of {total} matches)")


def polished(
    model: str, H: Doubles, a: Doubles, b: Doubles, limit: float, *, rounds: int = 5
) -> tuple[Doubles, NDArray[np.bool_]]:
    """The model fitted to the matches with a symmetric transfer error below `limit` px^2, repeated
    until these no longer change; and these matches.
    """
    inliers = symmetric_transfer_errors(H, a, b) < limit
    for _ in range(rounds):
        if inliers.sum() < MINIMAL[model]:
            break
        fitted = fit(model, a[inliers], b[inliers])
        if fitted is None:
            break
        H = refine(model, fitted, a[inliers], b[inliers])
        before, inliers = inliers, symmetric_transfer_errors(H, a, b) < limit
        if (before == inliers).all():
            break
    return H, inliers


__all__ = ["Estimate", "Estimator", "NoEstimate", "matched", "polished", "too_few", "weak"]
