"""What a part of the observations says of photos and cameras, its points eliminated."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.problem import Linearised, Problem, State, linearise, linearised_points
from skyquilt.alignment.robust import add_diagonal, observation_weights, observed_cost, point_terms
from skyquilt.geometry.block_cholesky import Index

Array = NDArray[np.float64]
ELIMINATED = 320
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
class Reduced:
    """What a part's observations say of photos and cameras, its points eliminated. The unknowns of
    its s photos come first, then those of all m cameras.
    """

    seen: Index
    """(s,) the photos."""
    U: Array
    """(s, p, p) photo blocks."""
    Uc: Array
    """(m, q, q) camera blocks."""
    pair: Index
    """(2, k) pairs of photos, each also with itself, by their places in `seen`, the first not after
    the second: all that share a point, and some that do not.
    """
    tied: Array
    """(k, p, p) what the points tie together of each pair, subtracted."""
    beside: Array
    """(s, p, q m) the same of photos with cameras, and what observations say of both."""
    corner: Array
    """(q m, q m) the same of cameras."""
    gradient: Array
    """(p s + q m,) gradient."""


def numbered(values: Index, count: int) -> tuple[Index, Index]:
    """The different ones of some numbers (n,) below `count`, ascending, and the place of each among
    them, as `numpy.unique` gives them, but without sorting.
    """
    there = np.zeros(count, np.bool_)
    there[values] = True
    return np.flatnonzero(there), (np.cumsum(there) - 1)[values]


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


def observation_equations(
    problem: Problem, state: State, linear: Linearised | None = None
) -> Normal:
    """Normal equations of the reweighted observations at a state, with the priors on points.
    `linear`: the observations there, if that is known.
    """
    lin = linear or linearise(problem, state)
    weight, _ = observation_weights(problem, lin.residual)
    root = np.sqrt(weight)[:, None, None]
    e, J_point = lin.residual[..., None] * root, lin.J_point * root
    rows = np.concatenate([lin.J_photo, lin.J_camera, lin.residual[..., None]], 2) * root
    m, count, q = len(state.K), len(state.X), lin.J_camera.shape[2]
    k = problem.photo_unknowns
    seen, row = numbered(problem.photo, len(problem.camera))
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


def points_inverse(blocks: Array, damping: float) -> Array:
    """L^-1 (P, 3, 3) of the damped point blocks L L^T, written out: a library's loop over so many
    small matrices takes ten times as long.

    Raises:
        LinAlgError: a block is not positive definite.
    """
    (a, b, c), (d, e, f) = (
        (blocks[:, k, k] * (1 + damping) + 1e-12 for k in range(3)),
        (blocks[:, 1, 0], blocks[:, 2, 0], blocks[:, 2, 1]),
    )
    out = np.zeros_like(blocks)
    with np.errstate(all="ignore"):
        l11 = np.sqrt(a)
        l21, l31 = d / l11, e / l11
        l22 = np.sqrt(b - l21 * l21)
        l32 = (f - l31 * l21) / l22
        l33 = np.sqrt(c - l31 * l31 - l32 * l32)
        out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = 1 / l11, 1 / l22, 1 / l33
        out[:, 1, 0] = -l21 * out[:, 0, 0] * out[:, 1, 1]
        out[:, 2, 1] = -l32 * out[:, 1, 1] * out[:, 2, 2]
        out[:, 2, 0] = -(l31 * out[:, 0, 0] + l32 * out[:, 1, 0]) * out[:, 2, 2]
    if not np.isfinite(out).all():
        raise np.linalg.LinAlgError("a point is not determined")
    return out


def points_solved(
    problem: Problem, state: State, rows: Array, weight: Array, damping: float
) -> Array:
    """The step (P, 3) of points that equations rows (N, 2, 4) ask for: derivatives by the point,
    and residuals. `weight` (N,): of the observations; priors on points count, too.

    Raises:
        LinAlgError: a point is not determined.
    """
    rows = rows * np.sqrt(weight)[:, None, None]
    sums = sums_by_point(problem, np.swapaxes(rows[:, :, :3], 1, 2) @ rows, len(state.X))
    precision, apart = point_terms(problem, state)
    V = sums[:, :, :3]
    add_diagonal(V, precision + 1e-9)
    L_inv = points_inverse(V, damping)
    half = np.einsum("pij,pj->pi", L_inv, sums[:, :, 3] + precision * apart)
    return np.asarray(-np.einsum("pji,pj->pi", L_inv, half))


def points_step(
    part: Problem,
    state: State,
    damping: float,
    photos: Array,
    cameras: Array,
    linear: Linearised | None = None,
) -> Array:
    """The step (P, 3) of a part's points that goes with that of all photos (n, p) and of the
    cameras (m, 11). `linear`: the observations at the state, if that is known.
    """
    lin = linear or linearise(part, state)
    weight, _ = observation_weights(part, lin.residual)
    moved = lin.residual + np.einsum("nij,nj->ni", lin.J_photo, photos[part.photo])
    if lin.J_camera.shape[2]:
        moved += np.einsum("nij,nj->ni", lin.J_camera, cameras[part.camera[part.photo]])
    rows = np.concatenate([lin.J_point, moved[..., None]], 2)
    return points_solved(part, state, rows, weight, damping)


def polish_points(problem: Problem, state: State) -> State:
    """One Gauss-Newton step of the points alone."""
    residual, J_point = linearised_points(problem, state)
    weight, _ = observation_weights(problem, residual)
    rows = np.concatenate([J_point, residual[..., None]], 2)
    return replace(state, X=state.X + points_solved(problem, state, rows, weight, 0.0))


def moved_points(
    part: Problem,
    state: State,
    damping: float,
    photos: Array,
    cameras: Array,
    there: State,
    linear: Linearised | None = None,
) -> tuple[Array, float]:
    """The points (P, 3) of a part after a step, refined under the moved photos and cameras `there`,
    and the robust cost of the part there.
    """
    X = state.X + points_step(part, state, damping, photos, cameras, linear)
    settled = polish_points(part, replace(there, X=X))
    return settled.X, observed_cost(part, settled)


def reduced_part(
    part: Problem, state: State, damping: float, linear: Linearised | None = None
) -> Reduced:
    """The equations of a part of the observations, its points eliminated."""
    normal = observation_equations(part, state, linear)
    L_inv = points_inverse(normal.V, damping)
    z = np.einsum("pij,pj->pi", L_inv, normal.gv)
    (s, p), (m, q) = normal.gp.shape, normal.gc.shape
    camera = part.camera[normal.seen]
    together = np.zeros((s, s), np.bool_)
    tied, beside, corner = np.zeros((s, s, p, p)), np.zeros((s, p, m, q)), np.zeros((m, q, m, q))
    beside[np.arange(s), :, camera] = normal.Upc
    gradient, of_cameras = normal.gp.copy(), normal.gc.copy()
    for lo, hi in pairwise(part.cuts(ELIMINATED)):
        point, row = part.point[lo:hi], normal.row[lo:hi]
        first, last = int(point[0]), int(point[-1]) + 1
        some, local = numbered(row, s)
        cams, cam_of = numbered(camera[some], m)
        T = np.swapaxes(L_inv[point], 1, 2)
        n, c = len(some), len(cams) if q else 0
        rows = np.zeros((p * n + q * c, last - first, 3))
        photos = rows[: p * n].reshape(n, p, last - first, 3)
        photos[local, :, point - first] = normal.Wp[lo:hi] @ T
        if q:
            cameras = rows[p * n :].reshape(c, q, last - first, 3)
            starts = np.flatnonzero(np.r_[True, np.diff(point) != 0])
            coupled = normal.Wc[lo:hi] @ T
            for k in range(c):
                own = coupled if c == 1 else coupled * (cam_of[local] == k)[:, None, None]
                sums = np.add.reduceat(own, starts)
                cameras[k][:, point[starts] - first] = np.swapaxes(sums, 0, 1)
        flat = rows.reshape(len(rows), -1)
        product, step = flat @ flat.T, flat @ z[first:last].ravel()
        together[some[:, None], some] = True
        blocks = product[: p * n, : p * n].reshape(n, p, n, p)
        tied[some[:, None], some] -= np.swapaxes(blocks, 1, 2)
        gradient[some] -= step[: p * n].reshape(n, p)
        for k, cam in enumerate(cams[:c].tolist()):
            at = slice(p * n + q * k, p * n + q * k + q)
            beside[some, :, cam] -= product[: p * n, at].reshape(n, p, q)
            of_cameras[cam] -= step[at]
            corner[cam][:, cams] -= product[at, p * n :].reshape(q, c, q)
    pair = np.stack(np.nonzero(np.triu(together)))
    return Reduced(
        seen=normal.seen,
        U=normal.U,
        Uc=normal.Uc,
        pair=pair,
        tied=tied[pair[0], pair[1]],
        beside=beside.reshape(s, p, m * q),
        corner=corner.reshape(m * q, m * q),
        gradient=np.concatenate([gradient.ravel(), of_cameras.ravel()]),
    )
