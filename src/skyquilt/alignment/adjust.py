"""Bundle adjustment: Levenberg-Marquardt on the Schur complement, with priors on all unknowns for
which one is known.

Robust losses are iteratively reweighted (Cauchy). Why no library is used: see docs/decisions.md.
The wheel of pycolmap offers priors on positions only; a flight strip without loops also needs
priors on tilt and on every intrinsic. The tests compare this code with pycolmap's Ceres on problems
that both can express.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.problem import (
    CAMERA,
    Problem,
    State,
    attitude_error,
    linearise,
    linearised_points,
    residuals_px,
)
from skyquilt.geometry.levenberg_marquardt import levenberg_marquardt

if TYPE_CHECKING:
    from scipy import sparse

Array = NDArray[np.float64]
SMALL = 500
"""Largest number of unknowns solved by NumPy. SciPy's solver needs half the time, but loading it
takes longer than it saves on small problems.
"""
DENSE_LIMIT = 4000
"""Largest number of unknowns of the reduced system for which dense Cholesky is used."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Normal:
    """Normal equations split for the Schur complement: photos and cameras (u), points (v).

    A photo has p = 6 unknowns, or 9 with its turn; a camera q = 10, or none where all are fixed.
    """

    U: Array
    """(n, p, p) photo blocks."""
    Uc: Array
    """(m, q, q) camera blocks."""
    Upc: Array
    """(n, p, q) photo-camera blocks."""
    V: Array
    """(P, 3, 3) point blocks."""
    Wp: Array
    """(N, p, 3) photo-point block of each observation."""
    Wc: Array
    """(N, q, 3) camera-point block of each observation."""
    gp: Array
    """(n, p) gradient."""
    gc: Array
    """(m, q) gradient."""
    gv: Array
    """(P, 3) gradient."""
    cost: float
    """Robust cost."""
    shared: Array
    """(n, 3) precisions of measured centres that share an unknown shift; (0, 3) for none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Adjusted:
    """Result of an adjustment."""

    state: State
    """The unknowns at the minimum."""
    cost: float
    """Robust cost there."""
    iterations: int
    """Steps taken."""
    converged: bool
    """False if the limit of iterations was reached first."""


def _cauchy(squared: Array, scale: float) -> tuple[Array, Array]:
    """Weights and costs of squared whitened residuals under Cauchy's loss."""
    u = squared / scale**2
    return 1 / (1 + u), scale**2 * np.log1p(u)


def _pseudo_huber(squared: Array, scale: float) -> tuple[Array, Array]:
    """Weights and costs under the pseudo-Huber loss: outliers get less weight, but never zero
    weight.

    If a strip bends away from its measured positions and angles, all of them have large residuals
    together. A redescending loss would then ignore all of them.
    """
    root = np.sqrt(1 + squared / scale**2)
    # the cost is 2 scale^2 (root - 1), in a form without cancellation at large scales
    return 1 / root, 2 * squared / (root + 1)


def _by_point(problem: Problem, values: Array, count: int) -> Array:
    """Sums of values (N, ...) of each point's observations: (count, ...). Observations are sorted
    by point.
    """
    flat = values.reshape(len(values), -1)
    starts = np.searchsorted(problem.point, np.arange(count))
    total = np.add.reduceat(flat, np.minimum(starts, len(flat) - 1), axis=0)
    total[np.diff(np.r_[starts, len(flat)]) == 0] = 0
    return total.reshape(count, *values.shape[1:])


def _by_photo(problem: Problem, rows: Array, count: int) -> Array:
    """Products A^T A (count, k, k) of each photo's rows A; rows (N, 2, k)."""
    order = np.argsort(problem.photo, kind="stable")
    cuts = np.searchsorted(problem.photo[order], np.arange(count + 1))
    sorted_rows = rows[order].reshape(-1, rows.shape[2])
    out = np.empty((count, rows.shape[2], rows.shape[2]))
    for i in range(count):
        own = sorted_rows[2 * cuts[i] : 2 * cuts[i + 1]]
        out[i] = own.T @ own
    return out


def _observation_weights(problem: Problem, residual: Array) -> tuple[Array, float]:
    weight, cost = _cauchy((residual**2).sum(1), problem.loss_px)
    return np.asarray(weight * problem.trust), float((cost * problem.trust).sum())


def _prior_terms(problem: Problem, state: State) -> tuple[list[tuple[Array, Array]], float]:
    """(precision, residual*precision) of centres, attitudes, intrinsics, points, turns; and their
    cost.
    """
    dc, pc, cost_c = position_terms(problem, state)
    rotation = attitude_error(state.R, problem.R0)
    wr, cost_r = _pseudo_huber(((rotation / problem.sigma_R) ** 2).sum(1), problem.loss_R)
    pr = wr[:, None] / problem.sigma_R**2
    pk = problem.free / problem.sigma_K**2
    dk = state.K - problem.K0
    px = np.where(np.isfinite(problem.X0), 1 / problem.sigma_X**2, 0.0)
    dx = np.nan_to_num(state.X - problem.X0)
    pt = np.zeros_like(state.turn)
    if problem.sigma_turn is not None:
        pt += 1 / problem.sigma_turn[:, None] ** 2
    cost = float(cost_c.sum() + cost_r.sum() + (pk * dk**2).sum() + (px * dx**2).sum())
    cost += float((pt * state.turn**2).sum())
    terms = [(pc, pc * dc), (pr, pr * rotation), (pk, pk * dk), (px, px * dx)]
    return [*terms, (pt, pt * state.turn)], cost


def position_terms(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    """Misfits (n, 3) in m of the measured centres less their common shift, their precisions (n, 3)
    and costs (n,).
    """
    apart = np.nan_to_num(state.C - problem.C0)
    precision = np.where(np.isfinite(problem.C0), 1 / problem.sigma_C**2, 0.0)
    shift, pc = np.zeros(3), precision
    for _ in range(4 if problem.offset else 1):
        e = apart - shift
        wc, cost = _pseudo_huber((e**2 * precision).sum(1), problem.loss_C)
        pc = precision * wc[:, None]
        if problem.offset:
            shift = (pc * apart).sum(0) / np.maximum(pc.sum(0), 1e-300)
    return np.where(precision > 0, apart - shift, 0.0), pc, cost


def _add_diagonal(blocks: Array, offset: int, values: Array) -> None:
    k = np.arange(values.shape[1]) + offset
    blocks[:, k, k] += values


def normal_equations(problem: Problem, state: State) -> Normal:
    """Normal equations of the reweighted problem at a state."""
    lin = linearise(problem, state)
    weight, cost = _observation_weights(problem, lin.residual)
    root = np.sqrt(weight)[:, None, None]
    e, J_point = lin.residual[..., None] * root, lin.J_point * root
    rows = np.concatenate([lin.J_photo, lin.J_camera, lin.residual[..., None]], 2) * root
    n, m, count, q = len(state.C), len(state.K), len(state.X), lin.J_camera.shape[2]
    k = problem.photo_unknowns
    by_photo = _by_photo(problem, rows, n)
    by_camera = np.zeros((m, q, q + 1))
    np.add.at(by_camera, problem.camera, by_photo[:, k : k + q, k:])
    point_rows = np.concatenate([J_point, e], 2)
    by_point = _by_point(problem, np.swapaxes(J_point, 1, 2) @ point_rows, count)
    W = np.swapaxes(rows[:, :, :-1], 1, 2) @ J_point
    (pc, gc), (pr, gr), (pk, gk), (px, gx), (pt, gt) = (terms := _prior_terms(problem, state))[0]
    U, Uc, V = by_photo[:, :k, :k].copy(), by_camera[:, :, :q].copy(), by_point[:, :, :3].copy()
    _add_diagonal(U, 0, pr)
    _add_diagonal(U, 3, pc)
    _add_diagonal(Uc, 0, np.where(problem.free, pk, 1.0)[:, :q])
    _add_diagonal(V, 0, px)
    if k == 9:
        _add_diagonal(U, 6, pt)
    gp = by_photo[:, :k, -1] + np.concatenate([gr, gc, gt], 1)[:, :k]
    return Normal(
        U=U,
        Uc=Uc,
        Upc=by_photo[:, :k, k : k + q],
        V=V,
        Wp=W[:, :k],
        Wc=W[:, k:],
        gp=gp,
        gc=by_camera[:, :, q] + gk[:, :q],
        gv=by_point[:, :, 3] + gx,
        cost=cost + terms[1],
        shared=pc if problem.offset else np.zeros((0, 3)),
    )


def robust_cost(problem: Problem, state: State) -> float:
    """Robust cost of a state."""
    error = np.nan_to_num(residuals_px(problem, state)) / problem.sigma_px[:, None]
    return _observation_weights(problem, error)[1] + _prior_terms(problem, state)[1]


def _chunks(problem: Problem, count: int) -> list[tuple[int, int]]:
    """Ranges of observations covering whole points, about 6000 observations each."""
    starts = np.searchsorted(problem.point, np.arange(count + 1))
    cuts = [0]
    while cuts[-1] < len(problem.point):
        reach = np.searchsorted(starts, cuts[-1] + 6000, "right") - 1
        nxt = int(starts[reach])
        cuts.append(nxt if nxt > cuts[-1] else int(starts[reach + 1]))
    return list(pairwise(cuts))


def _zeros(size: int) -> "Array | sparse.lil_matrix":
    if size <= DENSE_LIMIT:
        return np.zeros((size, size))
    from scipy import sparse

    return sparse.lil_matrix((size, size))


def _solve_positive(S: Array, rhs: Array) -> Array:
    """S^-1 rhs; `LinAlgError` if S is not positive definite."""
    if len(S) <= SMALL:
        np.linalg.cholesky(S)  # the solver itself accepts any matrix
        return np.asarray(np.linalg.solve(S, rhs))
    from scipy import linalg

    return np.asarray(linalg.cho_solve(linalg.cho_factor(S, check_finite=False), rhs))


class Reduced:
    """The Schur complement on photos and cameras of damped normal equations."""

    def __init__(self, problem: Problem, normal: Normal, damping: float) -> None:
        self.problem, self.normal = problem, normal
        n, m, q = len(normal.U), len(normal.Uc), normal.Uc.shape[2]
        self.p = normal.U.shape[1]
        self.n, self.m, self.q, self.size = n, m, q, self.p * n + q * m
        V = normal.V.copy()
        k = np.arange(3)
        V[:, k, k] = V[:, k, k] * (1 + damping) + 1e-12
        self.L_inv = np.linalg.inv(np.linalg.cholesky(V))
        self.g = np.concatenate([normal.gp.ravel(), normal.gc.ravel()])
        self._shared = self._shift_taken()
        self.S: Array | sparse.csc_matrix = self._assemble(damping)

    def _shift_taken(self) -> Array:
        """(size, 3): by the product of this with its transpose the system loses what a common shift
        of all measured centres takes up (the Schur complement on that shift).
        """
        shared = self.normal.shared
        out = np.zeros((self.size, 3))
        for axis in range(3 if len(shared) else 0):
            total = float(shared[:, axis].sum())
            if total > 0:
                at = self.p * np.arange(self.n) + 3 + axis
                out[at, axis] = shared[:, axis] / np.sqrt(total)
        return out

    def _diagonal_blocks(self, damping: float) -> "Array | sparse.lil_matrix":
        n, m, p, q, N = self.n, self.m, self.p, self.q, self.normal
        S = _zeros(self.size)
        for i in range(n):
            block = N.U[i] + np.diag(np.diag(N.U[i]) * damping + 1e-9)
            own = slice(p * i, p * i + p)
            S[own, own] = block
            c = p * n + q * int(self.problem.camera[i])
            S[own, c : c + q] = N.Upc[i]
            S[c : c + q, own] = N.Upc[i].T
        for j in range(m if q else 0):
            c = p * n + q * j
            S[c : c + q, c : c + q] = N.Uc[j] + np.diag(np.diag(N.Uc[j]) * damping)
        return S

    def _chunk(self, lo: int, hi: int) -> tuple[NDArray[np.int64], Array, slice]:
        """Unknowns touched by observations [lo, hi), their rows of W L^-T (u, 3p), and the points'
        slice.
        """
        p, N, k, q = self.problem, self.normal, self.p, self.q
        point, photo = p.point[lo:hi], p.photo[lo:hi]
        first, last = int(point[0]), int(point[-1]) + 1
        seen, local = np.unique(photo, return_inverse=True)
        cams, cam_local = np.unique(p.camera[photo], return_inverse=True)
        T = np.swapaxes(self.L_inv[point], 1, 2)
        rows = np.zeros((k * len(seen) + q * len(cams), last - first, 3))
        view = rows[: k * len(seen)].reshape(len(seen), k, last - first, 3)
        view[local, :, point - first] = N.Wp[lo:hi] @ T
        if q:
            cam_view = rows[k * len(seen) :].reshape(len(cams), q, last - first, 3)
            place: Any = (cam_local, slice(None), point - first)
            np.add.at(cam_view, place, N.Wc[lo:hi] @ T)
        unknowns = np.concatenate(
            [
                (k * seen[:, None] + np.arange(k)).ravel(),
                (k * self.n + q * cams[:, None] + np.arange(q)).ravel(),
            ]
        )
        return unknowns, rows.reshape(len(rows), -1), slice(first, last)

    def _assemble(self, damping: float) -> "Array | sparse.csc_matrix":
        S = self._diagonal_blocks(damping)
        z = np.einsum("pij,pj->pi", self.L_inv, self.normal.gv)
        parts: list[tuple[Array, Array, Array]] = []
        for lo, hi in _chunks(self.problem, len(self.normal.V)):
            unknowns, rows, points = self._chunk(lo, hi)
            product = rows @ rows.T
            self.g[unknowns] -= rows @ z[points].ravel()
            if isinstance(S, np.ndarray):
                S[np.ix_(unknowns, unknowns)] -= product
            else:
                i, j = np.meshgrid(unknowns, unknowns, indexing="ij")
                keep = product != 0
                parts.append((i[keep], j[keep], -product[keep]))
        if isinstance(S, np.ndarray):
            return S - self._shared @ self._shared.T if len(self.normal.shared) else S
        from scipy import sparse

        i, j, v = (np.concatenate(x) for x in zip(*parts, strict=True))
        return (S.tocsc() + sparse.coo_matrix((v, (i, j)), S.shape).tocsc()).tocsc()

    def solve(self, rhs: Array) -> Array:
        """S^-1 rhs."""
        if isinstance(self.S, np.ndarray):
            return _solve_positive(self.S, rhs)
        from scipy.sparse import linalg

        factor = linalg.splu(self.S, permc_spec="MMD_AT_PLUS_A")
        x = np.asarray(factor.solve(rhs))
        taken = self._shared[:, self._shared.any(0)]
        if not taken.shape[1]:
            return x
        y = factor.solve(taken)  # Woodbury: the shift makes the system dense
        small = np.eye(taken.shape[1]) - taken.T @ y
        return np.asarray(x + y @ np.linalg.solve(small, taken.T @ x))

    def step(self) -> tuple[Array, Array, Array]:
        """The Gauss-Newton step of photos (n, p), cameras (m, 10) and points (P, 3)."""
        du = -self.solve(self.g)
        photos = self.p * self.n
        photo_step, camera_step = du[:photos].reshape(-1, self.p), np.zeros((self.m, CAMERA))
        p, N = self.problem, self.normal
        coupled = np.einsum("nij,ni->nj", N.Wp, photo_step[p.photo])
        if self.q:
            camera_step = du[photos:].reshape(-1, CAMERA)
            coupled += np.einsum("nij,ni->nj", N.Wc, camera_step[p.camera[p.photo]])
        rhs = N.gv + _by_point(p, coupled, len(N.V))
        half = np.einsum("pij,pj->pi", self.L_inv, rhs)
        return photo_step, camera_step, -np.einsum("pji,pj->pi", self.L_inv, half)


def polish_points(problem: Problem, state: State) -> State:
    """One Gauss-Newton step of the points alone."""
    residual, J_point = linearised_points(problem, state)
    weight, _ = _observation_weights(problem, residual)
    rows = np.concatenate([J_point, residual[..., None]], 2) * np.sqrt(weight)[:, None, None]
    sums = _by_point(problem, np.swapaxes(rows[:, :, :3], 1, 2) @ rows, len(state.X))
    pull = np.where(np.isfinite(problem.X0), 1 / problem.sigma_X**2, 0.0)
    H = sums[:, :, :3]
    _add_diagonal(H, 0, pull + 1e-9)
    g = sums[:, :, 3] + pull * np.nan_to_num(state.X - problem.X0)
    return replace(state, X=state.X - np.linalg.solve(H, g[..., None])[..., 0])


def adjust(
    problem: Problem,
    state: State,
    *,
    iterations: int = 30,
    tolerance: float = 1e-5,
    damping: float = 1e-4,
) -> Adjusted:
    """Minimises the robust cost.

    After each step the points are refined under the moved photos before the step is accepted or
    rejected. A strip that straightens moves along a curve; without this refinement all its long
    steps would be rejected.

    Args:
        problem: observations and priors.
        state: where to start.
        iterations: largest number of steps.
        tolerance: relative decrease of the cost below which the adjustment has converged.
        damping: first damping, relative to the diagonal of the normal equations.
    """

    def equations(state: State) -> tuple[float, Callable[[float], State]]:
        normal = normal_equations(problem, state)

        def step(damping: float) -> State:
            moved = state.moved(*Reduced(problem, normal, damping).step())
            return polish_points(problem, moved)

        return normal.cost, step

    found = levenberg_marquardt(
        state,
        equations,
        lambda state: robust_cost(problem, state),
        iterations=iterations,
        tolerance=tolerance,
        damping=damping,
    )
    return Adjusted(
        state=found.state, cost=found.cost, iterations=found.iterations, converged=found.converged
    )


def covariance(problem: Problem, state: State) -> Array | None:
    """Covariance ((pn+10m), (pn+10m)) of photos and cameras at the minimum, points marginalised.

    Observations count as the problem weighs them. None for more than `DENSE_LIMIT` unknowns, and if
    some unknowns are not determined.
    """
    normal = normal_equations(problem, state)
    reduced = Reduced(problem, normal, 0.0)
    if not isinstance(reduced.S, np.ndarray):
        return None
    S = reduced.S + np.diag(np.full(reduced.size, 1e-9))
    scale = 1 / np.sqrt(
        np.maximum(np.diag(S), 1e-9)
    )  # radians and metres differ by orders of magnitude
    scale = scale[:, None] * scale
    try:
        inverse = np.linalg.inv(S * scale) * scale
    except np.linalg.LinAlgError:
        return None
    fixed = CAMERA * reduced.m if reduced.q == 0 else 0  # fixed intrinsics have no variance
    return np.pad(inverse, (0, fixed)) if np.isfinite(inverse).all() else None


def camera_sigmas(covariance: Array, cameras: int) -> Array:
    """Standard deviations (cameras, 10) of the cameras' unknowns, of a covariance as above."""
    own = np.diagonal(covariance)[len(covariance) - CAMERA * cameras :]
    return np.asarray(np.sqrt(np.abs(own)).reshape(cameras, CAMERA))
