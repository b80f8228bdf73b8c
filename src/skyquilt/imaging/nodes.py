"""What each photo sees of the map: coarse grids of the photo pixels of map points."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import monotone_radius, pixel_planes
from skyquilt.imaging.view_limits import USUAL, ViewLimits
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Pose
from skyquilt.model.raster import Grid, Window
from skyquilt.model.surface import Surface

AT_ONCE = 200_000
"""Nodes, over all photos, that are projected at once, about, to bound memory."""
STEP = 16
"""Map pixels between the nodes at which photos are projected; positions in between are
interpolated.

Nodes are the centres of STEP x STEP cells, with one ring of cells around a window: then OpenCV's
resize, ten times as fast as a general warp, interpolates them exactly.
"""
CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""Corners of a square about its centre."""
STRAIGHT_PX = 0.05
"""Photo pixels by which a pixel's way from the lowest to the highest level may bend unnoticed."""
BORDER_PX = 2.0
"""Width in photo pixels of the border that is not used."""


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """One placed photo."""

    photo: int
    """Index of the photo."""
    camera: Camera
    """Its calibration."""
    pose: Pose
    """Its exterior orientation."""
    footprint: NDArray[np.float64]
    """(k, 2) outline on the ground in m (map frame)."""
    limits: ViewLimits = USUAL
    """What it may show."""

    @property
    def middle(self) -> NDArray[np.float64]:
        """(2,) middle of what it shows in m (map frame): of the footprint's bounding box."""
        return np.asarray((self.footprint.min(0) + self.footprint.max(0)) / 2)

    def overlaps(self, bounds: tuple[float, float, float, float]) -> bool:
        """Whether the footprint's bounding box intersects bounds (west, south, east, north)."""
        low, high = self.footprint.min(0), self.footprint.max(0)
        return bool(
            low[0] < bounds[2]
            and high[0] > bounds[0]
            and low[1] < bounds[3]
            and high[1] > bounds[1]
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Nodes:
    """Photo pixels of the nodes of a window, for one photo."""

    view: View
    """The photo."""
    u: NDArray[np.float32]
    """(r, c) photo columns in px."""
    v: NDArray[np.float32]
    """(r, c) photo rows in px."""
    score: NDArray[np.float32]
    """(r, c) squared tangent of the angle off the vertical: small is better."""
    room: NDArray[np.float32]
    """(r, c) share left of what the photo may show; negative beyond its limits."""
    seen: NDArray[np.bool_]
    """(r, c) whether the node lies in the photo and within its limits."""
    real: NDArray[np.bool_]
    """(r, c) whether the projection is valid: in front of the camera, and where distortion does not
    fold back.
    """
    height: float
    """Median height of the camera above the window's ground in m."""
    step: int = STEP
    """Map pixels between neighbouring nodes."""
    levels: NDArray[np.float32] | None = None
    """(2, 3, r, c) photo columns and rows at the least, a middle and the greatest height of the map
    pixels, where heights step between nodes.
    """
    rise: NDArray[np.float32] | None = None
    """(2, h, w) how far each map pixel lies on its photo pixel's way from the least to the greatest
    height, 0 to 1; and the share of the way's bend there, 1 in the middle.
    """

    def reach(self, height: int, width: int) -> tuple[slice, slice]:
        """The columns and rows, at least one, of a photo of this size between which all map pixels
        lie.
        """
        u, v = (self.u, self.v) if self.levels is None else self.levels
        return _reach(u, width), _reach(v, height)

    def pixels(
        self, height: int, width: int, x: slice, y: slice
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Photo columns and rows (height, width) of the map pixels, counted from the start of these
        ranges.
        """
        start = np.float32(x.start), np.float32(y.start)
        if self.levels is None or self.rise is None:
            u, v = (
                densify(p - s, height, width, self.step)
                for p, s in zip((self.u, self.v), start, strict=True)
            )
            return u, v
        u, v = (
            _between(p, s, self.rise, self.step) for p, s in zip(self.levels, start, strict=True)
        )
        return u, v


def _reach(places: NDArray[np.float32], size: int) -> slice:
    """The range of pixels, of `size`, covered by a photo's node coordinates; at least one pixel."""
    start = min(max(int(places.min()) - 2, 0), size - 1)
    return slice(start, max(min(int(np.ceil(places.max())) + 3, size), start + 1))


def _between(
    p: NDArray[np.float32], start: np.float32, rise: NDArray[np.float32], step: int
) -> NDArray[np.float32]:
    """Photo columns or rows (h, w) from those of nodes at three levels, (3, r, c)."""
    (low, middle, high), (_, h, w) = p, rise.shape
    out = densify(high - low, h, w, step) * rise[0]
    out += densify(low - start, h, w, step)
    bend = middle - (low + high) / 2
    if np.abs(bend).max() > STRAIGHT_PX:
        out += densify(bend, h, w, step) * rise[1]
    return np.asarray(out)


def project_nodes(view: View, x: NDArray[Any], y: NDArray[Any], z: NDArray[Any]) -> Nodes:
    """Photo pixels and scores of nodes at map coordinates (r, c), or at k heights z (k, r, c) over
    them.
    """
    camera, C = view.camera, view.pose.map_C
    u, v, real = projected(view, x, y, z)
    real = np.broadcast_to(real, np.broadcast_shapes(x.shape, z.shape))
    drop = z - C[2]
    score = _scores(x - C[0], y - C[1], drop)
    room = view.limits.room(score, drop, x, y)
    if view.limits.blank is not None:
        room = np.minimum(room, view.limits.blank.at(u, v))
    return Nodes(
        view=view,
        u=u,
        v=v,
        room=room,
        seen=inside(camera, u, v) & (room >= 0),
        real=real,
        score=score,
        height=float(np.median(-drop)),
    )


def projected(
    view: View, x: NDArray[Any], y: NDArray[Any], z: NDArray[Any]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Photo columns and rows of places in m, and which are real."""
    camera = view.camera
    planes = view.pose.planes_to_camera(x, y, z)
    if view.pose.motion is not None:
        planes = _at_their_rows(planes, _swept(view.pose), camera.vector, camera.height)
    return _photo_pixels(planes, camera.vector, monotone_radius(camera))


def project_all(
    views: Sequence[View], x: NDArray[Any], y: NDArray[Any], z: NDArray[Any]
) -> list[Nodes]:
    """`project_nodes` for many views at the same nodes (r, c): several times as fast where the
    nodes are few.
    """
    if len(views) < 2 or any(v.pose.cam_H_map is not None for v in views):
        return [project_nodes(v, x, y, z) for v in views]
    if len(views) > (some := max(2, AT_ONCE // max(x.size, 1))):
        parts = [views[k : k + some] for k in range(0, len(views), some)]
        return [n for part in parts for n in project_all(part, x, y, z)]
    R = np.array([v.pose.cam_R_map for v in views]).transpose(1, 2, 0)[..., None, None]
    C = np.array([v.pose.map_C for v in views]).T[..., None, None]
    k = np.array([v.camera.vector for v in views])[:, None, None, :]
    limit = np.array([monotone_radius(v.camera) for v in views])[:, None, None]
    dx, dy, dz = x - C[0], y - C[1], z - C[2]
    across, down, depth = (row[0] * dx + row[1] * dy + row[2] * dz for row in R)
    width, height = np.array([(v.camera.width, v.camera.height) for v in views]).T[..., None, None]
    if any(v.pose.motion is not None for v in views):
        swept = np.array([_swept(v.pose) for v in views]).T[..., None, None]
        across, down, depth = _at_their_rows((across, down, depth), swept, k, height)
    u, v, real = _photo_pixels((across, down, depth), k, limit)
    seen, score = _within(u, v, width, height), _scores(dx, dy, dz)
    room = np.empty_like(score)
    for limits in {id(v.limits): v.limits for v in views}.values():
        mine = [n for n, v in enumerate(views) if v.limits is limits]
        room[mine] = limits.room(score[mine], dz[mine], x, y)
        if limits.blank is not None:
            room[mine] = np.minimum(room[mine], limits.blank.at(u[mine], v[mine]))
    seen &= room >= 0
    above = np.median(-dz.reshape(len(views), -1), axis=1).tolist()
    return [
        Nodes(
            view=view,
            u=u[n],
            v=v[n],
            score=score[n],
            room=room[n],
            seen=seen[n],
            real=real[n],
            height=above[n],
        )
        for n, view in enumerate(views)
    ]


def _swept(pose: Pose) -> tuple[float, ...]:
    """Movement in m along, and turn in rad about, the camera's axes during the readout: (6,)."""
    if pose.motion is None:
        return (0.0,) * 6
    return (*(pose.cam_R_map @ pose.motion.shift_m), *pose.motion.turn_rad)


def _at_their_rows(
    planes: tuple[NDArray[Any], NDArray[Any], NDArray[Any]],
    swept: Sequence[Any] | NDArray[Any],
    k: NDArray[Any],
    height: NDArray[Any] | int,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Points in coordinates of the camera as it stood when their rows were exposed.

    `planes`: coordinates in the camera of the middle row; `swept` as from `_swept`; `height` of the
    photo in px. A point's row follows from one Newton step, whose error is some thousandths of a
    pixel, since the camera moves by some pixels only.
    """
    across, down, depth = planes
    tx, ty, tz, rx, ry, rz = swept
    step = (
        ry * depth - rz * down - tx,
        rz * across - rx * depth - ty,
        rx * down - ry * across - tz,
    )
    ahead = np.maximum(depth, 1e-3)
    px, py = across / ahead, down / ahead
    _, row = pixel_planes(px, py, k)
    slope = k[..., 0] * k[..., 8] * (step[1] - py * step[2]) / ahead
    share = np.clip((row - (height - 1) / 2) / (height - 1 - slope), -1.0, 1.0)
    a, b, c = (at + share * moved for at, moved in zip(planes, step, strict=True))
    return a, b, c


def _photo_pixels(
    planes: tuple[NDArray[Any], NDArray[Any], NDArray[Any]],
    k: NDArray[Any],
    limit: NDArray[Any] | float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Photo columns and rows of points in camera coordinates, and which are real; `k` (..., 10),
    `limit`: the radius up to which the distortion is invertible.
    """
    across, down, depth = planes
    ahead = np.maximum(depth, 1e-3)
    px, py = across / ahead, down / ahead
    # behind the camera, or where the distortion polynomial folds back, a point has no pixel in the
    # photo
    real = (depth > 0.1) & (px * px + py * py < limit**2)
    u, v = (np.where(real, p, -1e4).astype(np.float32) for p in pixel_planes(px, py, k))
    return u, v, real


def _scores(dx: NDArray[Any], dy: NDArray[Any], dz: NDArray[Any]) -> NDArray[np.float32]:
    """Squared tangents of the angle off the vertical, for places at these offsets in m from a
    camera.
    """
    return np.asarray(((dx**2 + dy**2) / np.maximum(dz**2, 1e-6)).astype(np.float32))


def inside(camera: Camera, u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether photo pixels lie in the photo, its border excluded."""
    return _within(u, v, camera.width, camera.height)


def _within(
    u: NDArray[Any], v: NDArray[Any], width: NDArray[Any] | int, height: NDArray[Any] | int
) -> NDArray[np.bool_]:
    edge = BORDER_PX
    return np.asarray((u > edge) & (v > edge) & (u < width - 1 - edge) & (v < height - 1 - edge))


def inside_everywhere(
    nodes: Nodes, u: NDArray[np.float32], v: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Whether each pixel lies in the photo and within its limits, from dense photo pixels u, v (h,
    w) of these nodes.

    Next to a node without a real projection the interpolated u and v can fall anywhere in the
    photo: those pixels are False.
    """
    within = inside(nodes.view.camera, u, v)
    if (nodes.room < 0).any():
        within &= densify(nodes.room, u.shape[0], u.shape[1], nodes.step) >= 0
    if nodes.real.all():
        return within
    return within & (
        densify(nodes.real.astype(np.float32), u.shape[0], u.shape[1], nodes.step) > 0.999
    )


def node_places(
    grid: Grid, surface: Surface, window: Window, step: int = STEP
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """x, y, z in m, each (r + 2, c + 2), of the nodes of a window of r x c cells of `step` px."""
    columns = window.column + step * (np.arange(-1, -(-window.width // step) + 1) + 0.5) - 0.5
    rows = window.row + step * (np.arange(-1, -(-window.height // step) + 1) + 0.5) - 0.5
    x, y = np.meshgrid(grid.x(columns), grid.y(rows))
    return x, y, surface.at(x, y)


def even_places(
    surface: Surface, bounds: tuple[float, float, float, float], number: float
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """x, y, z in m, each (r, c), of about so many places of the ground, evenly spread inside bounds
    (west, south, east, north) in m.
    """
    west, south, east, north = bounds
    step = np.sqrt((east - west) * (north - south) / number)
    x, y = np.meshgrid(np.arange(west, east, step), np.arange(south, north, step))
    return x, y, surface.at(x, y)


def overlapping(views: Sequence[View], x: NDArray[Any], y: NDArray[Any]) -> list[View]:
    """The views whose footprint's bounding box intersects that of nodes at x, y (r, c) in m, rows
    southwards.
    """
    bounds = (float(x[0, 0]), float(y[-1, 0]), float(x[0, -1]), float(y[0, 0]))
    return [view for view in views if view.overlaps(bounds)]


def least_scores(
    views: Sequence[View], x: NDArray[Any], y: NDArray[Any], z: NDArray[Any]
) -> NDArray[np.float32]:
    """(views,) lower bound of the scores of nodes at x, y, z (r, c) in m, rows southwards, in each
    view.
    """
    east, north, up = np.array([v.pose.map_C for v in views]).reshape(-1, 3).T
    aside = np.maximum(np.maximum(x[0, 0] - east, east - x[0, -1]), 0.0)
    along = np.maximum(np.maximum(y[-1, 0] - north, north - y[0, 0]), 0.0)
    drop = np.maximum(np.maximum((up - z.min()) ** 2, (up - z.max()) ** 2), 1e-6)
    return np.asarray((aside**2 + along**2) / drop, np.float32)


def cut(nodes: Nodes, row: int, column: int, height: int, width: int) -> Nodes:
    """The nodes of a sub-window that starts at a multiple of STEP px from the window's corner."""
    step = nodes.step
    rows = slice(row // step, row // step - (-height // step) + 2)
    columns = slice(column // step, column // step - (-width // step) + 2)
    return Nodes(
        view=nodes.view,
        u=nodes.u[rows, columns],
        v=nodes.v[rows, columns],
        score=nodes.score[rows, columns],
        room=nodes.room[rows, columns],
        seen=nodes.seen[rows, columns],
        real=nodes.real[rows, columns],
        height=nodes.height,
        step=step,
    )


def densify(
    values: NDArray[np.float32], height: int, width: int, step: int = STEP
) -> NDArray[np.float32]:
    """Node values (r + 2, c + 2[, k]), `step` px apart, interpolated linearly at every pixel
    (height, width[, k]).
    """
    r, c = values.shape[:2]
    whole = cv2.resize(values, (c * step, r * step), interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole[step : step + height, step : step + width])
