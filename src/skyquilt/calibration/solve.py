"""Intrinsics and board poses that minimise the squared reprojection error, by OpenCV."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyquilt.calibration.deviations import sigmas
from skyquilt.geometry.camera import project
from skyquilt.model.calibration import BoardPose, Observations
from skyquilt.model.camera import PARAMETERS, SQUARE, Camera

Array = NDArray[np.float64]

_ENOUGH = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)
"""Largest number of steps of a fit, and the relative change at which it ends."""
_HELD = {
    "k1": cv2.CALIB_FIX_K1,
    "k2": cv2.CALIB_FIX_K2,
    "k3": cv2.CALIB_FIX_K3,
    "p1": cv2.CALIB_FIX_TANGENT_DIST,
    "cx": cv2.CALIB_FIX_PRINCIPAL_POINT,
}
"""OpenCV flag that fixes each parameter; p2 is fixed with p1, and cy with cx."""
_SHORTEST = 0.1
"""Least focal length as a share of the longer side: boards without tilt can also be fitted by a
focal length near zero with extreme distortion.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """The minimum."""

    camera: Camera
    """Camera with `sigmas` of the free parameters."""
    poses: tuple[BoardPose, ...]
    """One per view."""
    residuals: tuple[Array, ...]
    """Measured minus predicted px (n, 2), per view."""


def solve(
    views: Sequence[Observations],
    camera: Camera,
    poses: Sequence[BoardPose],
    free: Sequence[str] = SQUARE,
) -> Solution:
    """The intrinsics named in `free`, the focal length among them, and the pose of each view;
    starts from `camera` and `poses`. If nothing is free, only poses are fitted. If the views do not
    determine the camera, the start is returned; this is visible in the deviations.

    OpenCV's deviations assume independent errors; realistic ones are larger, see
    `deviations.sigmas`.
    """
    if free:
        camera, poses = _calibrated(views, camera, poses, free) or (camera, poses)
    else:
        poses = [_placed(view, camera, pose) for view, pose in zip(views, poses, strict=True)]
    columns = [PARAMETERS.index(name) for name in free]
    predicted = _predicted(views, camera, poses)
    return Solution(
        camera=replace(camera, sigmas=sigmas(views, camera, poses, columns)),
        poses=tuple(poses),
        residuals=tuple(v.px - p for v, p in zip(views, predicted, strict=True)),
    )


def _predicted(
    views: Sequence[Observations], camera: Camera, poses: Sequence[BoardPose]
) -> list[Array]:
    return [project(camera, p(v.board)) for v, p in zip(views, poses, strict=True)]


def _calibrated(
    views: Sequence[Observations], camera: Camera, poses: Sequence[BoardPose], free: Sequence[str]
) -> tuple[Camera, list[BoardPose]] | None:
    """Camera and poses of the minimum; None if OpenCV refuses the start, or if its result is not a
    camera that sees all boards.
    """
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO
    flags |= cv2.CALIB_USE_EXTRINSIC_GUESS
    for name, flag in _HELD.items():
        flags |= 0 if name in free else flag
    turns, shifts = zip(*map(_vectors, poses), strict=True)
    try:
        _, K, k, turned, shifted, *_ = cv2.calibrateCameraExtended(
            [v.board.astype(np.float32) for v in views],
            [v.px.astype(np.float32) for v in views],
            (camera.width, camera.height),
            camera.matrix,
            _distortion(camera),
            turns,
            shifts,
            flags=flags,
            criteria=_ENOUGH,
        )
    except cv2.error:  # a principal point outside the picture, say
        return None
    k1, k2, p1, p2, k3 = k.ravel()[:5].tolist()
    values: dict[str, Any] = {"focal": K[0, 0], "cx": K[0, 2], "cy": K[1, 2]}
    values |= {"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2}
    values = {name: float(value) for name, value in values.items()}
    found = replace(camera, **values)
    placed = [_pose(*p) for p in zip(turned, shifted, strict=True)]
    seen = all(np.isfinite(px).all() for px in _predicted(views, found, placed))
    shortest = _SHORTEST * max(camera.width, camera.height)
    return (found, placed) if found.focal > shortest and seen else None


def _placed(view: Observations, camera: Camera, pose: BoardPose) -> BoardPose:
    turn, shift = cv2.solvePnPRefineLM(
        view.board, view.px, camera.matrix, _distortion(camera), *_vectors(pose), _ENOUGH
    )
    return _pose(turn, shift)


def _vectors(pose: BoardPose) -> tuple[Array, Array]:
    """Rotation vector and translation, as copies, since OpenCV writes into its arguments."""
    turn = np.asarray(cv2.Rodrigues(pose.cam_R_board)[0], np.float64)
    return turn, pose.cam_t.reshape(3, 1).copy()


def _pose(turn: ArrayLike, shift: ArrayLike) -> BoardPose:
    R, _ = cv2.Rodrigues(np.asarray(turn, np.float64))
    return BoardPose(
        cam_R_board=np.asarray(R, np.float64), cam_t=np.asarray(shift, np.float64).ravel()
    )


def _distortion(camera: Camera) -> Array:
    """In OpenCV's order."""
    return np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
