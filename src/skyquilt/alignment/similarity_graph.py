"""A first solution for all photos from links alone: every photo is a similarity x = a p + t of the
plane.

p = (x - cx) - i (y - cy) over the focal length (y up), a = height * exp(-i yaw). A linear
least-squares fit of points would reduce its cost by shrinking the map. Therefore scales and angles
are averaged first, and translations are estimated afterwards (B/C of the methods). Positions are
added last, with a robust fit.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.tracks import blocks_of, outwards, spanning_tree

DENSE = 300
"""Largest number of photos for which the normal equations are solved as a full matrix."""
MOST_PAIRED = 1500
"""Points of which all pairs are listed."""
MOST_PAIRS = 600
"""Largest number of pairs of positions tried as a start."""
LEAST_MOVED, FEWEST_MOVED = 0.1, 5
"""Links tell the scale by photos at least so many flying heights apart, and so many at least do."""
AGAINST, TILTED = 6.0, 0.15
"""A link contradicts positions by so many of their deviations, and by a larger share of the flying
height than tilts of eight degrees move a picture by.
"""
WEAK, MOST_AGAINST = 80, 1 / 3
"""False links are weaker than so many matches, and fewer than this share of all."""
TOGETHER = 4
"""So many that join the same two parts are none of chance."""
Complex = NDArray[np.complex128]
Index = NDArray[np.int64]
Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class PlaneLink:
    """A link in normalised image coordinates."""

    a: int
    """Index of the first photo."""
    b: int
    """Index of the second photo."""
    b_S_a: complex
    """p_b = b_S_a p_a + t."""
    p_a: complex
    """Mean of the matched points in a."""
    p_b: complex
    """Mean of the matched points in b."""
    weight: float
    """Weight, e.g. the square root of the number of inliers."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlaneSolution:
    """Similarities of the photos of one block, in units of the block unless georeferenced."""

    members: NDArray[np.int64]
    """Indices of the photos."""
    a: Complex
    """(k,) factors."""
    t: Complex
    """(k,) translations."""
    link_error: Array
    """Misfit of each of the block's links in normalised image units."""


def components(count: int, links: Sequence[PlaneLink]) -> list[NDArray[np.int64]]:
    """Connected groups of photos, largest first (single photos included)."""
    label = blocks_of(count, links)
    groups = [np.flatnonzero(label == g) for g in range(label.max() + 1)]
    return sorted(groups, key=lambda g: (-len(g), int(g[0])))


def _spanning_start(
    members: NDArray[Any], links: Sequence[PlaneLink], index: dict[int, int]
) -> Complex:
    """log a of each member along the strongest spanning tree; root 0."""
    i, j = (
        np.array([index[m] for m in ends], int)
        for ends in ([k.a for k in links], [k.b for k in links])
    )
    step: dict[tuple[int, int], complex] = {}
    for link, a, b in zip(links, i.tolist(), j.tolist(), strict=True):
        step[a, b], step[b, a] = (
            -np.log(link.b_S_a),
            np.log(link.b_S_a),
        )  # log a_b = log a_a - log S
    tree = spanning_tree(
        len(members), i, j, np.array([1.0 / (1e-6 + link.weight) for link in links])
    )
    log_a = np.zeros(len(members), complex)
    for parent, node in outwards(len(members), i, j, tree):
        log_a[node] = log_a[parent] + step[parent, node]
    return log_a


def _solve_differences(
    i: Array, j: Array, d: Complex, w: Array, count: int, anchor: Complex, wa: Array
) -> Complex:
    """Least squares of x_j - x_i = d with weights w and of x = anchor with weights wa (>= 1e-6)."""
    if count <= DENSE:
        return _solve_small(i, j, d, w, count, anchor, wa)
    from scipy import sparse
    from scipy.sparse import linalg as sparse_linalg

    rows = np.arange(len(i))
    B = sparse.csr_matrix((np.r_[w, -w], (np.r_[rows, rows], np.r_[j, i])), (len(i), count))
    normal = (B.T @ B + sparse.diags(wa**2)).tocsc()
    rhs = B.T @ (w * d) + wa**2 * anchor
    # symmetric and positive definite: an order for such matrices, and no pivots
    factor = sparse_linalg.splu(
        normal, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    x = factor.solve(np.column_stack([rhs.real, rhs.imag]))
    return np.asarray(x[:, 0] + 1j * x[:, 1])


def _solve_small(
    i: Array, j: Array, d: Complex, w: Array, count: int, anchor: Complex, wa: Array
) -> Complex:
    """The same with a full matrix: for few photos the overhead of sparse matrices takes fifty times
    as long.
    """
    normal, rhs = np.diag(wa**2), (wa**2 * anchor).astype(complex)
    np.add.at(normal, (np.r_[i, j, i, j], np.r_[i, j, j, i]), np.r_[w**2, w**2, -(w**2), -(w**2)])
    np.add.at(rhs, np.r_[j, i], np.r_[w**2 * d, -(w**2) * d])
    return np.asarray(np.linalg.solve(normal, rhs))


def _robust_differences(
    i: Array,
    j: Array,
    d: Complex,
    weight: Array,
    start: Complex,
    anchor: Complex,
    sigma_anchor: Array,
    unit: float,
    *,
    angular: bool = False,
    convex: bool = False,
) -> Complex:
    """Iteratively reweighted solution; `unit` is the residual at which a link gets half its
    weight. `convex`: residuals count by their length, so there is no false minimum.
    """
    x = start
    for _ in range(15):
        misfit = d - (x[j] - x[i])
        if angular:
            misfit = misfit.real + 1j * ((misfit.imag + np.pi) % (2 * np.pi) - np.pi)
        w = weight / unit * (1 + (np.abs(misfit) / unit) ** 2) ** (-0.25 if convex else -0.5)
        far = np.abs(x - anchor) / sigma_anchor
        wa = 1 / sigma_anchor / np.sqrt(1 + (far / 3) ** 2)
        step = _solve_differences(i, j, misfit, w, len(x), anchor - x, np.maximum(wa, 1e-6))
        x = x + step
        if np.abs(step).max() < 1e-7 * max(1.0, float(np.abs(x).max())):
            break
    return x


def solve_block(members: NDArray[np.int64], links: Sequence[PlaneLink]) -> PlaneSolution:
    """Similarities of one connected block; its first photo has a = 1, t = 0 (units of
    that photo's height).
    """
    index = {int(m): k for k, m in enumerate(members)}
    i = np.array([index[link.a] for link in links], int)
    j = np.array([index[link.b] for link in links], int)
    weight = np.sqrt(np.array([link.weight for link in links]))
    weight /= weight.mean() if len(weight) else 1.0
    none = np.full(len(members), 1e5)
    start = _spanning_start(members, links, index)
    log_s = np.array([-np.log(link.b_S_a) for link in links])
    log_a = _robust_differences(i, j, log_s, weight, start, start, none, 0.03, angular=True)
    a = np.exp(log_a - log_a[0])
    pa, pb = np.array([link.p_a for link in links]), np.array([link.p_b for link in links])
    d = a[i] * pa - a[j] * pb
    zero = np.zeros(len(a), complex)
    t = _robust_differences(i, j, d, weight, zero, zero, none, 0.03, convex=True)
    t = _robust_differences(i, j, d, weight, t, zero, none, 0.03)
    error = np.abs(a[i] * pa + t[i] - a[j] * pb - t[j])
    turn = np.abs(np.array([link.b_S_a for link in links]) * a[j] / a[i] - 1)
    return PlaneSolution(members=members, a=a, t=t - t[0], link_error=np.maximum(error, 0.5 * turn))


def consistent_blocks(
    count: int, plane: dict[tuple[int, int], PlaneLink]
) -> tuple[list[PlaneSolution], set[tuple[int, int]]]:
    """Solutions of the blocks, and the links that agree with them within a tenth of the flying
    height.
    """
    kept = set(plane)
    solutions: list[PlaneSolution] = []
    for _ in range(4):
        links = [plane[key] for key in sorted(kept)]
        groups = [g for g in components(count, links) if len(g) >= 2]
        solutions, bad = [], set()
        for members in groups:
            inside = set(members.tolist())
            own = [k for k in links if k.a in inside]
            solution = solve_block(members, own)
            limit = max(0.1, 4 * float(np.median(solution.link_error)))
            bad |= {(k.a, k.b) for k, e in zip(own, solution.link_error, strict=True) if e > limit}
            solutions.append(solution)
        if not bad:
            break
        kept -= bad
    return solutions, kept


def against_positions(
    links: Sequence[PlaneLink], position: Complex, sigma: Array
) -> list[PlaneLink]:
    """Links by which two photos lie clearly nearer to each other or further apart than by their
    positions (n,) in m with deviations (n,), NaN where unknown; most links tell the scale. None
    where they are many or strong: then positions are wrong; nor those of a photo that has no other
    links: its own position is; nor several that join the same two parts: those of an axis that lies
    beside the middle of the pictures seem displaced.
    """
    apart = np.array([abs(position[k.b] - position[k.a]) for k in links])
    moved = np.array([abs(k.p_a - k.p_b / k.b_S_a) for k in links])
    told = np.isfinite(apart) & (moved > LEAST_MOVED)
    if told.sum() < FEWEST_MOVED:
        return []
    height = float(np.median(apart[told] / moved[told]))
    error = np.array([np.hypot(sigma[k.a], sigma[k.b]) for k in links])
    far = np.abs(height * moved - apart) > np.maximum(AGAINST * error, TILTED * height)
    found = [k for k, against in zip(links, far.tolist(), strict=True) if against]
    many = len(found) >= MOST_AGAINST * len(links) or any(k.weight >= WEAK for k in found)
    if many:
        return []
    rest = [k for k, against in zip(links, far.tolist(), strict=True) if not against]
    part = blocks_of(len(position), rest)
    held = {end for k in rest for end in (k.a, k.b)}
    joined = Counter(frozenset((part[k.a], part[k.b])) for k in found)

    def alone(k: PlaneLink) -> bool:
        parts = frozenset((part[k.a], part[k.b]))
        return len(parts) == 1 or joined[parts] < TOGETHER

    return [k for k in found if k.a in held and k.b in held and alone(k)]


def fit_similarity(
    x: Complex, y: Complex, sigma: Array, *, turn: complex | None = None
) -> tuple[complex, complex, float]:
    """g, c and the robust misfit of y = g x + c; `turn` gives the direction of g if the points do
    not determine it.

    Starts from the two points whose similarity has the least median of squares, so that nearly half
    of the positions may be gross errors.
    """
    g, c = _least_median(x, y)
    if turn is not None:
        g = abs(g) * turn / abs(turn)
        c = _median(y - g * x)
    for _ in range(20):
        e = np.abs(y - g * x - c) / sigma
        w = 1 / sigma**2 / (1 + (e / 3) ** 2)
        xm, ym = (w * x).sum() / w.sum(), (w * y).sum() / w.sum()
        g_new = (w * np.conj(x - xm) * (y - ym)).sum() / (w * np.abs(x - xm) ** 2).sum()
        g = g_new if turn is None else abs(g_new) * turn / abs(turn)
        c = ym - g * xm
    return complex(g), complex(c), float(np.median(np.abs(y - g * x - c)) / 1.18)


def _median(z: Complex) -> complex:
    return complex(np.median(z.real), np.median(z.imag))


def _least_median(x: Complex, y: Complex) -> tuple[complex, complex]:
    """g and c through two of the points, of several hundred pairs the one with the least median of
    squares.
    """
    k, m = _pairs(len(x))
    reach = np.abs(x[k] - x[m])
    if len(k) > MOST_PAIRS:  # pairs far apart are the most informative
        far = np.flatnonzero(reach >= np.median(reach))
        chosen = np.random.default_rng(0).choice(far, min(MOST_PAIRS, len(far)), replace=False)
        k, m, reach = k[chosen], m[chosen], reach[chosen]
    apart = reach > 1e-6
    if not apart.any():
        return 1 + 0j, _median(y - x)
    k, m = k[apart], m[apart]
    g = (y[k] - y[m]) / (x[k] - x[m])
    c = y[k] - g * x[k]
    rank = min(len(x), max(3, len(x) // 2 + 1)) - 1
    middle = np.empty(len(g))
    some = max(1, 65536 // len(x))  # at a time, so that memory stays small
    for lo in range(0, len(g), some):
        off = np.abs(y - g[lo : lo + some, None] * x - c[lo : lo + some, None])
        middle[lo : lo + some] = np.partition(off, rank)[:, rank]
    best = int(np.argmin(middle))
    return complex(g[best]), complex(c[best])


def _pairs(count: int) -> tuple[Index, Index]:
    """Indices k < m of all pairs of so many points; of many points, of some of them."""
    if count <= MOST_PAIRED:
        return np.triu_indices(count, 1)
    drawn = np.random.default_rng(0).integers(0, count, (2, MOST_PAIRED**2 // 2))
    k, m = drawn.min(0), drawn.max(0)
    return k[k < m], m[k < m]


def tie_to_positions(
    solution: PlaneSolution, links: Sequence[PlaneLink], position: Complex, sigma: Array
) -> PlaneSolution:
    """Adjusts a georeferenced solution to links and positions together, which removes the bending
    of strips.

    `position` (k,) in m, NaN where unknown; `sigma` (k,) in m. The standard deviation of links is
    about 2 % of the height.
    """
    index = {int(m): k for k, m in enumerate(solution.members)}
    i = np.array([index[link.a] for link in links], int)
    j = np.array([index[link.b] for link in links], int)
    a = solution.a
    d = np.array([a[index[k.a]] * k.p_a - a[index[k.b]] * k.p_b for k in links])
    height = float(np.median(np.abs(a)))
    weight = np.ones(len(links))
    known = np.isfinite(position)
    anchor = np.where(known, position, solution.t)
    far = np.where(known, sigma, 1e5)
    t = _robust_differences(i, j, d, weight, solution.t, anchor, far, 0.02 * height)
    return PlaneSolution(members=solution.members, a=a, t=t, link_error=solution.link_error)
