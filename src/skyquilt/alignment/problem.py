"""A bundle adjustment problem: unknowns, observations, and priors with their deviations."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import distort, project_with_derivatives
from skyquilt.geometry.frames import rotation_from_vector

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """The unknowns: n photos, m cameras, P points."""

    R: Array
    """(n, 3, 3) map to camera."""
    C: Array
    """(n, 3) centres in m."""
    K: Array
    """(m, 8) intrinsics in the order of `model.camera.PARAMETERS`."""
    X: Array
    """(P, 3) points in m."""

    def moved(self, photo_step: Array, camera_step: Array, point_step: Array) -> "State":
        """The state after a step of the solver: photos (n, 6) = rotation vector then centre,
        cameras (m, 8), points (P, 3).
        """
        return State(
            R=rotation_from_vector(photo_step[:, :3]) @ self.R,
            C=self.C + photo_step[:, 3:],
            K=self.K + camera_step,
            X=self.X + point_step,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Observations and priors. Observations are sorted by point."""

    point: Index
    """(N,) point of each observation, ascending."""
    photo: Index
    """(N,) photo of each observation."""
    px: Array
    """(N, 2) in px."""
    sigma_px: Array
    """(N,) standard deviation of each observation in px."""
    camera: Index
    """(n,) camera of each photo."""
    free: NDArray[np.bool_]
    """(m, 8) which intrinsics are estimated."""
    K0: Array
    """(m, 8) prior of the intrinsics."""
    sigma_K: Array
    """(m, 8) deviations of that prior."""
    C0: Array
    """(n, 3) measured centres; NaN where unknown."""
    sigma_C: Array
    """(n, 3) deviations."""
    R0: Array
    """(n, 3, 3) measured attitudes, map to camera."""
    sigma_R: Array
    """(n, 3) deviations in rad about the camera's x, y, z axes; infinite where unknown."""
    X0: Array
    """(P, 3) surveyed coordinates of control points; NaN for tie points and unknown axes."""
    sigma_X: Array
    """(P, 3) deviations of `X0`."""
    loss_px: float
    """Scale of the Cauchy loss on observations, in units of their deviation."""
    loss_C: float = 3.0
    """Scale of the pseudo-Huber loss on positions, in units of their deviation, since GPS positions
    may contain gross errors.
    """
    loss_R: float = 2.0
    """Scale of the pseudo-Huber loss on attitudes, since gimbal angles may contain gross errors."""
    trust: float = 1.0
    """Factor on the cost of observations. Errors of neighbouring observations are correlated (lens
    model, rolling shutter, features of one kind); the hundreds of observations of a photo contain
    as much information as some dozens of independent ones.
    """

    def with_loss(self, loss_px: float) -> "Problem":
        """The same problem with another scale of the loss on observations."""
        return replace(self, loss_px=loss_px)


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearised:
    """Whitened residuals and Jacobians of the observations."""

    residual: Array
    """(N, 2) in units of the standard deviation."""
    J_photo: Array
    """(N, 2, 6)."""
    J_camera: Array
    """(N, 2, 8), fixed intrinsics zeroed; (N, 2, 0) where all are fixed."""
    J_point: Array
    """(N, 2, 3)."""
    behind: NDArray[np.bool_]
    """(N,) observations whose point lies behind its camera: ignored."""


def _local(problem: Problem, state: State) -> tuple[Array, NDArray[np.bool_]]:
    """Points of all observations in camera coordinates (N, 3), and which lie behind."""
    d = state.X[problem.point] - state.C[problem.photo]
    local = np.einsum("nij,nj->ni", state.R[problem.photo], d)
    behind = local[:, 2] < 1e-6
    local[behind] = (0.0, 0.0, 1.0)
    return local, behind


def linearise(problem: Problem, state: State) -> Linearised:
    """Residuals and Jacobians at a state."""
    local, behind = _local(problem, state)
    cameras, some = problem.camera[problem.photo], bool(problem.free.any())
    p = project_with_derivatives(state.K[cameras], local, intrinsics=some)
    w = (~behind / problem.sigma_px)[:, None]
    d_point = p.d_point * w[..., None]
    J_photo = np.empty((len(local), 2, 6))
    J_photo[:, :, :3] = np.cross(local[:, None, :], d_point)  # d . (w x local) = (local x d) . w
    J_point = d_point @ state.R[problem.photo]
    J_photo[:, :, 3:] = -J_point
    J_camera = (
        p.d_intrinsics * w[..., None] * problem.free[cameras][:, None, :]
        if some
        else p.d_intrinsics
    )
    return Linearised(
        residual=(p.px - problem.px) * w,
        J_photo=J_photo,
        J_camera=J_camera,
        J_point=J_point,
        behind=behind,
    )


def linearised_points(problem: Problem, state: State) -> tuple[Array, Array]:
    """`residual` (N, 2) and `J_point` (N, 2, 3) of `linearise` alone."""
    local, behind = _local(problem, state)
    p = project_with_derivatives(state.K[problem.camera[problem.photo]], local, intrinsics=False)
    w = (~behind / problem.sigma_px)[:, None]
    return (p.px - problem.px) * w, (p.d_point * w[..., None]) @ state.R[problem.photo]


def residuals_px(problem: Problem, state: State) -> Array:
    """Image residuals (N, 2) in px, projected minus observed; NaN for points behind their
    camera.
    """
    local, behind = _local(problem, state)
    k = state.K[problem.camera[problem.photo]]
    px = distort(local[:, :2] / local[:, 2:], k) * k[:, :1] + k[:, 1:3]
    return np.where(behind[:, None], np.nan, px - problem.px)


def attitude_error(R: Array, R0: Array) -> Array:
    """Rotation vectors (n, 3) in rad, in camera axes, that take R0 to R."""
    E = R @ np.swapaxes(R0, -1, -2)
    v = (
        np.stack([E[:, 2, 1] - E[:, 1, 2], E[:, 0, 2] - E[:, 2, 0], E[:, 1, 0] - E[:, 0, 1]], -1)
        / 2
    )
    sine = np.linalg.norm(v, axis=-1)
    angle = np.arctan2(sine, (np.trace(E, axis1=1, axis2=2) - 1) / 2)
    scale = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 1.0)
    return np.asarray(v * scale[:, None])
