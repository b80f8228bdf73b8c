"""Points from observations with known poses."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.problem import READOUT, Problem, State, linearised_points
from skyquilt.geometry.camera import undistort
from skyquilt.model.camera import PARAMETERS, Camera

Array = NDArray[np.float64]


def intersect(point: NDArray[np.int64], origin: Array, direction: Array, count: int) -> Array:
    """Least-squares intersections (count, 3) of rays: origins (N, 3), directions (N, 3), by point
    (N,).
    """
    d = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    M = np.eye(3) - d[:, :, None] * d[:, None, :]
    A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(A, point, M)
    np.add.at(b, point, np.einsum("nij,nj->ni", M, origin))
    A += np.eye(3) * 1e-9
    return np.asarray(np.linalg.solve(A, b[..., None])[..., 0])


def triangulated(problem: Problem, state: State) -> State:
    """The state with all points of the problem (as many as in `X0`) intersected from their rays."""
    xy = np.empty((len(problem.px), 2))
    for row, k in enumerate(state.K):
        own = problem.camera[problem.photo] == row
        camera = Camera(width=1, height=1, **dict(zip(PARAMETERS, k[:READOUT], strict=True)))
        xy[own] = undistort(camera, problem.px[own])
    local = np.column_stack([xy, np.ones(len(xy))])
    origin, photo, share = state.C[problem.photo], problem.photo, problem.share[:, None]
    if state.turn.any():
        local -= share * np.cross(state.turn[photo], local)
    if (state.K[:, READOUT] != 0).any():
        moved = problem.velocity * state.K[problem.camera, READOUT, None]
        origin = origin + share * moved[photo]
    direction = np.einsum("nji,nj->ni", state.R[photo], local)
    X = intersect(problem.point, origin, direction, len(problem.X0))
    return replace(state, X=X)


def polish(problem: Problem, state: State, *, iterations: int = 5) -> tuple[State, Array]:
    """Gauss-Newton on the points alone; returns the state and the standard deviation (P,) of each
    point's height in m.
    """
    sigma_z = np.full(len(state.X), np.inf)
    for _ in range(iterations):
        residual, J = linearised_points(problem, state)
        w = 1 / (1 + (residual**2).sum(1) / problem.loss_px**2)
        H, g = np.zeros((len(state.X), 3, 3)), np.zeros((len(state.X), 3))
        np.add.at(H, problem.point, np.swapaxes(J, 1, 2) @ J * w[:, None, None])
        np.add.at(g, problem.point, np.einsum("nki,nk->ni", J, residual) * w[:, None])
        H += np.eye(3) * 1e-9
        step = -np.linalg.solve(H, g[..., None])[..., 0]
        state = replace(state, X=state.X + step)
        sigma_z = np.sqrt(np.abs(np.linalg.inv(H)[:, 2, 2]))
    return state, sigma_z
