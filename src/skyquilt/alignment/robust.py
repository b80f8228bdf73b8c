"""The robust cost of an adjustment: Cauchy's loss on observations, pseudo-Huber on priors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.problem import Problem, State, attitude_error, residuals_px

Array = NDArray[np.float64]


def add_diagonal(blocks: Array, values: Array) -> None:
    """Adds values (n, k) to the diagonals of blocks (n, k, k)."""
    k = np.arange(values.shape[1])
    blocks[:, k, k] += values


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


def observation_weights(problem: Problem, residual: Array) -> tuple[Array, float]:
    """Weights (N,) of observations with whitened residuals (N, 2), and their cost."""
    weight, cost = _cauchy((residual**2).sum(1), problem.loss_px)
    return np.asarray(weight * problem.trust), float((cost * problem.trust).sum())


@dataclass(frozen=True, kw_only=True, eq=False)
class PriorTerms:
    """Precisions and gradients (residual times precision) of the priors on photos and cameras."""

    photo: Array
    """(n, 9, 9) precisions of rotations (about the camera's axes), centres and turns."""
    photo_gradient: Array
    """(n, 9)."""
    camera: Array
    """(m, 11), zero where fixed."""
    camera_gradient: Array
    """(m, 11)."""
    common: Array | None
    """(m, 11, m, 11) precisions of what cameras have in common, or None."""
    cost: float
    """Their robust cost."""


def prior_terms(problem: Problem, state: State) -> PriorTerms:
    """The priors on photos and cameras at a state."""
    dc, pc, cost_c = position_terms(problem, state)
    rotation, pr, cost_r = attitude_terms(problem, state)
    pk, dk = problem.free / problem.sigma_K**2, state.K - problem.K0
    pt = np.zeros_like(state.turn)
    dt = state.turn if problem.turn0 is None else state.turn - problem.turn0
    if problem.sigma_turn is not None:
        pt += 1 / problem.sigma_turn[:, None] ** 2
    cost = cost_c.sum() + cost_r.sum() + (pk * dk**2).sum() + (pt * dt**2).sum()
    pull, common = pk * dk, None
    if problem.common is not None:
        off = problem.common.rows @ state.K.ravel() - problem.common.zero
        rows = problem.common.rows * problem.free.ravel()
        cost += off @ off
        pull = pull + (off @ rows).reshape(state.K.shape)
        common = (rows.T @ rows).reshape(*state.K.shape, *state.K.shape)
    R0, R0_T = problem.R0, np.swapaxes(problem.R0, 1, 2)
    photo = np.zeros((len(pr), 9, 9))
    photo[:, :3, :3] = (R0 * pr[:, None]) @ R0_T
    add_diagonal(photo[:, 3:, 3:], np.concatenate([pc, pt], 1))
    turning = ((pr * rotation)[:, None] @ R0_T)[:, 0]
    return PriorTerms(
        photo=photo,
        photo_gradient=np.concatenate([turning, pc * dc, pt * dt], 1),
        camera=pk,
        camera_gradient=pull,
        common=common,
        cost=float(cost),
    )


def point_terms(problem: Problem, state: State) -> tuple[Array, Array]:
    """Precisions (P, 3) of the priors on points, and misfits (P, 3) in m."""
    precision = np.where(np.isfinite(problem.X0), 1 / problem.sigma_X**2, 0.0)
    return precision, np.nan_to_num(state.X - problem.X0)


def attitude_terms(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    """Misfits (n, 3) in rad of the measured attitudes about the map's axes, their precisions (n, 3)
    and costs (n,).
    """
    rotation = attitude_error(state.R, problem.R0)
    weight, cost = _pseudo_huber(((rotation / problem.sigma_R) ** 2).sum(1), problem.loss_R)
    return rotation, weight[:, None] / problem.sigma_R**2, cost


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


def observed_cost(problem: Problem, state: State) -> float:
    """Robust cost of the observations and of what is known of points."""
    error = np.nan_to_num(residuals_px(problem, state)) / problem.sigma_px[:, None]
    precision, apart = point_terms(problem, state)
    return observation_weights(problem, error)[1] + float((precision * apart**2).sum())


def robust_cost(problem: Problem, state: State) -> float:
    """Robust cost of a state."""
    observed = sum(observed_cost(part, own) for part, own, _ in problem.parts(state))
    return observed + prior_terms(problem, state).cost
