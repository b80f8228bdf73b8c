"""Which cells of the ground each photo sees: footprints projected on the terrain.

A photo counts for a cell only where it sees the whole cell, corners and slope included, and nothing
stands between. So what holds for all cells holds for every place in them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rasterio.features import rasterize
from rasterio.transform import Affine
from shapely import box, intersects, prepare
from shapely.geometry.base import BaseGeometry

from skyquilt.planning.lattice import to_uv, turned
from skyquilt.planning.records import Area, Array, View
from skyquilt.planning.terrain import Terrain

Cuts = tuple[Sequence[float], Sequence[float]]
"""Edges along a heading and to its right, m."""
TOGETHER = 1000
"""Photos whose cells are counted at once."""
SAMPLES = 24
"""Places along a line of sight whose heights are compared with it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cells:
    """Rectangular cells over an area, aligned with a heading."""

    heading: float
    """Degrees; rows of cells run along it."""
    u: Array
    """(columns + 1,) edges along the heading, m."""
    v: Array
    """(rows + 1,) edges to the right, m."""
    size: float
    """Largest side of a cell in m."""
    inside: NDArray[np.bool_]
    """(rows, columns), True where a cell touches the area."""
    z: NDArray[np.float32]
    """(rows, columns) height of the ground in m."""
    rise: NDArray[np.float32]
    """(rows, columns) largest height difference within half a cell, m."""
    terrain: Terrain
    """The ground."""

    @property
    def areas(self) -> Array:
        """(rows, columns) in m2."""
        return np.diff(self.v)[:, None] * np.diff(self.u)[None, :]

    def centres(self, index: NDArray[np.int64]) -> Array:
        """Places (n, 3) of cells given by flat index."""
        rows, columns = np.divmod(index, self.inside.shape[1])
        uv = np.column_stack([middles(self.u)[columns], middles(self.v)[rows]])
        return np.column_stack([to_uv(uv, self.heading), self.z.ravel()[index]])


def middles(edges: Array) -> Array:
    """Between consecutive edges."""
    return np.asarray((edges[1:] + edges[:-1]) / 2)


def make_cells(
    area: Area, heading: float, size: float, terrain: Terrain, cuts: Cuts = ((), ())
) -> Cells:
    """The cells that touch an area; `cuts`: further edges along and to the right of the heading."""
    shape = turned(area, heading)
    left, low, right, high = shape.bounds
    u, v = _edges(left, right, size, cuts[0]), _edges(low, high, size, cuts[1])
    form = len(v) - 1, len(u) - 1
    inside = _touched(shape, u, v) if len(cuts[0]) else burnt(shape, u[0], v[0], size, form)
    gu, gv = np.meshgrid(middles(u), middles(v))
    xy = to_uv(np.column_stack([gu.ravel(), gv.ravel()]), heading)
    z = terrain.at(xy[:, 0], xy[:, 1]).reshape(form)
    dv, du = np.gradient(z) if terrain.known else (np.zeros_like(z), np.zeros_like(z))
    return Cells(
        heading=heading,
        u=u,
        v=v,
        size=size,
        inside=inside,
        z=z.astype(np.float32),
        rise=(0.5 * (np.abs(du) + np.abs(dv))).astype(np.float32),
        terrain=terrain,
    )


def _edges(low: float, high: float, size: float, cuts: Sequence[float]) -> Array:
    """Edges at most `size` apart that contain an interval and a cell more on both sides."""
    even = low - size + size * np.arange(int(np.ceil((high - low) / size)) + 3)
    within = [c for c in cuts if low < c < high]
    edges = np.unique(np.round(np.concatenate([even, [low, high], within]), 4)) if within else even
    return np.asarray(edges, np.float64)


def _touched(shape: BaseGeometry, u: Array, v: Array) -> NDArray[np.bool_]:
    """(rows, columns), True where a cell has more than an edge in common with a shape."""
    inner = shape.buffer(-0.001)
    inner = shape if inner.is_empty else inner
    prepare(inner)
    boxes = box(u[None, :-1], v[:-1, None], u[None, 1:], v[1:, None])
    return np.asarray(intersects(inner, boxes))


def burnt(
    shape: BaseGeometry, u0: float, v0: float, size: float, form: tuple[int, int]
) -> NDArray[np.bool_]:
    """(rows, columns), True where a square cell touches a shape in the cells' frame."""
    if shape.is_empty:
        return np.zeros(form, bool)
    affine = Affine(size, 0, u0, 0, size, v0)
    drawn = rasterize([shape], form, transform=affine, all_touched=True, dtype=np.uint8)
    return np.asarray(drawn > 0)


def seen_cells(
    cells: Cells, view: View, xyz: Array, yaw: float, *, blocked: bool
) -> NDArray[np.int32]:
    """Flat indices of the area's cells that a photo at (x, y, z) sees whole; `yaw` in degrees is
    where its top points. With `blocked`, lines of sight are checked.
    """
    columns = cells.inside.shape[1]
    (u, v), turn = to_uv(xyz[None, :2], cells.heading)[0], np.radians(yaw - cells.heading)
    s, c = np.sin(turn), np.cos(turn)
    far = max(float(xyz[2] - cells.z.min()), 0.0) * view.reach
    (j0, j1), (i0, i1) = _range(cells.u, u, far), _range(cells.v, v, far)
    if i0 >= i1 or j0 >= j1:
        return np.empty(0, np.int32)
    part = slice(i0, i1), slice(j0, j1)
    eu, ev = cells.u[j0 : j1 + 1], cells.v[i0 : i1 + 1]
    du, dv = (middles(eu) - u)[None, :], (middles(ev) - v)[:, None]
    ahead, aside = du * c + dv * s, dv * c - du * s
    # a cell is seen whole: its corner farthest out, on the ground nearest to the camera
    depth = xyz[2] - cells.z[part] - cells.rise[part]
    hu, hv = 0.5 * np.diff(eu)[None, :], 0.5 * np.diff(ev)[:, None]
    ha, hs = hu * abs(c) + hv * abs(s), hv * abs(c) + hu * abs(s)
    found = (
        cells.inside[part]
        & (depth > 0)
        & (ahead + ha <= view.up * depth)
        & (ha - ahead <= view.down * depth)
        & (aside + hs <= view.right * depth)
        & (hs - aside <= view.left * depth)
    )
    r, k = np.nonzero(found)
    index = (r + i0) * columns + k + j0
    if blocked and len(index):
        index = index[_in_sight(cells, xyz, index)]
    return np.asarray(index, np.int32)


def _range(edges: Array, middle: float, reach: float) -> tuple[int, int]:
    """The cells between two edges within a distance of a place."""
    low, high = np.searchsorted(edges, [middle - reach, middle + reach])
    return max(int(low) - 1, 0), min(int(high), len(edges) - 1)


def _in_sight(cells: Cells, xyz: Array, index: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether the ground stays below the lines from a camera to cells."""
    ends = cells.centres(index)
    share = (np.arange(1, SAMPLES) / SAMPLES)[None, :]
    x, y, z = (xyz[k] + (ends[:, k, None] - xyz[k]) * share for k in range(3))
    slack = cells.rise.ravel()[index][:, None] + 0.02 * cells.size
    return np.asarray((cells.terrain.at(x, y) <= z + slack).all(axis=1))


def sight_may_be_blocked(view: View, terrain: Terrain) -> bool:
    """Whether any slope of the ground is steeper than the steepest line of sight's complement."""
    return terrain.steepest() > 1 / view.reach


def all_seen(
    cells: Cells, view: View, xyz: Array, yaw: Array, *, blocked: bool
) -> list[NDArray[np.int32]]:
    """The cells that each of n photos sees; photos of one place share them."""
    if not len(xyz):
        return []
    poses, which = np.unique(np.column_stack([xyz, yaw]), axis=0, return_inverse=True)
    found = [seen_cells(cells, view, p[:3], float(p[3]), blocked=blocked) for p in poses]
    return [found[k] for k in which.ravel().tolist()]


def counted(cells: Cells, seen: Sequence[NDArray[np.int32]]) -> NDArray[np.int32]:
    """Number of views of every cell, flat."""
    count = np.zeros(cells.inside.size, np.int32)
    for start in range(0, len(seen), TOGETHER):
        some = np.concatenate(seen[start : start + TOGETHER])
        count += np.bincount(some, minlength=len(count)).astype(np.int32)
    return count
