"""Intrinsics and board poses that leave the least squared reprojection error, with their covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import project, project_with_derivatives
from skyquilt.geometry.frames import rotation_from_vector
from skyquilt.model.calibration import BoardPose, Sightings
from skyquilt.model.camera import PARAMETERS, Camera

Array = NDArray[np.float64]
_ROUNDS = 60
_STILL = 1e-10


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """The minimum."""

    camera: Camera
    """With `sigmas` of what was free."""
    poses: tuple[BoardPose, ...]
    """One per view."""
    residuals: tuple[Array, ...]
    """Measured less predicted px (n, 2), per view."""


def moved(pose: BoardPose, step: Array) -> BoardPose:
    """A pose turned by a rotation vector (3) in rad in camera axes, then shifted (3) in m."""
    R = rotation_from_vector(step[:3]) @ pose.cam_R_board
    return BoardPose(cam_R_board=R, cam_t=pose.cam_t + step[3:])


def solve(
    views: Sequence[Sightings], camera: Camera, poses: Sequence[BoardPose], free: Sequence[str] = PARAMETERS
) -> Solution:
    """Levenberg and Marquardt over the intrinsics named in `free` and six parameters of each pose.

    The standard deviations are those of the linearised problem with the variance that the residuals show.
    """
    columns = [PARAMETERS.index(name) for name in free]
    best, damping = _state(views, camera, poses), 1e-3
    normal, gradient = _normal(views, best, columns)
    for _ in range(_ROUNDS):
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
        tried = _state(views, *_moved(best, step, columns))
        if tried.cost < best.cost:
            gain = 1 - tried.cost / best.cost
            best, damping = tried, max(damping / 10, 1e-12)
            normal, gradient = _normal(views, best, columns)
            if gain < _STILL:
                break
        elif damping > 1e8:
            break
        else:
            damping *= 10
    residuals = tuple(v.px - p for v, p in zip(views, best.predicted, strict=True))
    return Solution(
        camera=replace(best.camera, sigmas=_sigmas(normal, best.cost, views, columns)),
        poses=tuple(best.poses),
        residuals=residuals,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _State:
    camera: Camera
    poses: Sequence[BoardPose]
    predicted: Sequence[Array]
    cost: float


def _state(views: Sequence[Sightings], camera: Camera, poses: Sequence[BoardPose]) -> _State:
    predicted = [project(camera, p(v.board)) for v, p in zip(views, poses, strict=True)]
    cost = sum(float(((v.px - q) ** 2).sum()) for v, q in zip(views, predicted, strict=True))
    cost = cost if np.isfinite(cost) and camera.focal > 0 else np.inf
    return _State(camera=camera, poses=poses, predicted=predicted, cost=cost)


def _normal(views: Sequence[Sightings], state: _State, columns: Sequence[int]) -> tuple[Array, Array]:
    """Normal matrix and right-hand side: intrinsics first, then six per view."""
    own = len(columns)
    size = own + 6 * len(views)
    normal, gradient = np.zeros((size, size)), np.zeros(size)
    for k, (view, pose) in enumerate(zip(views, state.poses, strict=True)):
        turned = view.board @ pose.cam_R_board.T
        vector = np.broadcast_to(state.camera.vector, (len(turned), 8))
        at = project_with_derivatives(vector, turned + pose.cam_t)
        spin = np.zeros((len(turned), 3, 3))  # d(turned) by the rotation vector: -[turned]x
        spin[:, 0, 1], spin[:, 0, 2], spin[:, 1, 2] = turned[:, 2], -turned[:, 1], turned[:, 0]
        spin -= np.swapaxes(spin, 1, 2)
        J = np.concatenate([at.d_intrinsics[:, :, columns], at.d_point @ spin, at.d_point], 2)
        J, r = J.reshape(-1, own + 6), (view.px - at.px).ravel()
        where = np.r_[0:own, own + 6 * k : own + 6 * k + 6]
        normal[np.ix_(where, where)] += J.T @ J
        gradient[where] += J.T @ r
    return normal, gradient


def _moved(state: _State, step: Array, columns: Sequence[int]) -> tuple[Camera, list[BoardPose]]:
    own = len(columns)
    changed = {PARAMETERS[c]: getattr(state.camera, PARAMETERS[c]) + float(s) for c, s in zip(columns, step, strict=False)}
    rest = step[own:].reshape(-1, 6)
    return replace(state.camera, **changed), [moved(p, s) for p, s in zip(state.poses, rest, strict=True)]


def _sigmas(
    normal: Array, cost: float, views: Sequence[Sightings], columns: Sequence[int]
) -> tuple[float, ...]:
    """Standard deviations in the order of `PARAMETERS`; 0 for what was held."""
    spare = sum(v.px.size for v in views) - len(normal)
    scale = 1 / np.sqrt(np.diag(normal))  # the parameters' units differ by many powers of ten
    covariance = np.linalg.pinv(normal * scale * scale[:, None], hermitian=True) * scale * scale[:, None]
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0) * cost / max(spare, 1))
    out = np.zeros(len(PARAMETERS))
    out[list(columns)] = sigma[: len(columns)]
    return tuple(out.tolist())
