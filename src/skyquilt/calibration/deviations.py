"""Standard deviations of the parameters of a calibration, the derivatives they come from, and views
that disagree with the others.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import project_with_derivatives
from skyquilt.model.calibration import BoardPose, Calibration, Observations
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


_LENGTHS = ("focal", "cx", "cy")


def widened(found: Calibration, other: Calibration) -> Calibration:
    """A calibration whose lengths (focal length, principal point) have deviations increased by the
    difference from another one, from other points of the same views, divided by the square root of
    two.

    Heat moves the edges of squares in the same way in every view. Poses and intrinsics absorb part
    of this, which no residual shows; centres and corners absorb it differently. Distortion
    coefficients are not changed, since the two calibrations may have different orders.
    """
    apart = found.camera.vector - other.camera.vector
    apart = np.where([n in found.free and n in _LENGTHS for n in PARAMETERS], apart, 0.0)
    sigmas = np.hypot(found.camera.sigmas or np.zeros(len(apart)), apart / np.sqrt(2))
    return replace(found, camera=replace(found.camera, sigmas=tuple(sigmas.tolist())))


_FEWEST = 4


def sigmas(
    views: Sequence[Observations],
    camera: Camera,
    poses: Sequence[BoardPose],
    columns: Sequence[int],
) -> tuple[float, ...]:
    """Standard deviations in the order of `PARAMETERS`, 0 for fixed parameters (`columns`: the free
    ones).

    The largest of three estimates. First, independent errors with the variance of the residuals.
    Second, errors that are the same in every view at a point of the board [sandwich estimator,
    clustered by point]: a board that is not quite flat or evenly heated has the same errors in all
    views, and more views do not reduce them. Third, the jackknife over views, since errors of
    neighbouring squares in one view are correlated.
    """
    own = len(columns)
    size = own + 6 * len(views)
    normal, total, count = np.zeros((size, size)), 0.0, 0
    scores: dict[tuple[float, ...], Array] = {}
    for k, (view, pose) in enumerate(zip(views, poses, strict=True)):
        J, r = linearised(view, camera, pose, columns)
        where = np.r_[0:own, own + 6 * k : own + 6 * k + 6]
        flat = J.reshape(-1, own + 6)
        normal[np.ix_(where, where)] += flat.T @ flat
        total, count = total + float((r * r).sum()), count + r.size
        for mark, score in zip(
            map(tuple, np.round(view.board, 6)), np.einsum("nij,ni->nj", J, r), strict=True
        ):
            scores.setdefault(mark, np.zeros(size))[where] += score
    scale = 1 / np.sqrt(
        np.maximum(np.diag(normal), 1e-300)
    )  # the parameters' units differ by many powers of ten
    inverse = (
        np.linalg.pinv(normal * scale * scale[:, None], hermitian=True) * scale * scale[:, None]
    )
    spare = max(count - size, 1)
    independent = np.diag(inverse)[:own] * total / spare
    moved = inverse[:own] @ np.array(list(scores.values())).T
    few = len(scores) / max(len(scores) - own, 1) * (count - 1) / spare
    repeated = (moved * moved).sum(1) * few
    out = np.zeros(len(PARAMETERS))
    by_view = _jackknife(views, camera, poses, columns)
    out[list(columns)] = np.sqrt(np.maximum.reduce([independent, repeated, by_view, np.zeros(own)]))
    return tuple(out.tolist())


def _jackknife(
    views: Sequence[Observations],
    camera: Camera,
    poses: Sequence[BoardPose],
    columns: Sequence[int],
) -> Array:
    """Variances of the intrinsics from their changes when each view is left out, to first order;
    zero for fewer than four views.
    """
    own = len(columns)
    if len(views) < _FEWEST or not own:
        return np.zeros(own)
    normals, scores = [], []
    for view, pose in zip(views, poses, strict=True):
        J, r = linearised(view, camera, pose, columns)
        flat, e = J.reshape(-1, own + 6), r.ravel()
        to_pose = np.linalg.lstsq(flat[:, own:], np.column_stack([flat[:, :own], e]), rcond=None)[0]
        free = flat[:, :own] - flat[:, own:] @ to_pose[:, :own]  # not absorbed by the pose
        normals.append(free.T @ free)
        scores.append(free.T @ (e - flat[:, own:] @ to_pose[:, own]))
    whole = np.sum(normals, 0)
    scale = 1 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
    moved = []
    for normal, score in zip(normals, scores, strict=True):
        rest = (whole - normal) * scale * scale[:, None]
        moved.append(np.linalg.pinv(rest, hermitian=True) @ (score * scale) * scale)
    return np.asarray((np.array(moved) ** 2).sum(0) * (len(views) - 1) / len(views))
