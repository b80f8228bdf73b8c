"""Lens models of lower order, and conversion of pixels to the working image used by the planar
methods.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import undistort
from skyquilt.model.camera import Camera, order_named

Array = NDArray[np.float64]
WORKING_WIDTH = 1500
"""Width in px of the working image for which thresholds are defined (Y 4.2.2, A 2.1)."""


def of_order(camera: Camera, order: str) -> Camera:
    """The lens model of an order (`none`, `2`, `4`, `6`, `6t`) that fits a calibration best over
    the whole image.

    It is fitted separately, including focal length and principal point, and not truncated from the
    higher order. So the other terms compensate for the omitted ones as far as possible (linear
    least squares over a grid of pixels).
    """
    kept, steps = order_named(order), 25
    grid = np.meshgrid(
        np.linspace(0, camera.width - 1, steps), np.linspace(0, camera.height - 1, steps)
    )
    px = np.stack(grid, -1).reshape(-1, 2)
    x, y = undistort(replace(camera, fisheye=0.0), px).T  # the polynomial follows the kind
    r2, n, zero = x * x + y * y, kept.radial, np.zeros_like(x)
    columns = [np.r_[x, y], np.r_[zero + 1, zero], np.r_[zero, zero + 1]]
    columns += [np.r_[x * r2**k, y * r2**k] for k in range(1, n + 1)]
    if kept.tangential:
        columns += [np.r_[2 * x * y, r2 + 2 * y * y], np.r_[r2 + 2 * x * x, 2 * x * y]]
    solved = np.linalg.lstsq(np.stack(columns, -1), np.r_[px[:, 0], px[:, 1]], rcond=None)[0]
    radial = np.zeros(3)
    radial[:n] = solved[3 : 3 + n] / solved[0]
    tangential = solved[3 + n :] / solved[0] if kept.tangential else np.zeros(2)
    return replace(
        camera,
        focal=float(solved[0]),
        cx=float(solved[1]),
        cy=float(solved[2]),
        k1=float(radial[0]),
        k2=float(radial[1]),
        k3=float(radial[2]),
        p1=float(tangential[0]),
        p2=float(tangential[1]),
        sigmas=None,
    )


def working_K(camera: Camera) -> Array:
    """(3, 3) from the undistorted image plane (units of the focal length) to the working image, in
    px.
    """
    scale = min(1.0, WORKING_WIDTH / camera.width)
    return np.array(
        [
            [camera.focal * scale, 0, camera.cx * scale],
            [0, camera.focal * scale, camera.cy * scale],
            [0, 0, 1],
        ]
    )


def to_working(camera: Camera, px: Array) -> Array:
    """Pixels (N, 2) of the photo in the undistorted working image (N, 2), in px."""
    K = working_K(camera)
    return np.asarray(undistort(camera, px) * K[0, 0] + K[:2, 2])
