"""A time before which no plan for these points and drones can end.

Take all sorties of a plan together, S of them. Without the legs from and to the ground they are S
paths through all n points: a forest with n - S edges. So the smallest forest with n - S edges (the
minimum spanning tree less its S - 1 longest edges: Kruskal 1956), the S cheapest first legs and the
S cheapest last legs are a lower bound of all flying time. Every point has two legs, so a weight w_i
added to all legs at point i adds 2 sum(w) to every plan; the w that give the largest bound are
sought by the subgradient method (Held and Karp 1971; for several routes Fisher 1994). Shared evenly
by the drones that fly, this bounds the last landing; the farthest point bounds it alone.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.planning.records import Array

ROUNDS = 120
"""Steps of the subgradient method at 300 points; fewer for more."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """What has to be done."""

    times: Array
    """(n, n) least times of legs between points in s: of the fastest drone, in the faster
    direction.
    """
    out: Array
    """(n,) least times of first legs, climbs included."""
    home: Array
    """(n,) least times of last legs, landing included."""
    photo: float
    """Least time at a point."""
    drones: int
    """K."""
    usable: float
    """Largest flight time of a sortie in s."""
    swap: float
    """Least time between sorties in s."""


def work_of(
    times: Sequence[Array], out: Sequence[Array], home: Sequence[Array], photo: Sequence[float],
    usable: Sequence[float], swap: Sequence[float],
) -> Work:  # fmt: skip
    """The least of all drones in everything."""
    least = np.min(np.stack(times), axis=0)
    return Work(
        times=np.minimum(least, least.T),
        out=np.min(np.stack(out), axis=0),
        home=np.min(np.stack(home), axis=0),
        photo=min(photo),
        drones=len(times),
        usable=max(usable),
        swap=min(swap),
    )


def lower_bound(work: Work, most_sorties: int) -> float:
    """The bound in s; `most_sorties`: up to so many are examined with weights, more without."""
    n = len(work.out)
    farthest = float((work.out + work.home).max() + work.photo)
    photos = n * work.photo
    bounds = []
    for sorties in range(1, min(n, most_sorties) + 1):
        total = _forest_bound(work, sorties) + photos
        if total <= sorties * work.usable * (1 + 1e-9):
            bounds.append(_shared(work, total, sorties))
    # more sorties: without weights
    edges = np.sort(_tree(work.times)[1])[::-1]
    saved = np.concatenate([[0.0], np.cumsum(edges)])
    legs = np.cumsum(np.sort(work.out)) + np.cumsum(np.sort(work.home))
    for sorties in range(most_sorties + 1, n + 1):
        total = float(edges.sum() - saved[sorties - 1] + legs[sorties - 1]) + photos
        if total <= sorties * work.usable:
            bounds.append(_shared(work, total, sorties))
    return max(farthest, min(bounds, default=0.0))


def _shared(work: Work, total: float, sorties: int) -> float:
    """Flying and swaps spread evenly over the drones that fly."""
    drones = min(work.drones, sorties)
    return (total + (sorties - drones) * work.swap) / drones


def _forest_bound(work: Work, sorties: int) -> float:
    """The bound on all flying of S sorties, without photos."""
    n = len(work.out)
    weight = np.zeros(n)
    best, step = -math.inf, 0.0
    rounds = int(np.clip(ROUNDS * 300 / n, 15, ROUNDS))
    slope = np.zeros(n)
    for number in range(rounds):
        value, degree = _relaxed(work, weight, sorties)
        best = max(best, value)
        if number == 0:
            step = 0.6 * max(value, 1e-9) / n
        slope = 0.7 * (degree - 2) + 0.3 * slope
        if not slope.any():
            break
        weight = weight + step * slope
        step *= 0.965
    return best


def _relaxed(work: Work, weight: Array, sorties: int) -> tuple[float, Array]:
    """The least forest with first and last legs under weights, and the legs at each point."""
    n = len(weight)
    shifted = work.times + weight[:, None] + weight[None, :]
    pairs, lengths = _tree(shifted)
    keep = np.argsort(lengths)[: n - sorties]
    out, home = work.out + weight, work.home + weight
    first, last = np.argsort(out)[:sorties], np.argsort(home)[:sorties]
    degree = np.bincount(pairs[keep].ravel(), minlength=n).astype(np.float64)
    degree[first] += 1
    degree[last] += 1
    value = lengths[keep].sum() + out[first].sum() + home[last].sum() - 2 * weight.sum()
    return float(value), degree


def _tree(times: Array) -> tuple[NDArray[np.int64], Array]:
    """Edges (n - 1, 2) and lengths (n - 1,) of the minimum spanning tree (Prim 1957)."""
    n = len(times)
    near = times[0].copy()
    source = np.zeros(n, np.int64)
    near[0] = np.inf
    inside = np.zeros(n, bool)
    inside[0] = True
    pairs, lengths = np.empty((n - 1, 2), np.int64), np.empty(n - 1)
    for k in range(n - 1):
        j = int(np.argmin(near))
        pairs[k], lengths[k] = (source[j], j), near[j]
        inside[j] = True
        near[j] = np.inf
        closer = (times[j] < near) & ~inside
        near[closer] = times[j][closer]
        source[closer] = j
    return pairs, lengths
