"""What each photo sees of the map: footprints, and the map's grid."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import rays
from skyquilt.imaging.nodes import CORNERS, View, project_nodes
from skyquilt.imaging.view_limits import USUAL, ViewLimits
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Alignment, Pose
from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface


def footprint(
    camera: Camera, pose: Pose, surface: Surface, *, per_side: int = 8, limits: ViewLimits = USUAL
) -> NDArray[np.float64]:
    """Outline (k, 2) in m of the image on the surface, (4 * per_side, 2) where its limits cut
    nothing off; empty if nothing is left.
    """
    s = np.linspace(0, 1, per_side, endpoint=False)
    w, h = camera.width - 1.0, camera.height - 1.0
    rim = np.concatenate(
        [
            np.c_[s * w, 0 * s],
            np.c_[0 * s + w, s * h],
            np.c_[w - s * w, 0 * s + h],
            np.c_[0 * s, h - s * h],
        ]
    )
    if pose.cam_H_map is not None:
        return _planar_footprint(rays(camera, rim), pose.cam_H_map)
    centre, ray = _exposed(pose, rays(camera, rim), rim[:, 1] / (camera.height - 1) - 0.5)
    direction = ray @ pose.cam_R_map
    if (np.hypot(*direction[:, :2].T) > -direction[:, 2] * limits.tangent).any():
        direction = limits.below(direction)
        if not len(direction):
            return np.zeros((0, 2))
        centre = np.broadcast_to(pose.map_C, direction.shape)
    return limits.supported(_meet(centre, direction, surface))


def _planar_footprint(rim: NDArray[Any], cam_H_map: NDArray[Any]) -> NDArray[np.float64]:
    """Points (n, 3) of the image plane on the map (n, 2) in m; empty if some of them lie beyond the
    horizon.
    """
    xyw = rim @ np.linalg.inv(cam_H_map).T
    if (xyw[:, 2] * np.sign(np.median(xyw[:, 2])) <= 1e-9).any():
        return np.zeros((0, 2))
    return np.asarray(xyw[:, :2] / xyw[:, 2:])


def make_views(alignment: Alignment, surface: Surface, limits: ViewLimits = USUAL) -> list[View]:
    """Views of all placed photos that show anything within the limits, in order of the photos."""
    views = []
    for photo, pose in sorted(alignment.poses.items()):
        camera = alignment.camera(photo)
        outline = footprint(camera, pose, surface, limits=limits)
        own = limits.of(photo)
        view = View(photo=photo, camera=camera, pose=pose, footprint=outline, limits=own)
        if len(outline) and (
            own.blank is not None or limits.cuts(pose.map_C, outline, surface.at(*outline.T))
        ):
            view = replace(view, footprint=_shown_outline(view, surface))
        if len(view.footprint):
            views.append(view)
    return views


def _shown_outline(view: View, surface: Surface) -> NDArray[np.float64]:
    """Convex outline (k, 2) in m of what a view shows within its limits, to a hundredth of its
    extent; empty if it shows nothing.
    """
    low, high = view.footprint.min(0), view.footprint.max(0)
    step = (high - low) / 100
    x, y = np.meshgrid(*(np.linspace(low[k], high[k], 101) for k in (0, 1)))
    seen = project_nodes(view, x, y, surface.at(x, y)).seen
    if not seen.any():
        return np.zeros((0, 2))
    shown = np.column_stack([x[seen], y[seen]])
    corners = (shown[:, None] + step * CORNERS).reshape(-1, 2)
    middle = corners.mean(0)  # cv2 works in single precision
    hull = cv2.convexHull((corners - middle).astype(np.float32))[:, 0]
    return np.asarray(hull + middle, np.float64)


def on_ground(view: View, px: NDArray[Any], surface: Surface) -> NDArray[np.float64]:
    """Positions (n, 3) in m (map frame) where the rays of pixels (n, 2) of a placed photo meet the
    surface.
    """
    at, pose = np.asarray(px, np.float64).reshape(-1, 2), view.pose
    ray = rays(view.camera, at)
    if pose.cam_H_map is not None:
        xyw = ray @ np.linalg.inv(pose.cam_H_map).T
        xy = xyw[:, :2] / xyw[:, 2:]
    else:
        centre, ray = _exposed(pose, ray, at[:, 1] / (view.camera.height - 1) - 0.5)
        xy = _meet(centre, ray @ pose.cam_R_map, surface)
    return np.column_stack([xy, surface.at(xy[:, 0], xy[:, 1])])


def _exposed(
    pose: Pose, ray: NDArray[Any], share: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centres (n, 3) in the map frame from which rays (n, 3) were taken, and the rays in the camera
    of the middle row; `share` (n,): -0.5 at the first row, 0.5 at the last.
    """
    if pose.motion is None:
        return np.broadcast_to(pose.map_C, ray.shape), ray
    centre = pose.map_C + share[:, None] * pose.motion.shift_m
    return centre, ray - share[:, None] * np.cross(pose.motion.turn_rad, ray)


def _meet(centre: NDArray[Any], direction: NDArray[Any], surface: Surface) -> NDArray[np.float64]:
    """Where rays from centres (n, 3), directions (n, 3) in the map frame, meet the surface: (n, 2)
    in m.
    """
    xy = np.array(centre[:, :2])
    for _ in range(6):
        drop = (surface.at(xy[:, 0], xy[:, 1]) - centre[:, 2]) / direction[:, 2]
        xy = centre[:, :2] + direction[:, :2] * drop[:, None]
    return xy


def native_gsd(views: Sequence[View], surface: Surface) -> float:
    """Median ground size in m of a photo pixel, at the image centres; the finer one of the two in
    the middle where these differ: half of the photos are of another camera, or flew higher.
    """
    C = np.array([v.pose.map_C for v in views])
    drop = C[:, 2] - surface.at(C[:, 0], C[:, 1])
    size = drop / np.array([v.camera.focal for v in views])
    middle, finer = float(np.median(size)), float(np.quantile(size, 0.5, method="lower"))
    return middle if middle < 1.2 * finer else finer  # their mean is the size of neither


def grid_of(
    views: Sequence[View], gsd: float, bounds: tuple[float, float, float, float] | None = None
) -> Grid:
    """The grid that covers all footprints, or the bounds (west, south, east, north)
    given, on multiples of gsd.
    """
    if bounds is None:
        low = np.min([v.footprint.min(0) for v in views], axis=0)
        high = np.max([v.footprint.max(0) for v in views], axis=0)
        bounds = (low[0], low[1], high[0], high[1])
    west, north = np.floor(bounds[0] / gsd) * gsd, np.ceil(bounds[3] / gsd) * gsd
    width = max(1, int(np.ceil((bounds[2] - west) / gsd)))
    height = max(1, int(np.ceil((north - bounds[1]) / gsd)))
    return Grid(west=float(west), north=float(north), gsd=gsd, width=width, height=height)
