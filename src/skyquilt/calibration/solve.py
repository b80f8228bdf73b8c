"""Intrinsics and board poses that leave the least squared reprojection error, with their
covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.deviations import sigmas
from skyquilt.calibration.linearised import linearised
from skyquilt.geometry.camera import project
from skyquilt.geometry.frames import rotation_from_vector
from skyquilt.model.calibration import BoardPose, Observations
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
    views: Sequence[Observations],
    camera: Camera,
    poses: Sequence[BoardPose],
    free: Sequence[str] = PARAMETERS,
) -> Solution:
    """Levenberg and Marquardt over the intrinsics named in `free` and six parameters of each pose.

    For the standard deviations see `deviations.sigmas`.
    """
    columns = [PARAMETERS.index(name) for name in free]
    best, damping = _state(views, camera, poses), 1e-3
    normal, gradient = _normal(views, best, columns)
    for _ in range(_ROUNDS):
        step = np.asarray(
            np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient), np.float64
        )
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
        camera=replace(best.camera, sigmas=sigmas(views, best.camera, best.poses, columns)),
        poses=tuple(best.poses),
        residuals=residuals,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _State:
    camera: Camera
    poses: Sequence[BoardPose]
    predicted: Sequence[Array]
    cost: float


def _state(views: Sequence[Observations], camera: Camera, poses: Sequence[BoardPose]) -> _State:
    predicted = [project(camera, p(v.board)) for v, p in zip(views, poses, strict=True)]
    cost = sum(float(((v.px - q) ** 2).sum()) for v, q in zip(views, predicted, strict=True))
    cost = cost if np.isfinite(cost) and camera.focal > 0 else np.inf
    return _State(camera=camera, poses=poses, predicted=predicted, cost=cost)


def _normal(
    views: Sequence[Observations], state: _State, columns: Sequence[int]
) -> tuple[Array, Array]:
    """Normal matrix and right-hand side: intrinsics first, then six per view."""
    own = len(columns)
    size = own + 6 * len(views)
    normal, gradient = np.zeros((size, size)), np.zeros(size)
    for k, (view, pose) in enumerate(zip(views, state.poses, strict=True)):
        J, r = linearised(view, state.camera, pose, columns)
        J, r = J.reshape(-1, own + 6), r.ravel()
        where = np.r_[0:own, own + 6 * k : own + 6 * k + 6]
        normal[np.ix_(where, where)] += J.T @ J
        gradient[where] += J.T @ r
    return normal, gradient


def _moved(state: _State, step: Array, columns: Sequence[int]) -> tuple[Camera, list[BoardPose]]:
    own = len(columns)
    vector = state.camera.vector
    vector[list(columns)] += step[:own]
    changed: dict[str, Any] = dict(zip(PARAMETERS, vector.tolist(), strict=True))
    rest = step[own:].reshape(-1, 6)
    return replace(state.camera, **changed), [
        moved(p, s) for p, s in zip(state.poses, rest, strict=True)
    ]
