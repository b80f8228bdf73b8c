"""Projection of pinholes and fisheyes with Brown's distortion, its inverse and its derivatives.

One convention inside the project: OpenCV's, from undistorted to distorted coordinates. The thesis
prints the other direction (Y 2.1); conversions happen only on input and output
(`geometry.camera_formats`).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.camera import PARAMETERS, Camera

Array = NDArray[np.float64]


class Projection(NamedTuple):
    """Pixels and derivatives of N projected points."""

    px: Array
    """(N, 2) in px."""
    d_point: Array
    """(N, 2, 3): with respect to the point in camera coordinates."""
    d_intrinsics: Array
    """(N, 2, 10): with respect to the intrinsics in the order of `model.camera.PARAMETERS`, zero
    for the kind of lens; (N, 2, 0) where they are fixed.
    """


FURTHEST = 1.4
"""Angle from the axis in rad (80 degrees) beyond which a fisheye's pixels are taken for pixels at
this angle: coordinates in a plane end at 90 degrees.
"""


def distort(xy: Array, k: Array) -> Array:
    """Distorted image-plane coordinates (N, 2), units of the focal length.

    `k` is (..., 10) in the order of `PARAMETERS`, one row for all points or one row per point.
    """
    return np.stack(distort_planes(xy[..., 0], xy[..., 1], k), -1)


def pixels(xy: Array, k: Array) -> Array:
    """Pixels (N, 2) of undistorted image-plane coordinates (N, 2), units of the focal length;
    `k` as for `distort`.
    """
    return np.stack(pixel_planes(xy[..., 0], xy[..., 1], k), -1)


def pixel_planes(x: Array, y: Array, k: Array) -> tuple[Array, Array]:
    """`pixels` for separate coordinate arrays: x and y (...), `k` (10,) or a row per point."""
    u, v = distort_planes(x, y, k)
    return k[..., 0] * u + k[..., 1], k[..., 0] * k[..., 8] * v + k[..., 2]


def distort_planes(x: Array, y: Array, k: Array) -> tuple[Array, Array]:
    """`distort` for separate coordinate arrays: x and y (...), `k` (10,) or a row per point."""
    k1, k2, k3, p1, p2 = (k[..., i] for i in range(3, 8))
    if k[..., 9].any():
        angle = angle_over_tangent(x * x + y * y)
        angle = np.where(k[..., 9] > 0, angle, 1.0).astype(angle.dtype)
        x, y = x * angle, y * angle
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def angle_over_tangent(r2: Array) -> Array:
    """The angle from the axis in rad over its tangent, of squared tangents (...)."""
    r = np.sqrt(r2)
    small = r2 < 1e-6
    series = 1 - r2 / 3  # the next term is below 1e-12
    return np.where(small, series, np.arctan(r) / np.where(small, 1.0, r))


def tangent_over_angle(angle: Array) -> Array:
    """The tangent of angles (...) from the axis in rad over the angle; angles beyond `FURTHEST`
    have its tangent.
    """
    tangent = np.tan(np.minimum(angle, FURTHEST))
    return np.where(angle > 1e-9, tangent / np.maximum(angle, 1e-9), 1.0)


def project(camera: Camera, xyz_cam: Array) -> Array:
    """Pixels (N, 2) of points (N, 3) in camera coordinates; NaN behind the camera."""
    z = xyz_cam[..., 2:3]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.where(z > 0, xyz_cam[..., :2] / z, np.nan)
    return pixels(xy, camera.vector)


def project_with_derivatives(k: Array, xyz_cam: Array, *, intrinsics: bool = True) -> Projection:
    """Pixels and derivatives; `k` (N, 10) holds each point's intrinsics, `xyz_cam` is (N, 3) with z
    > 0.

    `intrinsics`: False = they are fixed, and `d_intrinsics` is (N, 2, 0).
    """
    f, cx, cy, k1, k2, k3, p1, p2, aspect, fisheye = k.T
    fy = f * aspect
    inv_z = 1.0 / xyz_cam[:, 2]
    x0, y0 = x, y = xyz_cam[:, 0] * inv_z, xyz_cam[:, 1] * inv_z
    bends = bool(fisheye.any())
    if bends:
        r2 = x * x + y * y
        angle = np.where(fisheye > 0, angle_over_tangent(r2), 1.0)
        # d angle / d r2 * 2
        bend = np.where(r2 < 1e-6, -2 / 3, (1 / (1 + r2) - angle) / np.maximum(r2, 1e-6))
        bend = np.where(fisheye > 0, bend, 0.0)
        x, y = x * angle, y * angle
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # d radial / d r2 * 2
    xd = x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx)
    yd = y * radial + p1 * (r2 + 2 * yy) + 2 * p2 * xy
    dxx = radial + slope * xx + 2 * p1 * y + 6 * p2 * x
    dxy = slope * xy + 2 * p1 * x + 2 * p2 * y
    dyy = radial + slope * yy + 6 * p1 * y + 2 * p2 * x
    dyx = dxy
    if bends:
        # angle * I + bend * (x0, y0) (x0, y0)^T, from the left by the distortion's derivatives
        along_x, along_y = (dxx * x0 + dxy * y0) * bend, (dxy * x0 + dyy * y0) * bend
        dxx, dyx = dxx * angle + along_x * x0, dxy * angle + along_y * x0
        dxy, dyy = dxy * angle + along_x * y0, dyy * angle + along_y * y0
    d_point = np.empty((len(x), 2, 3))
    d_point[:, 0, 0], d_point[:, 0, 1] = f * dxx * inv_z, f * dxy * inv_z
    d_point[:, 1, 0], d_point[:, 1, 1] = fy * dyx * inv_z, fy * dyy * inv_z
    d_point[:, 0, 2] = -f * (dxx * x0 + dxy * y0) * inv_z
    d_point[:, 1, 2] = -fy * (dyx * x0 + dyy * y0) * inv_z
    px = np.stack([f * xd + cx, fy * yd + cy], -1)
    if not intrinsics:
        return Projection(px, d_point, np.zeros((len(x), 2, 0)))
    d_k = np.zeros((len(x), 2, len(PARAMETERS)))
    d_k[:, 0, 0], d_k[:, 1, 0] = xd, aspect * yd
    d_k[:, 0, 1] = d_k[:, 1, 2] = 1
    power = r2.copy()
    for column in (3, 4, 5):
        d_k[:, 0, column], d_k[:, 1, column] = f * x * power, fy * y * power
        power = power * r2
    d_k[:, 0, 6], d_k[:, 1, 6] = 2 * f * xy, fy * (r2 + 2 * yy)
    d_k[:, 0, 7], d_k[:, 1, 7] = f * (r2 + 2 * xx), 2 * fy * xy
    d_k[:, 1, 8] = f * yd
    return Projection(px, d_point, d_k)


def undistort(camera: Camera, px: Array, *, iterations: int = 20) -> Array:
    """Undistorted image-plane coordinates (N, 2), units of the focal length, of pixels (N, 2).

    Newton's method on the distortion; converges to below 1e-10 wherever the model is invertible.
    """
    k = camera.vector
    target = (np.asarray(px, np.float64) - k[1:3]) / (k[0] * np.array([1.0, k[8]]))
    flat = target.reshape(-1, 2)
    if k[3:8].any():
        flat = _undistorted(flat, _begun(camera, flat), k, iterations)
    if k[9]:
        flat = flat * tangent_over_angle(np.linalg.norm(flat, axis=1))[:, None]
    return np.asarray(flat.reshape(target.shape))


def _begun(camera: Camera, wanted: Array) -> Array:
    """Where Newton's method begins (N, 2). A fisheye's polynomial is far from a line at the rim, so
    its radial part is inverted in a table.
    """
    if not camera.fisheye:
        return wanted.copy()
    r = np.linspace(0, np.arctan(monotone_radius(camera)), 200)
    bent = r * (1 + r**2 * (camera.k1 + r**2 * (camera.k2 + r**2 * camera.k3)))
    radius = np.maximum(np.linalg.norm(wanted, axis=1), 1e-12)
    return np.asarray(wanted * (np.interp(radius, bent, r) / radius)[:, None])


def _undistorted(wanted: Array, guess: Array, k: Array, iterations: int) -> Array:
    """Coordinates (N, 2) that Brown's distortion of `k` (10,) takes to those wanted (N, 2), from a
    guess (N, 2), which is changed.
    """
    ones = np.ones(len(wanted))
    unit = np.broadcast_to(np.r_[1.0, 0.0, 0.0, k[3:8], 1.0, 0.0], (len(wanted), len(k)))
    for _ in range(iterations):
        step = project_with_derivatives(unit, np.column_stack([guess, ones]), intrinsics=False)
        error = step.px - wanted
        guess -= np.linalg.solve(step.d_point[:, :, :2], error[..., None])[..., 0]
        if np.abs(error).max(initial=0.0) < 1e-12:
            break
    return guess


def rays(camera: Camera, px: Array) -> Array:
    """Directions (N, 3) in camera coordinates, z = 1, of pixels (N, 2)."""
    xy = undistort(camera, px)
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1)


@lru_cache(maxsize=256)
def monotone_radius(camera: Camera) -> float:
    """Largest undistorted radius (units of the focal length) up to which distortion is invertible.

    Beyond it a polynomial folds back and points far outside the field of view would be projected
    into the image. A fisheye's is at most the tangent of `FURTHEST`.
    """
    most = FURTHEST if camera.fisheye else 3.0
    r = np.linspace(0, most, 601)[1:]
    k1, k2, k3 = camera.k1, camera.k2, camera.k3
    slope = 1 + r**2 * (3 * k1 + r**2 * (5 * k2 + r**2 * 7 * k3))
    folded = np.flatnonzero(slope <= 0.05)
    limit = float(r[folded[0]]) if len(folded) else most
    return float(np.tan(limit)) if camera.fisheye else limit


def shown(camera: Camera, xyz_cam: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (N, 2) of points (N, 3) in camera coordinates, and which of them (N,) the picture
    shows: those in front of the camera, inside its rim, and not folded into it by the distortion.
    """
    ahead = xyz_cam[:, 2] > 0
    local = np.where(ahead[:, None], xyz_cam, [0.0, 0.0, 1.0])
    px = project(camera, local)
    near = np.hypot(local[:, 0], local[:, 1]) <= monotone_radius(camera) * local[:, 2]
    inside = ((px > 0) & (px < (camera.width - 1, camera.height - 1))).all(1)
    return px, np.asarray(ahead & near & inside)
