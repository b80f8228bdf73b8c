"""Normal equations of an adjustment, with the points eliminated (Schur complement).

Observations are taken in parts of whole points: what a part says of photos and cameras is added to
one sparse matrix, and then forgotten. So memory holds the matrix, not the equations.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.problem import CAMERA, Problem, State, linearise
from skyquilt.alignment.robust import observation_weights, point_terms, position_terms, prior_terms
from skyquilt.geometry.block_cholesky import LEAF, Factor, Index, Matrix, pattern

Array = NDArray[np.float64]
KEPT = 600_000
"""Observations whose points are kept tied to photos and cameras (0.25 kB each) between the step of
these and that of the points; those of larger problems are computed again.
"""
ELIMINATED = 160
"""Observations whose points are eliminated at once, about: few enough to be of few photos."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Normal:
    """What a part's observations say, split for the Schur complement: photos and cameras (u),
    points (v).

    A photo has p = 6 unknowns, or 9 with its turn; a camera q = 10, or none where all are fixed.
    """

    seen: Index
    """(s,) the photos of the part."""
    row: Index
    """(N,) place of each observation's photo among these."""
    U: Array
    """(s, p, p) photo blocks."""
    Uc: Array
    """(m, q, q) camera blocks."""
    Upc: Array
    """(s, p, q) photo-camera blocks."""
    V: Array
    """(P, 3, 3) point blocks, with the points' priors."""
    Wp: Array
    """(N, p, 3) photo-point block of each observation."""
    Wc: Array
    """(N, q, 3) camera-point block of each observation."""
    gp: Array
    """(s, p) gradient."""
    gc: Array
    """(m, q) gradient."""
    gv: Array
    """(P, 3) gradient, with the points' priors."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointTies:
    """What the step of a part's points needs of its equations, given that of photos and cameras.

    In single precision: the points are polished after the step.
    """

    V: Array
    """(P, 3, 3) point blocks."""
    gv: Array
    """(P, 3) gradient."""
    Wp: NDArray[np.float32]
    """(N, p, 3) photo-point blocks."""
    Wc: NDArray[np.float32]
    """(N, q, 3) camera-point blocks."""


def _ties_of(normal: Normal) -> PointTies:
    return PointTies(
        V=normal.V, gv=normal.gv, Wp=normal.Wp.astype(np.float32), Wc=normal.Wc.astype(np.float32)
    )


def sums_by_point(problem: Problem, values: Array, count: int) -> Array:
    """Sums of values (N, ...) of each point's observations: (count, ...). Observations are sorted
    by point.
    """
    flat = values.reshape(len(values), -1)
    starts = np.searchsorted(problem.point, np.arange(count))
    total = np.add.reduceat(flat, np.minimum(starts, len(flat) - 1), axis=0)
    total[np.diff(np.r_[starts, len(flat)]) == 0] = 0
    return total.reshape(count, *values.shape[1:])


def _by_photo(row: Index, count: int, rows: Array) -> Array:
    """Products A^T A (count, k, k) of each photo's rows A; rows (N, 2, k)."""
    order = np.argsort(row, kind="stable")
    cuts = np.searchsorted(row[order], np.arange(count + 1))
    sorted_rows = rows[order].reshape(-1, rows.shape[2])
    out = np.empty((count, rows.shape[2], rows.shape[2]))
    for i in range(count):
        own = sorted_rows[2 * cuts[i] : 2 * cuts[i + 1]]
        out[i] = own.T @ own
    return out


def add_diagonal(blocks: Array, values: Array) -> None:
    """Adds values (n, k) to the diagonals of blocks (n, k, k)."""
    k = np.arange(values.shape[1])
    blocks[:, k, k] += values


def observation_equations(problem: Problem, state: State) -> Normal:
    """Normal equations of the reweighted observations at a state, with the priors on points."""
    lin = linearise(problem, state)
    weight, _ = observation_weights(problem, lin.residual)
    root = np.sqrt(weight)[:, None, None]
    e, J_point = lin.residual[..., None] * root, lin.J_point * root
    rows = np.concatenate([lin.J_photo, lin.J_camera, lin.residual[..., None]], 2) * root
    m, count, q = len(state.K), len(state.X), lin.J_camera.shape[2]
    k = problem.photo_unknowns
    seen, row = np.unique(problem.photo, return_inverse=True)
    by_photo = _by_photo(row, len(seen), rows)
    by_camera = np.zeros((m, q, q + 1))
    np.add.at(by_camera, problem.camera[seen], by_photo[:, k : k + q, k:])
    point_rows = np.concatenate([J_point, e], 2)
    by_point = sums_by_point(problem, np.swapaxes(J_point, 1, 2) @ point_rows, count)
    W = np.swapaxes(rows[:, :, :-1], 1, 2) @ J_point
    precision, apart = point_terms(problem, state)
    V = by_point[:, :, :3].copy()
    add_diagonal(V, precision)
    return Normal(
        seen=seen,
        row=row,
        U=by_photo[:, :k, :k],
        Uc=by_camera[:, :, :q],
        Upc=by_photo[:, :k, k : k + q],
        V=V,
        Wp=W[:, :k],
        Wc=W[:, k:],
        gp=by_photo[:, :k, -1],
        gc=by_camera[:, :, q],
        gv=by_point[:, :, 3] + precision * apart,
    )


def _together(problem: Problem) -> tuple[Index, Index]:
    """Pairs of photos (a < b) that share a point."""
    n = len(problem.camera)
    if n <= LEAF:  # eliminated at once: all count as coupled
        return np.triu_indices(n, 1)
    keys = np.zeros(0, np.int64)
    step, alive = 1, np.arange(len(problem.point) - 1)
    while True:
        alive = alive[alive + step < len(problem.point)]
        alive = alive[problem.point[alive] == problem.point[alive + step]]
        if not len(alive):
            return keys // n, keys % n
        ends = np.sort([problem.photo[alive], problem.photo[alive + step]], axis=0)
        keys = np.union1d(keys, ends[0] * n + ends[1])
        step += 1


class Equations:
    """The equations of one problem, at any state: which photos are coupled is found once."""

    def __init__(self, problem: Problem, state: State) -> None:
        self.problem = problem
        self.n, self.m = len(state.C), len(state.K)
        self.p = problem.photo_unknowns
        self.q = CAMERA if problem.free.any() else 0
        border = self.q * self.m + (3 if problem.offset else 0)
        self.pattern = pattern(state.C[:, :2], self.p, border, *_together(problem))
        self._ties: list[tuple[Problem, PointTies]] = []

    def normals(self, state: State) -> Iterator[tuple[Problem, Normal]]:
        """The equations of each part of the observations."""
        for part, own, _ in self.problem.parts(state):
            yield part, observation_equations(part, own)

    def _point_ties(self, state: State) -> Iterator[tuple[Problem, PointTies]]:
        """Those of the points of each part, kept since `reduced` unless the problem is large."""
        if len(self.problem.px) <= KEPT:
            yield from self._ties
        else:
            yield from ((part, _ties_of(normal)) for part, normal in self.normals(state))

    def step(self, state: State, damping: float) -> tuple[Array, Array, Array]:
        """The Gauss-Newton step of photos (n, p), cameras (m, 10) and points (P, 3).

        Raises:
            LinAlgError: it goes nowhere.
        """
        matrix, gradient = self.reduced(state, damping)
        du = -Factor(matrix).solve(gradient)
        photos = self.p * self.n
        cameras = np.zeros((self.m, CAMERA))
        if self.q:
            cameras = du[photos : photos + CAMERA * self.m].reshape(-1, CAMERA)
        placed = du[:photos].reshape(-1, self.p)
        points = np.concatenate(
            [
                _points_step(part, ties, damping, placed, cameras)
                for part, ties in self._point_ties(state)
            ]
        )
        return placed, cameras, points

    def reduced(self, state: State, damping: float) -> tuple[Matrix, Array]:
        """The Schur complement on photos and cameras, damped, and the gradient (photos, then
        cameras, then the common shift of measured positions, if there is one).
        """
        n, m, p, q, pat = self.n, self.m, self.p, self.q, self.pattern
        priors = prior_terms(self.problem, state)
        U, Uc = np.zeros((n, p, p)), np.zeros((m, q, q))
        out = Matrix(
            pattern=pat,
            blocks=np.zeros((len(pat.first), p, p)),
            beside=np.zeros((n, p, pat.border)),
            corner=np.zeros((pat.border, pat.border)),
        )
        g, gc = priors.photo_gradient[:, :p].copy(), np.zeros(pat.border)
        gc[: q * m] = priors.camera_gradient[:, :q].ravel()
        self._ties.clear()
        for part, normal in self.normals(state):
            if len(self.problem.px) <= KEPT:
                self._ties.append((part, _ties_of(normal)))
            U[normal.seen] += normal.U
            Uc += normal.Uc
            cameras = part.camera[normal.seen]
            if q:
                columns = q * cameras[:, None] + np.arange(q)
                rows = np.arange(p)[None, :, None]
                out.beside[normal.seen[:, None, None], rows, columns[:, None]] += normal.Upc
                gc[: q * m] += normal.gc.ravel()
            g[normal.seen] += normal.gp
            _eliminate_points(part, normal, damping, out, g, gc)
        add_diagonal(U, priors.photo[:, :p])
        add_diagonal(Uc, np.where(self.problem.free, priors.camera, 1.0)[:, :q])
        add_diagonal(U, np.diagonal(U, axis1=1, axis2=2) * damping + 1e-9)
        add_diagonal(Uc, np.diagonal(Uc, axis1=1, axis2=2) * damping)
        own = np.arange(n)
        out.blocks[pat.find(own, own)] += U
        for j in range(m if q else 0):
            out.corner[q * j : q * j + q, q * j : q * j + q] += Uc[j]
        if self.problem.offset:
            self._share_shift(out, state)
        return out, np.concatenate([g.ravel(), gc])

    def _share_shift(self, out: Matrix, state: State) -> None:
        """Couples the measured centres with their common shift, which is at its minimum already."""
        _, precision, _ = position_terms(self.problem, state)
        for axis in range(3):
            at = self.q * self.m + axis
            out.beside[:, 3 + axis, at] = -precision[:, axis]
            total = float(precision[:, axis].sum())
            out.corner[at, at] = total if total > 0 else 1.0


def _points_inverse(blocks: Array, damping: float) -> Array:
    """L^-1 (P, 3, 3) of the damped point blocks L L^T."""
    V = blocks.copy()
    k = np.arange(3)
    V[:, k, k] = V[:, k, k] * (1 + damping) + 1e-12
    return np.asarray(np.linalg.inv(np.linalg.cholesky(V)))


def _points_step(
    part: Problem, ties: PointTies, damping: float, photos: Array, cameras: Array
) -> Array:
    """The step (P, 3) of a part's points with that of photos (n, p) and cameras (m, 10)."""
    coupled = np.einsum("nij,ni->nj", ties.Wp, photos[part.photo])
    if ties.Wc.shape[1]:
        coupled += np.einsum("nij,ni->nj", ties.Wc, cameras[part.camera[part.photo]])
    L_inv = _points_inverse(ties.V, damping)
    rhs = ties.gv + sums_by_point(part, coupled, len(ties.V))
    half = np.einsum("pij,pj->pi", L_inv, rhs)
    return np.asarray(-np.einsum("pji,pj->pi", L_inv, half))


def _eliminate_points(
    part: Problem, normal: Normal, damping: float, out: Matrix, g: Array, gc: Array
) -> None:
    """Takes what the points of a part tie together from matrix and gradients, in place."""
    L_inv = _points_inverse(normal.V, damping)
    z = np.einsum("pij,pj->pi", L_inv, normal.gv)
    p, q = normal.Wp.shape[1], normal.Wc.shape[1]
    for lo, hi in pairwise(part.cuts(ELIMINATED)):
        point, row = part.point[lo:hi], normal.row[lo:hi]
        first, last = int(point[0]), int(point[-1]) + 1
        some, local = np.unique(row, return_inverse=True)
        seen = normal.seen[some]
        cams, cam_of = np.unique(part.camera[seen], return_inverse=True)
        T = np.swapaxes(L_inv[point], 1, 2)
        s, c = len(seen), len(cams) if q else 0
        rows = np.zeros((p * s + q * c, last - first, 3))
        photos = rows[: p * s].reshape(s, p, last - first, 3)
        photos[local, :, point - first] = normal.Wp[lo:hi] @ T
        columns = (q * cams[:, None] + np.arange(q)).ravel()
        if q:
            cameras = rows[p * s :].reshape(c, q, last - first, 3)
            place: Any = (cam_of[local], slice(None), point - first)
            np.add.at(cameras, place, normal.Wc[lo:hi] @ T)
        flat = rows.reshape(len(rows), -1)
        product, pull = flat @ flat.T, flat @ z[first:last].ravel()
        i, j = np.triu_indices(s)
        pair = out.pattern.find(seen[i], seen[j])
        tied = pair >= 0  # photos that share no point have nothing in common here, either
        blocks = product[: p * s, : p * s].reshape(s, p, s, p)[i[tied], :, j[tied]]
        out.blocks[pair[tied]] -= blocks
        g[seen] -= pull[: p * s].reshape(s, p)
        if q:
            beside = product[: p * s, p * s :].reshape(s, p, -1)
            out.beside[seen[:, None, None], np.arange(p)[None, :, None], columns] -= beside
            out.corner[columns[:, None], columns] -= product[p * s :, p * s :]
            gc[columns] -= pull[p * s :]
