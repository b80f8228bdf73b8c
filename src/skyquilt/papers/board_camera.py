"""A camera from views of a flat board (Zhang 2000), each order of distortion is fitted
separately.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.model.camera import Camera, order_named

Doubles = NDArray[np.float64]


def board_camera(
    board: Doubles, views: Sequence[Doubles], size: tuple[int, int], order: str
) -> tuple[Camera, float]:
    """The camera with distortion of an order, and the RMS error in px, from views (N, 2) px of a
    board (N, 3).

    `size` is (width, height) in px. Pixels are square. Each order is a separate fit, not a
    truncated higher order.
    """
    kept, flags = order_named(order), cv2.CALIB_FIX_ASPECT_RATIO
    flags |= 0 if kept.tangential else cv2.CALIB_ZERO_TANGENT_DIST
    for fixed in (cv2.CALIB_FIX_K1, cv2.CALIB_FIX_K2, cv2.CALIB_FIX_K3)[kept.radial :]:
        flags |= fixed
    points = [board.astype(np.float32)] * len(views)
    seen = [v.astype(np.float32) for v in views]
    rms, K, d, _, _ = cv2.calibrateCamera(points, seen, size, np.eye(3), np.zeros(5), flags=flags)
    k1, k2, p1, p2, k3 = (float(v) for v in np.ravel(d)[:5])
    camera = Camera(
        width=size[0],
        height=size[1],
        focal=float(K[0, 0]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        k1=k1,
        k2=k2,
        k3=k3,
        p1=p1,
        p2=p2,
    )
    return camera, float(rms)
