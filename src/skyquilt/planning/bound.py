"""A time before which no plan for these points and drones can end.

Take all sorties of a plan together, S of them. Without the legs from and to the ground they are S
paths through all n points: a forest with n - S edges. So the smallest forest with n - S edges (the
minimum spanning tree less its S - 1 longest edges: Kruskal 1956) and the cheapest first and last
legs, of each drone that flies at least one, are a lower bound of all flying time. Every point has
two legs, so a weight w_i added to all legs at point i adds 2 sum(w) to every plan; and where k
sorties at least are needed to visit the points of a set, 2 k legs cross its border (the capacity
cuts of Laporte, Nobert and Desrochers 1985), so a weight u taken from all legs that cross it takes
at least 2 k u. The weights that give the largest bound are sought by the subgradient method (Held
and Karp 1971; for several routes Fisher 1994) with Polyak's step (1969). Shared evenly by the
drones that fly, this bounds the last landing; the farthest point bounds it alone.

How many sorties a set needs depends on the last landing T: the shortest paths through its points
and the legs there and back must fit into T. So a plan ends after T, or after the bound L(T).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import shortest_path

from skyquilt.planning.records import Array

ROUNDS = 150
"""Steps of the subgradient method at 300 points; fewer for more."""
MOST_CUT = 600
"""Points beyond which no sets are examined."""
DIRECTIONS, PLACES = 12, 14
"""Directions, and places along each, of the lines that divide the points into sets."""
LATER = 1.05
"""The first last landing tried, over the bound without sets; the next one is what was found."""
AIM = 1.4
"""The bound that steps aim at, over the last landing that is tried."""
PATIENCE = 4
"""Steps without a larger bound after which steps are shortened."""
TRIES = 3
"""Last landings tried at most."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """What has to be done."""

    times: Array
    """(n, n) least times of legs between points in s: of the fastest drone, in the faster
    direction.
    """
    out: Array
    """(K, n) times of first legs of each drone, climbs included."""
    home: Array
    """(K, n) times of last legs, landing included."""
    places: Array
    """(n, 2) the points in m; they only suggest sets."""
    photo: float
    """Least time at a point."""
    usable: float
    """Largest flight time of a sortie in s."""
    swap: float
    """Least time between sorties in s."""

    @property
    def drones(self) -> int:
        """K."""
        return len(self.out)


def work_of(
    times: Sequence[Array], out: Sequence[Array], home: Sequence[Array], places: Array,
    photo: Sequence[float], usable: Sequence[float], swap: Sequence[float],
) -> Work:  # fmt: skip
    """The least of all drones in what is not their own."""
    least = np.min(np.stack(times), axis=0)
    return Work(
        times=np.minimum(least, least.T),
        out=np.stack(out),
        home=np.stack(home),
        places=places,
        photo=min(photo),
        usable=max(usable),
        swap=min(swap),
    )


def lower_bound(work: Work, most_sorties: int) -> float:
    """The bound in s; `most_sorties`: up to so many are examined with weights, more without."""
    n = work.out.shape[1]
    farthest = float((work.out.min(axis=0) + work.home.min(axis=0)).max() + work.photo)
    totals = _plain_totals(work)
    can = totals <= np.arange(1, n + 1) * work.usable * (1 + 1e-9)
    bounds = {s: _plain(work, totals, s) for s in range(1, n + 1) if can[s - 1]}
    best = max(farthest, min(bounds.values(), default=0.0))
    alone = _Needs(sets=np.zeros((0, n)), needed=np.zeros(0), last=best)
    for s in [s for s in bounds if s <= most_sorties]:
        bounds[s] = max(bounds[s], _weighted(work, totals, s, alone))
    best = max(best, min(bounds.values(), default=0.0))
    if n > MOST_CUT or not bounds:
        return best
    sets = _sets(work, most_sorties)
    last = best * LATER
    for _ in range(TRIES):
        found = math.inf
        for s, bound in bounds.items():
            if bound < min(found, last) and s <= most_sorties:
                needs = sets.needs(min(last, work.usable), s, last)
                bound = max(bound, _weighted(work, totals, s, needs))
            found = min(found, bound)
        # a plan ends after `last`, or not before what was found for plans that do not
        best = max(best, min(found, last))
        if found < last:
            break
        last = found
    return best


def _plain_totals(work: Work) -> Array:
    """Least flying time (n,) of 1 to n sorties, without weights."""
    n = work.out.shape[1]
    edges = np.sort(_tree(work.times)[1])[::-1]
    saved = np.concatenate([[0.0], np.cumsum(edges)])
    out, home = work.out.min(axis=0), work.home.min(axis=0)
    legs = np.cumsum(np.sort(out)) + np.cumsum(np.sort(home))
    return np.asarray(edges.sum() - saved + legs + n * work.photo)


def _plain(work: Work, totals: Array, sorties: int) -> float:
    return _shared(work, float(totals[sorties - 1]), sorties, min(work.drones, sorties))


def _shared(work: Work, total: float, sorties: int, drones: int) -> float:
    """Flying and swaps spread evenly over the drones that fly."""
    return (total + (sorties - drones) * work.swap) / drones


@dataclass(frozen=True, kw_only=True, eq=False)
class _Needs:
    """Sets of points, and how often sorties must visit them."""

    sets: Array
    """(m, n) 1 where a set holds a point."""
    needed: Array
    """(m,) sorties needed."""
    last: float
    """In plans that end then or before, s; only the steps depend on it otherwise."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sets:
    """Sets of points and the work in them."""

    inside: NDArray[np.bool_]
    """(m, n) which points."""
    each: Array
    """(m, k) least time of each sortie where 1 to k of them share a set."""

    def needs(self, longest: float, sorties: int, last: float) -> _Needs:
        """Sets that sorties of at most `longest` cannot visit once only, with the sorties needed;
        more than there are change nothing.
        """
        needed = 1 + (self.each[:, : sorties - 1] > longest * (1 + 1e-9)).sum(axis=1)
        use = needed > 1
        sets = self.inside[use].astype(np.float64)
        return _Needs(sets=sets, needed=needed[use].astype(np.float64), last=last)


def _sets(work: Work, most_sorties: int) -> _Sets:
    """Both sides of lines, what is farther from the start than others, and all points."""
    out, home = work.out.min(axis=0), work.home.min(axis=0)
    inside = [np.ones(len(out), np.bool_)]
    shares = np.linspace(0, 1, PLACES + 2)[1:-1]
    for angle in np.arange(DIRECTIONS) * np.pi / DIRECTIONS:
        along = work.places @ np.array([np.cos(angle), np.sin(angle)])
        for limit in np.quantile(along, shares):
            inside += [along > limit, along <= limit]
    inside += [out > limit for limit in np.quantile(out, shares)]
    inside = [i for i in inside if i.any()]
    # a sortie without its other points is no longer only where no detour is a short cut
    times = shortest_path(work.times, method="FW")
    out, home = ((times + legs[:, None]).min(axis=0) for legs in (out, home))
    each = np.zeros((len(inside), most_sorties))
    for row, points in zip(each, inside, strict=True):
        index = np.flatnonzero(points)
        edges = np.sort(_tree(times[np.ix_(index, index)])[1])[::-1]
        legs = np.cumsum(np.sort(out[index])) + np.cumsum(np.sort(home[index]))
        for k in range(1, min(most_sorties, len(index)) + 1):
            whole = edges[k - 1 :].sum() + legs[k - 1] + len(index) * work.photo
            row[k - 1] = whole / k
    return _Sets(inside=np.array(inside), each=each)


def _weighted(work: Work, totals: Array, sorties: int, needs: _Needs) -> float:
    """The bound of S sorties under the best weights that are found."""
    n, drones = work.out.shape[1], min(work.drones, sorties)
    photos = n * work.photo
    wanted = drones * AIM * needs.last - (sorties - drones) * work.swap - photos
    best, share, since = -math.inf, 1.0, 0
    weight, slope = np.zeros(n), np.zeros(n)
    toll, rise = np.zeros(len(needs.sets)), np.zeros(len(needs.sets))
    for _ in range(int(np.clip(ROUNDS * 300 / n, 15, ROUNDS))):
        value, degree, crossed = _relaxed(work, weight, toll, sorties, needs)
        since = 0 if value > best + 1e-6 else since + 1
        share *= 0.8 if since and since % PATIENCE == 0 else 1.0
        best = max(best, value)
        short = needs.needed * 2 - crossed
        slope = 0.7 * (degree - 2) + 0.3 * slope
        rise = 0.7 * np.where((toll <= 0) & (short < 0), 0, short) + 0.3 * rise
        size = float(slope @ slope + rise @ rise)
        if size == 0:
            break
        step = share * max(1.02 * max(wanted, best) - value, 1e-3 * abs(value)) / size
        weight, toll = weight + step * slope, np.maximum(toll + step * rise, 0)
    found = _shared(work, best + photos, sorties, drones)
    if 1 < drones <= sorties and drones == work.drones:
        # one of the drones may stay on the ground, and the others fly more sorties
        found = min(found, _shared(work, float(totals[sorties - 1]), sorties, drones - 1))
    return found


def _relaxed(
    work: Work, weight: Array, toll: Array, sorties: int, needs: _Needs
) -> tuple[float, Array, Array]:
    """The least forest with first and last legs under weights and tolls, the legs at each point and
    those that cross the border of each set.
    """
    n, sets = len(weight), needs.sets
    inside = toll @ sets
    shifted = work.times + (weight - inside)[:, None] + (weight - inside)[None, :]
    used = toll > 0
    shifted += 2 * (sets[used].T * toll[used]) @ sets[used]
    pairs, lengths = _tree(shifted)
    keep = np.argsort(lengths)[: n - sorties]
    value = float(lengths[keep].sum() - 2 * weight.sum() + 2 * needs.needed @ toll)
    degree = np.bincount(pairs[keep].ravel(), minlength=n).astype(np.float64)
    crossed = (sets[:, pairs[keep, 0]] != sets[:, pairs[keep, 1]]).sum(axis=1)
    for legs in (work.out, work.home):
        points, cost = _legs(legs + weight - inside, sorties)
        value += cost
        np.add.at(degree, points, 1)
        crossed = crossed + sets[:, points].sum(axis=1)
    return value, degree, crossed


def _legs(times: Array, sorties: int) -> tuple[NDArray[np.int64], float]:
    """The points of the cheapest legs (K, n) from or to the ground, and their sum: one of each
    drone where there are enough sorties, the rest of any.
    """
    least = times.min(axis=0)
    own = times.argmin(axis=1) if sorties >= len(times) else np.zeros(0, np.int64)
    rest = sorties - len(own)
    more = np.full(rest, least.argmin()) if len(own) else np.argsort(least)[:rest]
    cost = float(times.min(axis=1).sum()) if len(own) else 0.0
    return np.concatenate([own, more]).astype(np.int64), cost + float(least[more].sum())


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
