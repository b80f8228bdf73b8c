"""Least squares of differences: what photos must change by to agree on the ground they share."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.block_cholesky import Factor, Matrix, Pattern, pattern

SETTLED = 1e-3
"""A change of log odds that is not visible in 8-bit values; ends the iteration."""
SIGMA_LEVEL = 0.15
"""Standard deviation in log odds of the difference in brightness of one ground point between two
photos with the same exposure.
"""
WIDE = 0.25
"""Residual in log odds at which a sample counts half."""
CLOSE, LEAST = 2.0, 0.01
"""The same where samples weigh by their own scatter: in medians of the residuals, and at least."""
STEPS, CLOSE_STEPS = 6, 14
"""Steps of reweighting, at most."""
AT_ONCE = 65_536
"""Samples whose products are summed at once, in double precision."""
CORRELATED = 30.0
"""Errors of neighbouring samples are correlated: this number of samples counts as one independent
sample.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pairs:
    """All pairs of samples of one point, a sample with itself included, sorted by their photos."""

    row: NDArray[np.integer[Any]]
    """(N,) photo of each sample."""
    point: NDArray[np.integer[Any]]
    """(N,) point of each sample."""
    where: NDArray[np.float64]
    """(n, 2) where the photos lie."""
    a: NDArray[np.int32]
    """(M,) first sample."""
    b: NDArray[np.int32]
    """(M,) second sample; its photo is not before the first's."""
    cuts: NDArray[np.int64]
    """(G + 1,) start of the pairs of each two photos."""
    row_a: NDArray[np.int64]
    """(G,) first photo."""
    row_b: NDArray[np.int64]
    """(G,) second photo."""
    patterns: dict[int, Pattern] = field(default_factory=dict)
    """Photos as they are eliminated, by the number of unknowns of each."""

    @classmethod
    def of(cls, row: NDArray[Any], point: NDArray[Any], where: NDArray[np.float64]) -> "Pairs":
        """The pairs of samples (N,), whose rows and points are given."""
        order = np.lexsort((row, point)).astype(np.int32)
        a, b = [], []
        for lag in range(int(np.bincount(point).max(initial=0))):
            same = np.flatnonzero(point[order[lag:]] == point[order[: len(order) - lag]])
            a.append(order[same])
            b.append(order[same + lag])
        first, second = np.concatenate(a), np.concatenate(b)
        del a, b, order
        narrow = np.int32 if len(where) ** 2 < 2**31 else np.int64
        photos: NDArray[Any] = row[first].astype(narrow)
        photos *= len(where)
        photos += row[second]
        sort = np.argsort(photos, kind="stable")
        first, second, photos = first[sort], second[sort], photos[sort]
        del sort
        cuts = np.r_[0, np.flatnonzero(np.diff(photos)) + 1, len(first)]
        return cls(
            row=row,
            point=point,
            where=where,
            a=first,
            b=second,
            cuts=cuts,
            row_a=row[first[cuts[:-1]]].astype(np.int64),
            row_b=row[second[cuts[:-1]]].astype(np.int64),
        )

    def products(self, terms: NDArray[Any]) -> NDArray[np.float64]:
        """(G, k, k) sums of the outer products of terms (N, k) over the pairs of two photos."""
        if terms.shape[1] == 1:
            both = terms[self.a, 0]
            both *= terms[self.b, 0]
            return np.asarray(np.add.reduceat(both, self.cuts[:-1], dtype=float)[:, None, None])
        ends = zip(self.cuts[:-1].tolist(), self.cuts[1:].tolist(), strict=True)
        return np.stack([terms[self.a[i:j]].T @ terms[self.b[i:j]] for i, j in ends])


def robust_differences(
    terms: NDArray[Any],
    pairs: Pairs,
    y: NDArray[Any],
    ridge: NDArray[Any],
    *,
    closely: bool = False,
) -> NDArray[np.float64]:
    """x (n, k, bands) that makes y + terms . x[row] equal within each point, y (N, bands) and
    terms (N, k), with robust weights common to all bands, against moving objects and shadows.
    `ridge` (k,): weight of the prior of zero for x; `closely`: samples weigh by their own scatter,
    see `Balance`.
    """
    row, point, count = pairs.row, pairs.point, len(pairs.where)
    w = np.ones(len(y), terms.dtype)
    x: NDArray[np.float64] = np.zeros((count, terms.shape[1], y.shape[1]))
    pull = np.tile(ridge * SIGMA_LEVEL**2 * CORRELATED, count)
    several = np.bincount(point)[point] > 1
    for step in range(CLOSE_STEPS if closely else STEPS):
        mass = np.maximum(np.bincount(point, w), 1e-9)
        weighted = w[:, None] * terms
        blocks = pairs.products(weighted / np.sqrt(mass).astype(w.dtype)[point][:, None])
        off = y - _means(point, w, y, mass)[point]
        rhs = -np.stack([_sums(row, column[:, None] * off, count) for column in weighted.T], 1)
        own = np.empty((count, terms.shape[1], terms.shape[1]))
        for i in range(terms.shape[1]):
            for j in range(i + 1):
                own[:, i, j] = own[:, j, i] = np.bincount(row, weighted[:, i] * terms[:, j], count)
        before, x = (
            x,
            _solved(own, pairs, blocks, pull, rhs.reshape(len(pull), -1)).reshape(x.shape),
        )
        if np.abs(x - before).max() < SETTLED:
            break
        level = y.copy()
        for k, column in enumerate(terms.T):
            level += column[:, None] * x[:, k].astype(y.dtype)[row]
        level -= _means(point, w, level, mass)[point]
        away = np.sqrt((level**2).mean(1))
        w = 1 / (1 + (away / _scale(away[several], closely and step > 0, WIDE)) ** 2)
    return x


def _means(
    point: NDArray[Any], w: NDArray[Any], values: NDArray[Any], mass: NDArray[np.float64]
) -> NDArray[Any]:
    """(points, bands) weighted means of values (N, bands) by point, of sums of weights `mass`."""
    total = _sums(point, w[:, None] * values, len(mass)) / mass[:, None]
    return np.asarray(total.astype(values.dtype))


def _scale(off: NDArray[Any], closely: bool, widest: float) -> float:
    """Residual at which a sample counts half, of residuals (N,)."""
    return float(np.clip(CLOSE * np.median(off), LEAST, widest)) if closely and len(off) else widest


def within_points(
    terms: NDArray[Any],
    y: NDArray[Any],
    point: NDArray[Any],
    pull: NDArray[Any],
    *,
    closely: bool = False,
) -> NDArray[np.float64]:
    """x (k,) that makes y + terms . x equal within each point, y (N,) and terms (N, k), with robust
    weights; `pull` (k, k): weight of the prior of zero; `closely`: as for `robust_differences`.
    """
    w, x = np.ones(len(y), terms.dtype), np.zeros(terms.shape[1])
    count = int(point.max()) + 1
    several = np.bincount(point)[point] > 1
    for step in range(CLOSE_STEPS if closely else STEPS - 1):
        mass = np.maximum(np.bincount(point, w, count), 1e-9)
        apart = terms - _means(point, w, terms, mass)[point]
        off = y - _means(point, w, y[:, None], mass)[point, 0]
        normal, right = pull.copy(), np.zeros(len(x))
        for some in (slice(k, k + AT_ONCE) for k in range(0, len(y), AT_ONCE)):
            own = apart[some].astype(np.float64)
            normal += own.T @ (w[some, None] * own)
            right += own.T @ (w[some] * off[some])
        x = -np.linalg.solve(normal, right)
        rest = off + apart @ x.astype(off.dtype)
        scale = _scale(np.abs(rest[several]), closely and step > 0, SIGMA_LEVEL)
        w = 1 / (1 + (rest / scale) ** 2)
    return np.asarray(x)


def _sums(group: NDArray[Any], values: NDArray[Any], count: int) -> NDArray[np.float64]:
    """(count, ...) sums of values (N, ...) by group (N,)."""
    flat = values.reshape(len(values), -1)
    total = [np.bincount(group, column, count) for column in flat.T]
    return np.asarray(np.stack(total, 1).reshape(count, *values.shape[1:]), np.float64)


def _solved(
    own: NDArray[Any], pairs: Pairs, blocks: NDArray[Any], pull: NDArray[Any], rhs: NDArray[Any]
) -> NDArray[Any]:
    """Solution (n k, bands) of the normal equations: own blocks (n, k, k) minus those of pairs,
    with a prior of zero.
    """
    n, k, _ = own.shape
    if k not in pairs.patterns:
        pairs.patterns[k] = pattern(pairs.where, k, 0, pairs.row_a, pairs.row_b)
    coupled = pairs.patterns[k]
    values = np.zeros((len(coupled.first), k, k))
    values[coupled.find(pairs.row_a, pairs.row_b)] = -blocks
    each = np.arange(n)
    values[coupled.find(each, each)] += own + np.eye(k) * pull.reshape(n, 1, k)
    empty = np.zeros((n, k, 0)), np.zeros((0, 0))
    matrix = Matrix(pattern=coupled, blocks=values, beside=empty[0], corner=empty[1])
    return Factor(matrix).solve(rhs)
