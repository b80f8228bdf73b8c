"""A first camera and first poses from homographies [Zhang 2000], the principal point in the
middle.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.model.calibration import BoardPose, Observations
from skyquilt.model.camera import Camera

Array = NDArray[np.float64]


def start_camera(views: Sequence[Observations], *, width: int, height: int) -> Camera:
    """An ideal camera whose focal length in px follows from the tilt of the boards; the longer side
    if no board is tilted.
    """
    rows, right = [], []
    middle = np.array([[1, 0, -(width - 1) / 2], [0, 1, -(height - 1) / 2], [0, 0, 1]])
    for view in views:
        h = middle @ _homography(view)
        h /= np.linalg.norm(h[:, 0])
        rows += [
            h[0, 0] * h[0, 1] + h[1, 0] * h[1, 1],
            h[0, 0] ** 2 + h[1, 0] ** 2 - h[0, 1] ** 2 - h[1, 1] ** 2,
        ]
        right += [-h[2, 0] * h[2, 1], h[2, 1] ** 2 - h[2, 0] ** 2]
    a, b = np.array(rows), np.array(right)
    inverse = float(a @ b / (a @ a)) if a @ a > 0 else 0.0
    focal = 1 / np.sqrt(inverse) if inverse > 0 else 0.0
    longest = max(width, height)
    return Camera.ideal(
        width=width, height=height, focal=focal if 0.2 * longest < focal < 60 * longest else longest
    )


def start_pose(view: Observations, camera: Camera) -> BoardPose:
    """The pose of a board from its homography."""
    h = np.linalg.inv(camera.matrix) @ _homography(view)
    h /= (np.linalg.norm(h[:, 0]) + np.linalg.norm(h[:, 1])) / 2
    h *= np.sign(h[2, 2]) or 1.0
    u, _, vt = np.linalg.svd(np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])]))
    return BoardPose(cam_R_board=u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, cam_t=h[:, 2])


def _homography(view: Observations) -> Array:
    """px_H_board (3, 3) from the board's plane in m."""
    return np.asarray(cv2.findHomography(view.board[:, :2], view.px, 0)[0], np.float64)
