"""Shortest ways around closed places: a visibility graph (Lozano-Perez and Wesley 1979)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra
from shapely import GeometryCollection, intersects, linestrings, points, prepare, union_all
from shapely.geometry.base import BaseGeometry

from skyquilt.planning.records import Array

MOST_CORNERS = 160
"""Largest number of corners to fly around; outlines with more are simplified outwards."""
SLACK = 0.02
"""Ways may touch the outline that keeps the clearance; they are tested against one so much closer,
m.
"""
CHUNK = 200_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Airspace:
    """Where drones may fly at the height of the photos."""

    closed: BaseGeometry
    """Closed places with their clearance."""
    corners: Array
    """(k, 2) corners around which ways turn."""
    shortest: Array
    """(k, k) lengths between corners; infinite where there is no way."""
    before: NDArray[np.int32]
    """(k, k) the corner before the second on the way from the first."""

    def free(self, a: Array, b: Array) -> NDArray[np.bool_]:
        """(n,) whether the straight ways from a (n, 2) to b (n, 2) stay clear."""
        if self.closed.is_empty:
            return np.ones(len(a), bool)
        west, south, east, north = self.closed.bounds
        low, high = np.minimum(a, b), np.maximum(a, b)
        clear = (
            (high[:, 0] < west) | (low[:, 0] > east) | (high[:, 1] < south) | (low[:, 1] > north)
        )
        prepare(self.closed)
        rest = np.flatnonzero(~clear)
        for k in range(0, len(rest), CHUNK):
            part = rest[k : k + CHUNK]
            lines = linestrings(np.stack([a[part], b[part]], axis=1))
            clear[part] = ~intersects(self.closed, lines)
        return np.asarray(clear)

    def inside(self, xy: Array) -> NDArray[np.bool_]:
        """(n,) whether places (n, 2) are closed."""
        prepare(self.closed)
        return np.asarray(intersects(self.closed, points(np.asarray(xy, np.float64))))


def make_airspace(shapes: Sequence[BaseGeometry], clearance: float) -> Airspace:
    """The airspace around closed places, with a clearance in m."""
    grown = union_all([s.buffer(max(clearance, 0.05), join_style="mitre", mitre_limit=1.5)
                       for s in shapes])  # fmt: skip
    outlines = [p for p in getattr(grown, "geoms", [grown]) if not p.is_empty]
    tolerance = 0.25 * max(clearance, 1.0)
    while sum(len(p.exterior.coords) for p in outlines) > MOST_CORNERS and tolerance < 1000:
        grown = union_all([p.buffer(tolerance, join_style="mitre", mitre_limit=1.5)
                           .simplify(tolerance) for p in outlines])  # fmt: skip
        outlines = list(getattr(grown, "geoms", [grown]))
        tolerance *= 2
    closed = grown.buffer(-SLACK, join_style="mitre") if outlines else GeometryCollection()
    around = np.array([c for p in outlines for c in _convex(np.array(p.exterior.coords))])
    corners = around.reshape(-1, 2)
    bare = Airspace(closed=closed, corners=corners, shortest=np.empty((0, 0)),
                    before=np.empty((0, 0), np.int32))  # fmt: skip
    if not len(corners):
        return bare
    lengths = _straight(bare, corners, corners)
    np.fill_diagonal(lengths, 0.0)
    graph = np.where(np.isfinite(lengths), lengths, 0.0)
    shortest, before = dijkstra(graph, directed=False, return_predecessors=True)
    return Airspace(closed=closed, corners=corners, shortest=shortest, before=before)


def _convex(ring: Array) -> Array:
    """Corners of an outline around which a taut rope may bend."""
    xy = ring[:-1]
    a, b = xy - np.roll(xy, 1, axis=0), np.roll(xy, -1, axis=0) - xy
    turn = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = 0.5 * float(np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1]))
    return np.asarray(xy[turn * np.sign(area) > 0])


def _straight(space: Airspace, a: Array, b: Array) -> Array:
    """(n, m) lengths of free straight ways; infinite where closed."""
    n, m = len(a), len(b)
    i, j = np.repeat(np.arange(n), m), np.tile(np.arange(m), n)
    free = space.free(a[i], b[j]).reshape(n, m)
    length = np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])
    return np.where(free, length, np.inf)


@dataclass(frozen=True, kw_only=True, eq=False)
class Ways:
    """Shortest ways between places."""

    space: Airspace
    """The airspace."""
    places: Array
    """(n, 2)."""
    length: Array
    """(n, n) in m; infinite where there is no way."""
    first: NDArray[np.int32]
    """(n, n) corner at which the way first turns; -1 where it is straight."""
    last: NDArray[np.int32]
    """(n, n) corner at which it turns last."""

    def way(self, i: int, j: int) -> Array:
        """The way (k, 2) from place i to place j."""
        if self.first[i, j] < 0:
            return self.places[[i, j]]
        a, b = int(self.first[i, j]), int(self.last[i, j])
        return np.concatenate(
            [self.places[[i]], self.space.corners[corner_way(self.space, a, b)], self.places[[j]]]
        )


def corner_way(space: Airspace, a: int, b: int) -> list[int]:
    """Indices of the corners on the way from corner a to corner b, both included."""
    found = [b]
    while found[-1] != a:
        found.append(int(space.before[a, found[-1]]))
    return found[::-1]


def ways_between(space: Airspace, places: Array) -> Ways:
    """The shortest ways between places (n, 2)."""
    n = len(places)
    length = np.hypot(
        places[:, None, 0] - places[None, :, 0], places[:, None, 1] - places[None, :, 1]
    )
    first = np.full((n, n), -1, np.int32)
    last = first.copy()
    i, j = np.triu_indices(n, 1)
    blocked = ~space.free(places[i], places[j])
    i, j = i[blocked], j[blocked]
    if len(i):
        _around(space, places, i, j, length, first, last)
    return Ways(space=space, places=places, length=length, first=first, last=last)


def _around(
    space: Airspace,
    places: Array,
    i: NDArray[np.int64],
    j: NDArray[np.int64],
    length: Array,
    first: NDArray[np.int32],
    last: NDArray[np.int32],
) -> None:
    """Fills in the blocked pairs."""
    direct = _straight(space, places, space.corners)
    reach = np.full_like(direct, np.inf)  # to each corner, the last one of a way
    start = np.zeros(direct.shape, np.int32)
    for a in range(len(space.corners)):
        through = direct[:, a : a + 1] + space.shortest[a][None, :]
        better = through < reach
        reach[better] = through[better]
        start[better] = a
    step = max(1, 8_000_000 // max(1, len(space.corners)))
    for k in range(0, len(i), step):
        p, q = i[k : k + step], j[k : k + step]
        total = reach[p] + direct[q]
        b = np.argmin(total, axis=1)
        best = total[np.arange(len(p)), b]
        a = start[p, b]
        length[p, q] = length[q, p] = best
        found = np.isfinite(best)
        first[p, q] = last[q, p] = np.where(found, a, -1)
        last[p, q] = first[q, p] = np.where(found, b, -1)
