"""`image`, search `loop`: the chain, and where it comes back to what it has shown, its closing
error spread over the photos between.

The thesis leaves this to 'heuristic global optimisation' where there is a loop (Yahyanejad 2013,
2.3.4, 4.2). The chain is kept as it is; every photo gets one similarity on top of it. Turns and
scales are solved for first and shifts afterwards, since one solution for both lowers its cost by
shrinking the map.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import spsolve

from skyquilt.model.estimate import NoEstimate
from skyquilt.model.poses import Join
from skyquilt.papers.pieces import centre

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Joined = Callable[[int, int], tuple[Array, Join] | NoEstimate]
APART = 3
"""Fewest steps of the chain between two photos that may close a loop."""
TRIES = 2
"""Photos of an earlier pass that are tried for each photo, the nearest ones."""
REACH = 0.7
"""Two photos are tried if their centres are nearer than this share of the wider one's extent..."""
DRIFT = 0.03
"""...and this share of the way that the chain has gone between them."""
ROUNDS = 5
"""Rounds of reweighting, against wrong closings."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tie:
    """Two photos that show the same place, and where the chain puts it for each."""

    a: int
    """Index of one photo."""
    b: int
    """Index of the other."""
    at_a: complex
    """The place on the plane by photo a."""
    at_b: complex
    """The same place by photo b."""
    ratio: complex
    """Turn and scale there from the plane as a draws it to the plane as b draws it."""


def closed(
    piece: Mapping[int, Array], extent: Mapping[int, Array], join: Joined
) -> tuple[dict[int, Array], list[Join]]:
    """A piece (photo -> plane_H_cam, in order of the chain) with its loops closed, and the joins
    that close them; unchanged without any.

    `extent`: corners (4, 2) of each photo in its undistorted image plane.
    """
    order = list(piece)
    ties: list[Tie] = []
    joins: list[Join] = []
    for a, b in _candidates(piece, extent):
        joined = join(a, b)
        if isinstance(joined, NoEstimate):
            continue
        b_H_a, record = joined
        tie = _tie(a, b, piece[a], piece[b] @ b_H_a, extent[a])
        if 0.5 < abs(tie.ratio) < 2:
            ties.append(tie)
            joins.append(record)
    if not ties:
        return dict(piece), []
    chain = [_tie(b, a, piece[b], piece[b], extent[b]) for a, b in pairwise(order)]
    scale, shift = _solved(order, [*chain, *ties])
    return {i: _matrix(scale[k], shift[k]) @ piece[i] for k, i in enumerate(order)}, joins


def _candidates(piece: Mapping[int, Array], extent: Mapping[int, Array]) -> list[tuple[int, int]]:
    """Pairs (later, earlier) that may overlap although the chain did not compare them."""
    order = list(piece)
    at = np.array([centre(piece[i]) for i in order])
    wide = np.array([np.ptp(_on_plane(piece[i], extent[i]).real) for i in order])
    tall = np.array([np.ptp(_on_plane(piece[i], extent[i]).imag) for i in order])
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(at)))])
    found = []
    for k in range(APART, len(order)):
        far = np.abs(at[k] - at[: k - APART + 1])
        size = np.maximum(np.minimum(wide[k], tall[k]), np.minimum(wide, tall)[: len(far)])
        near = np.flatnonzero(far < REACH * size + DRIFT * (way[k] - way[: len(far)]))
        for j in near[np.argsort(far[near], kind="stable")[:TRIES]]:
            found.append((order[k], order[int(j)]))
    return found


def _on_plane(H: Array, points: Array) -> Complex:
    """Transformed points (n, 2) as x + iy."""
    at = np.c_[points, np.ones(len(points))] @ H.T
    return np.asarray(at[:, 0] / at[:, 2] + 1j * (at[:, 1] / at[:, 2]))


def _tie(a: int, b: int, by_a: Array, by_b: Array, corners: Array) -> Tie:
    """The tie from two drawings of photo a's image plane, its own and that of b: at the middle of
    the photo, with the similarity over its corners.
    """
    one, two = _on_plane(by_a, corners), _on_plane(by_b, corners)
    p, q = one - one.mean(), two - two.mean()
    ratio = complex((q @ p.conj()) / (p @ p.conj()))
    return Tie(a=a, b=b, at_a=complex(one.mean()), at_b=complex(two.mean()), ratio=ratio)


def _solved(order: Sequence[int], ties: Sequence[Tie]) -> tuple[Complex, Complex]:
    """Factors and shifts of each photo's similarity, those of the first 1 and 0: a_b ratio = a_a,
    then a_b at_b + t_b = a_a at_a + t_a.
    """
    index = {photo: k for k, photo in enumerate(order)}
    i = np.array([index[t.a] for t in ties])
    j = np.array([index[t.b] for t in ties])
    logs = _differences(i, j, np.array([-np.log(t.ratio) for t in ties]), len(order))
    a = np.exp(logs)
    apart = [a[k] * t.at_a - a[m] * t.at_b for t, k, m in zip(ties, i, j, strict=True)]
    return a, _differences(i, j, np.array(apart), len(order))


def _differences(i: NDArray[np.int64], j: NDArray[np.int64], d: Complex, count: int) -> Complex:
    """x (count,) with x_j - x_i = d, x_0 = 0, by least squares with Cauchy's weights."""
    rows = np.arange(len(i))
    A = csr_matrix(
        (np.r_[np.ones(len(i)), -np.ones(len(i))], (np.r_[rows, rows], np.r_[j, i])),
        shape=(len(i), count),
    )[:, 1:]
    weight, x = np.ones(len(i)), np.zeros(count - 1, complex)
    for _ in range(ROUNDS):
        W = diags(weight)
        x = np.asarray(spsolve((A.T @ W @ A).tocsc(), A.T @ (weight * d)))
        left = np.abs(A @ x - d)
        weight = 1 / (1 + (left / (3 * np.median(left) + 1e-12)) ** 2)
    return np.asarray(np.r_[0.0 + 0j, x], np.complex128)


def _matrix(a: complex, t: complex) -> Array:
    """z -> a z + t as a matrix (3, 3)."""
    return np.array([[a.real, -a.imag, t.real], [a.imag, a.real, t.imag], [0, 0, 1.0]])
