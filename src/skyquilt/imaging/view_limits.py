"""What a placed photo may show: nothing near or above the horizon, nothing far from known heights.

A slanting ray turns an error of the height into a displacement of the picture, tan(angle) times as
large, and a pixel into a smear 1 / cos^2(angle) times as long.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.blank import Blank
from skyquilt.model.surface import Surface

Array = NDArray[np.float64]
WIDEST_DEG = 70.0
"""Angle from the vertical in degrees beyond which nothing is shown, unless asked otherwise."""
REACH = 1.0
"""Distance from the nearest tie point up to which photos are shown, in flying heights: beyond it
heights are a guess.
"""
SLANTING = 1.0
"""The same distance times the tangent of the angle from the vertical: a slanting view is displaced
by errors of heights, which grow with the distance.
"""
COARSEST = 5.0
"""Largest ground size of a photo's pixel, in median ground sizes of the survey, where another photo
shows the place.
"""
SIDES = 24
"""Sides of the polygons by which circles are replaced when outlines are cut."""
CELLS = 12
"""Cells of the raster of distances per reach."""
MOST_CELLS = 4e6
"""Most cells of that raster."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Support:
    """Where heights are known: within a distance of tie points."""

    away: Surface
    """Distance in m to the nearest tie point, as a raster that is wider than the reach."""
    reach_m: float
    """Largest distance."""
    outline: Array
    """(k, 2) convex outline of the supported area in m (map frame), counterclockwise."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewLimits:
    """Limits of one photo, or of all photos of a map."""

    angle_deg: float = WIDEST_DEG
    """Largest angle from the vertical in degrees."""
    coarsest_m: float = np.inf
    """Ground size of a photo's pixel in m beyond which other photos are preferred."""
    support: Support | None = None
    """Where heights are known; None = there are no tie points, and so no limit."""
    blanks: Mapping[int, Blank] = field(default_factory=dict)
    """Where photos show nothing, by their index; only of those that do not everywhere."""
    marks: Mapping[int, Blank] = field(default_factory=dict)
    """Where photos show marks (texts, logos), so that others are preferred, by their index."""
    blank: Blank | None = None
    """`blanks` of the one photo that these limits are of."""
    mark: Blank | None = None
    """`marks` of that photo."""

    def of(self, photo: int) -> "ViewLimits":
        """The limits of a photo (index): these, and where it shows nothing, or marks."""
        if photo not in self.blanks and photo not in self.marks:
            return self
        blank, mark = self.blanks.get(photo), self.marks.get(photo)
        return replace(self, blanks={}, marks={}, blank=blank, mark=mark)

    @property
    def tangent(self) -> float:
        """Tangent of the largest angle."""
        return float(np.tan(np.radians(min(self.angle_deg, 89.99))))

    def room(
        self, score: NDArray[Any], drop: NDArray[Any], x: NDArray[Any], y: NDArray[Any]
    ) -> NDArray[np.float32]:
        """What is left to the nearest limit, as a share of it; negative beyond.

        `score`: squared tangents of the angles from the vertical; `drop`: height in m of the places
        above the camera, so negative; x, y: the places, m in the map frame. All broadcast.
        """
        left = np.where(drop < 0, 1 - score / self.tangent**2, -1.0)
        if self.support is not None:
            away = self.support.away.at(x, y) / self.support.reach_m
            worst = np.maximum(away, away * np.sqrt(score) / SLANTING)
            left = np.minimum(left, 1 - worst)
        return np.asarray(left, np.float32)

    def cuts(self, C: Array, outline: Array, z: NDArray[Any]) -> bool:
        """Whether anything is cut off an outline (n, 2) at heights z (n,), seen from C (3,), all in
        m: its vertices are the most slanting and the farthest places.
        """
        d, drop = outline - C[:2], z - C[2]
        score = (d**2).sum(1) / np.maximum(drop**2, 1e-6)
        return bool((self.room(score, drop, *outline.T) < 1e-3).any())

    def below(self, direction: Array) -> Array:
        """The part (k, 3) of a pyramid of rays (n, 3), map frame, within the largest angle; empty
        if none is.
        """
        azimuth = 2 * np.pi * (np.arange(SIDES) + 0.5) / SIDES
        sides = np.column_stack(
            [-np.cos(azimuth), -np.sin(azimuth), np.full(SIDES, -self.tangent / _roundness())]
        )
        return cut(direction, sides)

    def supported(self, outline: Array) -> Array:
        """The part (k, 2) of an outline (n, 2) in m within the outline of known heights."""
        if self.support is None:
            return outline
        a = self.support.outline
        along = np.roll(a, -1, 0) - a
        inward = np.column_stack([-along[:, 1], along[:, 0]])
        sides = np.column_stack([inward, -(inward * a).sum(1)])
        return cut(np.column_stack([outline, np.ones(len(outline))]), sides)[:, :2]


USUAL = ViewLimits()
"""The largest angle alone."""


def _roundness() -> float:
    """Inner over outer radius of the polygon for a circle; outlines are cut outside the circle."""
    return float(np.cos(np.pi / SIDES))


def cut(polygon: Array, sides: Array) -> Array:
    """The part of a polygon (n, k) on the positive side of all linear functions (m, k)
    (Sutherland and Hodgman 1974); an outline on the ground in homogeneous coordinates, or a pyramid
    of rays.
    """
    for side in sides:
        if not len(polygon):
            break
        value = polygon @ side
        if (value >= 0).all():
            continue
        following, after = np.roll(polygon, -1, 0), np.roll(value, -1)
        kept = []
        for p, v, q, w in zip(polygon, value, following, after, strict=True):
            if v >= 0:
                kept.append(p)
            if (v >= 0) != (w >= 0):
                kept.append(p + (q - p) * (v / (v - w)))
        polygon = np.array(kept).reshape(-1, polygon.shape[1])
    return polygon if len(polygon) > 2 else polygon[:0]


def support_of(places: Array, reach_m: float) -> Support:
    """The support around places (n, 2) in m, at least one, as far as `reach_m`."""
    low, high = places.min(0) - 1.5 * reach_m, places.max(0) + 1.5 * reach_m
    cell = max(reach_m / CELLS, float(np.sqrt(np.prod(high - low) / MOST_CELLS)))
    columns, rows = (np.ceil((high - low) / cell).astype(int) + 1).tolist()
    empty = np.ones((rows, columns), np.uint8)
    at = np.rint((places - low) / cell).astype(int)
    empty[at[:, 1], at[:, 0]] = 0
    away = cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * np.float32(cell)
    raster = Surface(
        z=np.asarray(away, np.float32),
        x0=float(low[0]),
        y0=float(low[1]),
        cell=cell,
        source="distance",
    )
    return Support(away=raster, reach_m=reach_m, outline=_widened_hull(places, reach_m))


def _widened_hull(places: Array, by_m: float) -> Array:
    """The convex hull of places (n, 2), widened on all sides: (k, 2), counterclockwise."""
    azimuth = 2 * np.pi * np.arange(SIDES) / SIDES
    circle = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * by_m / _roundness()
    middle = places.mean(0)  # cv2 works in single precision
    rim = cv2.convexHull((places - middle).astype(np.float32))[:, 0, :]
    wide = (rim[:, None] + circle[None]).reshape(-1, 2).astype(np.float32)
    hull = cv2.convexHull(wide)[:, 0, :].astype(np.float64)
    area = hull[:, 0] @ np.roll(hull[:, 1], -1) - hull[:, 1] @ np.roll(hull[:, 0], -1)
    return np.asarray((hull if area > 0 else hull[::-1]) + middle)


def limits_for(
    xyz: Array, nadirs: Array, heights_m: NDArray[Any], angle_deg: float, gsd_m: float
) -> ViewLimits:
    """Limits of a map from its tie points (n, 3), the nadirs (k, 2) of photos without any, all in
    m, flying heights above ground and the median ground size of a pixel in m.
    """
    support = None
    if len(xyz):
        places = np.concatenate([xyz[:, :2], nadirs.reshape(-1, 2)])
        support = support_of(places, REACH * max(float(np.median(heights_m)), 1e-3))
    return ViewLimits(angle_deg=angle_deg, coarsest_m=COARSEST * gsd_m, support=support)


def ground_sizes(u: NDArray[Any], v: NDArray[Any], spacing_m: float) -> Array:
    """(r, c) longer side in m of a photo pixel on the ground, from photo pixels u, v (r, c) of
    places in a square grid.
    """
    (u_row, u_column), (v_row, v_column) = np.gradient(u), np.gradient(v)
    # the smaller singular value of the matrix of derivatives, px per grid step
    total = u_row**2 + u_column**2 + v_row**2 + v_column**2
    turn = np.abs(u_row * v_column - u_column * v_row)
    root = np.sqrt(np.maximum(total**2 - 4 * turn**2, 0))
    least = np.sqrt(np.maximum((total - root) / 2, 1e-12))
    return np.asarray(spacing_m / least)
