"""Derivatives of the points of a view by intrinsics and board pose."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import project_with_derivatives
from skyquilt.model.calibration import BoardPose, Observations
from skyquilt.model.camera import PARAMETERS, Camera

Array = NDArray[np.float64]


def linearised(
    view: Observations, camera: Camera, pose: BoardPose, columns: Sequence[int]
) -> tuple[Array, Array]:
    """Derivatives (n, 2, columns + 6) of a view's points by intrinsics (columns of `PARAMETERS`)
    and pose, and residuals (n, 2) in px.
    """
    turned = view.board @ pose.cam_R_board.T
    vector = np.broadcast_to(camera.vector, (len(turned), len(PARAMETERS)))
    at = project_with_derivatives(vector, turned + pose.cam_t)
    spin = np.zeros((len(turned), 3, 3))  # d(turned) by the rotation vector: -[turned]x
    spin[:, 0, 1], spin[:, 0, 2], spin[:, 1, 2] = turned[:, 2], -turned[:, 1], turned[:, 0]
    spin -= np.swapaxes(spin, 1, 2)
    J = np.concatenate([at.d_intrinsics[:, :, columns], at.d_point @ spin, at.d_point], 2)
    return J, view.px - at.px
