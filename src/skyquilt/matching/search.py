"""Random search shared by the robust estimators: samples, models and costs, computed in batches of
hundreds.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.transforms import MINIMAL, fit_many, symmetric_transfer_errors

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
