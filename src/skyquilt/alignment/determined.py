"""How well a photo's observations determine its pose: photos that hang on a block by too little."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import project_with_derivatives, rays
from skyquilt.model.camera import Camera
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Pose, Prior, TiePoints

Array = NDArray[np.float64]
FEWEST = 8
"""Fewest tie points of a photo in the map."""
LOOSEST = 0.02
"""Largest deviation of a photo's picture on the ground, as a share of its longer side."""
INDEPENDENT = 40
"""Independent observations that tell as much as a photo's many correlated ones."""
GRID = np.stack(np.meshgrid(*2 * [np.linspace(0.02, 0.98, 5)]), -1).reshape(-1, 2)
"""Places in the picture, as shares of its width and height, where the deviation is predicted."""
STEEPEST = np.tan(np.radians(70.0))
"""Places seen flatter than this are left out: they are not shown."""


def weak_photos(
    alignment: Alignment, photos: Sequence[Photo], priors: Sequence[Prior]
) -> dict[int, str]:
    """Connected photos whose pose is not determined by tie points and metadata together, with
    reasons that give the figures.
    """
    ties = alignment.ties
    order = np.argsort(ties.photo, kind="stable")
    held = alignment.held
    cuts = np.searchsorted(ties.photo[order], [*held, len(photos)])
    found = {}
    for i, first in zip(held, cuts, strict=False):
        last = np.searchsorted(ties.photo[order], i, "right")
        own = order[first:last]
        why = why_weak(
            alignment.poses[i],
            alignment.camera(i),
            ties.xyz[ties.point[own]],
            ties.px[own],
            ties.residual_px[own],
            priors[i],
        )
        if why:
            found[i] = why
    return found


def why_weak(
    pose: Pose, camera: Camera, xyz: Array, px: Array, residual_px: Array, prior: Prior | None
) -> str:
    """Why tie points (n, 3) observed at px (n, 2) do not determine a pose; empty if they do."""
    if len(px) < FEWEST:
        return f"it has only {len(px)} tie points"
    deviation = deviation_px(pose, camera, xyz, residual_px, prior)
    limit = LOOSEST * max(camera.width, camera.height)
    if deviation <= limit:
        return ""
    return (
        f"its {len(px)} tie points cover {covered(px, camera):.0%} of its picture and leave its"
        f" place uncertain by {deviation:.0f} px (at most {limit:.0f} px are allowed)"
    )


def covered(px: Array, camera: Camera) -> float:
    """Share of the picture inside the convex hull of observations (n, 2)."""
    hull = cv2.convexHull(px.astype(np.float32))
    return float(cv2.contourArea(hull)) / (camera.width * camera.height)


def deviation_px(
    pose: Pose, camera: Camera, xyz: Array, residual_px: Array, prior: Prior | None
) -> float:
    """Predicted standard deviation in px of the picture on the ground, at the worst place shown,
    from the covariance of the pose with all points held.
    """
    spread = max(0.5, 1.48 * float(np.median(np.linalg.norm(residual_px, axis=1))) / 1.18)
    weight = min(1.0, INDEPENDENT / len(xyz)) / spread**2
    J = pose_derivatives(pose, camera, xyz)
    normal = weight * np.einsum("nki,nkj->ij", J, J)
    if prior is not None:
        normal += _known(prior)
    places = _ground_places(pose, camera, float(np.median(xyz[:, 2])))
    if not len(places):
        return 0.0
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-12))  # metres and radians
    values, vectors = np.linalg.eigh(normal * scale[:, None] * scale)
    half = vectors / np.sqrt(np.maximum(values, 1e-12)) * scale[:, None]
    at = pose_derivatives(pose, camera, places) @ half
    return float(np.sqrt((at**2).sum((1, 2)).max()))


def pose_derivatives(pose: Pose, camera: Camera, xyz: Array) -> Array:
    """(n, 2, 6) derivatives of the pixels of points (n, 3) by rotation vector and centre."""
    local = pose.to_camera(xyz)
    k = np.broadcast_to(camera.vector, (len(local), 8))
    d_point = project_with_derivatives(k, local, intrinsics=False).d_point
    J = np.empty((len(local), 2, 6))
    J[:, :, :3] = np.cross(local[:, None, :], d_point)
    J[:, :, 3:] = -d_point @ pose.cam_R_map
    return J


def _known(prior: Prior) -> Array:
    """(6, 6) information of a photo's metadata about its rotation (camera axes) and centre."""
    out = np.zeros(6)
    if np.isfinite(prior.yaw_deg):
        tilt, yaw = np.radians([prior.sigma_tilt_deg, prior.sigma_yaw_deg])
        out[:3] = 1 / tilt**2, 1 / tilt**2, 1 / yaw**2
    known = np.isfinite(prior.map_C) & np.isfinite(prior.sigma_C)
    out[3:][known] = 1 / prior.sigma_C[known] ** 2
    return np.diag(out)


def _ground_places(pose: Pose, camera: Camera, z: float) -> Array:
    """(k, 3) places at height z that the picture shows, those seen too flatly left out."""
    px = GRID * [camera.width - 1, camera.height - 1]
    ray = rays(camera, px) @ pose.cam_R_map
    steep = np.hypot(ray[:, 0], ray[:, 1]) < -ray[:, 2] * STEEPEST
    ray = ray[steep]
    return np.asarray(pose.map_C + ray * ((z - pose.map_C[2]) / ray[:, 2])[:, None])


def without(ties: TiePoints, gone: Mapping[int, str]) -> TiePoints:
    """Tie points without the observations of photos, and without points seen only once then."""
    keep = ~np.isin(ties.photo, list(gone))
    keep &= (np.bincount(ties.point[keep], minlength=len(ties.xyz)) >= 2)[ties.point]
    points, renumbered = np.unique(ties.point[keep], return_inverse=True)
    return TiePoints(
        xyz=ties.xyz[points],
        point=renumbered.astype(np.int64),
        photo=ties.photo[keep],
        px=ties.px[keep],
        residual_px=ties.residual_px[keep],
    )
