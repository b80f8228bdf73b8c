"""Points from observations with known poses."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.eliminated_points import sums_by_point
from skyquilt.alignment.problem import READOUT, Problem, State, linearised_points
from skyquilt.geometry.camera import undistort
from skyquilt.model.camera import PARAMETERS, Camera

Array = NDArray[np.float64]
STEADY_HIGH = 0.05
"""Standard deviation of a point's height, as a share of the flying height, from which its rays do
not tell it: those of photos of one place hardly converge.
"""


def intersect(
    point: NDArray[np.integer[Any]],
    origin: Array,
    direction: Array,
    count: int,
    near: Array | None = None,
    weight: Array | float = 1e-9,
) -> Array:
    """Least-squares intersections (count, 3) of rays: origins (N, 3), directions (N, 3), by point
    (N,). They are drawn to the places `near` (count, 3), or the origin, with a `weight` each.
    """
    d = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    M = np.eye(3) - d[:, :, None] * d[:, None, :]
    A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(A, point, M)
    np.add.at(b, point, np.einsum("nij,nj->ni", M, origin))
    A += np.eye(3) * np.broadcast_to(weight, count)[:, None, None]
    if near is not None:
        b += near * np.broadcast_to(weight, count)[:, None]
    return np.asarray(np.linalg.solve(A, b[..., None])[..., 0])


def triangulated(problem: Problem, state: State) -> State:
    """The state with all points of the problem (as many as in `X0`) intersected from their rays."""
    X = np.zeros((len(problem.X0), 3))
    for part, _, points in problem.parts(state):
        X[points] = _intersected(part, state)
    return replace(state, X=X)


def _intersected(problem: Problem, state: State) -> Array:
    """Points (P, 3) of the observations of a part."""
    xy = np.empty((len(problem.px), 2))
    for row, k in enumerate(state.K):
        own = problem.camera[problem.photo] == row
        if own.any():
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
    return intersect(problem.point, origin, direction, len(problem.X0))


def regular(H: Array) -> Array:
    """Normal equations (P, 3, 3), those of points beside a camera's own plane, which tell one
    direction only, made ones that can be solved.
    """
    size = np.abs(H).max((1, 2))
    flat = ~(np.abs(np.linalg.det(H)) > 1e-30 * size**3)
    if flat.any():
        H = H.copy()
        added = np.maximum(1e-9 * size[flat], 1.0)
        H[flat] = np.nan_to_num(H[flat]) + np.eye(3) * added[:, None, None]
    return H


def polish(problem: Problem, state: State, *, iterations: int = 5) -> tuple[State, Array]:
    """Gauss-Newton on the points alone; returns the state and the standard deviation (P,) of each
    point's height in m.
    """
    X, sigma_z = state.X.copy(), np.full(len(state.X), np.inf)
    for part, own, points in problem.parts(state):
        for _ in range(iterations):
            residual, J = linearised_points(part, own)
            w = 1 / (1 + (residual**2).sum(1) / part.loss_px**2)
            rows = np.concatenate([J, residual[..., None]], 2)
            products = np.swapaxes(J, 1, 2) @ rows * w[:, None, None]
            sums = sums_by_point(part, products, len(own.X))
            H = regular(sums[:, :, :3] + np.eye(3) * 1e-9)
            own = replace(own, X=own.X - np.linalg.solve(H, sums[:, :, 3:])[..., 0])
            sigma_z[points] = np.sqrt(np.abs(np.linalg.inv(H)[:, 2, 2]))
        X[points] = own.X
    return replace(state, X=X), sigma_z
