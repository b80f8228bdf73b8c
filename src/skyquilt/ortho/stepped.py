"""Photo pixels of the map's pixels where heights step, so that nodes cannot be interpolated, or
bend between nodes, so that these must lie closer.

Photos are projected at the nodes of three levels. Along a vertical line a photo pixel moves, but
for distortion, in proportion to the reciprocal of its depth, so that the pixels at any height
between are interpolated, at a fraction of the cost of projecting each map pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import STEP, Nodes, View, inside, node_places, project_nodes, projected
from skyquilt.model.raster import Grid, Window
from skyquilt.model.surface import Surface

Places = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Eastings, northings and heights in m, of one shape."""


class Finer(Protocol):
    """Heights of a piece of the map that are finer than the nodes of a plan."""

    def places(self, part: "Part") -> Places:
        """The places of a part that are projected into the photo."""

    def seen(self, view: View, places: Places) -> Sequence[NDArray[Any]]:
        """How a photo sees places, for `placed`."""

    def placed(self, part: "Part", seen: Sequence[NDArray[Any]]) -> Nodes:
        """The nodes of a part on these heights, from how its places are seen."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """A photo over a part of a piece of the map."""

    nodes: Nodes
    """The nodes of the part."""
    row: int
    """First row in the piece, a multiple of STEP."""
    column: int
    """First column, a multiple of STEP."""
    height: int
    """Rows in px."""
    width: int
    """Columns in px."""

    def of(self, step: int) -> tuple[slice, slice]:
        """Rows and columns of the part's nodes among those of the piece, `step` px apart."""
        rows, columns = (
            slice(at // step, at // step - (-size // step) + 2)
            for at, size in ((self.row, self.height), (self.column, self.width))
        )
        return rows, columns


def lifted(parts: Sequence[tuple[Part, Finer | None]]) -> list[Nodes]:
    """The nodes of parts of pieces, on their finer heights if they have any. A photo is projected
    once for all its parts, in a fraction of the time.
    """
    out = [part.nodes for part, _ in parts]
    alike: dict[tuple[int, type], list[tuple[int, Part, Finer]]] = {}
    for k, (part, finer) in enumerate(parts):
        if finer is not None:
            alike.setdefault((part.nodes.view.photo, type(finer)), []).append((k, part, finer))
    for own in alike.values():
        places = [finer.places(part) for _, part, finer in own]
        x, y, z = (np.concatenate([p[axis].ravel() for p in places]) for axis in range(3))
        _, part, finer = own[0]
        seen = finer.seen(part.nodes.view, (x, y, z))
        start = 0
        for (k, part, finer), (x, _, _) in zip(own, places, strict=True):
            its = [found[start : start + x.size].reshape(x.shape) for found in seen]
            out[k], start = finer.placed(part, its), start + x.size
    return out


@dataclass(frozen=True, kw_only=True, eq=False)
class Closer:
    """Nodes of a piece of the map that lie closer than those of a plan."""

    x: NDArray[np.float64]
    """(r, c) eastings in m."""
    y: NDArray[np.float64]
    """(r, c) northings in m."""
    z: NDArray[np.float32]
    """(r, c) heights in m."""
    step: int
    """Map pixels between them."""

    def places(self, part: Part) -> Places:
        """The closer nodes."""
        at = part.of(self.step)
        return self.x[at], self.y[at], self.z[at]

    def seen(self, view: View, places: Places) -> Sequence[NDArray[Any]]:
        """All that `Nodes` hold."""
        n = project_nodes(view, *places)
        return n.u, n.v, n.score, n.room, n.seen, n.real

    def placed(self, part: Part, seen: Sequence[NDArray[Any]]) -> Nodes:
        """The closer nodes."""
        u, v, score, room, within, real = seen
        return replace(
            part.nodes, u=u, v=v, score=score, room=room, seen=within, real=real, step=self.step
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Stepped:
    """Heights of the pixels of a piece of the map."""

    x: NDArray[np.float64]
    """(r, c) eastings in m of the nodes of the piece."""
    y: NDArray[np.float64]
    """(r, c) northings in m."""
    levels: NDArray[np.float64]
    """(3, 1, 1) the least height in m of the pixels, one between and the greatest."""
    rise: NDArray[np.float32]
    """(2, h, w) how far the pixels' heights lie between them, as `Nodes.rise`."""

    @property
    def range_m(self) -> float:
        """Difference in m between the greatest and the least height."""
        return float(self.levels[2, 0, 0] - self.levels[0, 0, 0])

    def places(self, part: Part) -> Places:
        """The nodes at each level, (3, r, c)."""
        at = part.of(STEP)
        x, y, z = np.broadcast_arrays(self.x[at], self.y[at], self.levels)
        return x, y, z

    def seen(self, view: View, places: Places) -> Sequence[NDArray[Any]]:
        """Photo columns and rows, and which are real."""
        return projected(view, *places)

    def placed(self, part: Part, seen: Sequence[NDArray[Any]]) -> Nodes:
        """The nodes, with the places of the pixels at their heights. They are unchanged if the
        photo was placed in the plane, or if a level is not in front of the camera or its distortion
        folds back there.
        """
        (u, v, real), n = seen, part.nodes
        if n.view.pose.cam_H_map is not None or not (real | ~n.real).all():
            return n
        rows = slice(part.row, part.row + part.height)
        return replace(
            n,
            levels=np.stack([u, v]),
            rise=self.rise[:, rows, part.column : part.column + part.width],
            seen=n.seen & inside(n.view.camera, u, v).all(0),
        )


def stepped_heights(
    grid: Grid, surface: Surface, place: Window, views: Sequence[View]
) -> Stepped | None:
    """The heights of the pixels of a window of a grid, which these photos show; None where heights
    do not step.
    """
    rows, columns = (
        np.arange(at, at + n) for at, n in ((place.row, place.height), (place.column, place.width))
    )
    z = surface.stepped(grid.x(columns), grid.y(rows))
    if z is None:
        return None
    x, y, _ = node_places(grid, surface, place)
    levels, rise = _rises(z, float(np.median([v.pose.map_C[2] for v in views])))
    return Stepped(x=x, y=y, levels=levels, rise=rise)


def _rises(
    z: NDArray[np.float32], camera_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Three levels (3, 1, 1) of heights z (h, w) in m, the middle one half-way on a photo pixel's
    way, and how far the heights lie on it: `Nodes.rise`. `camera_m`: height of the cameras.
    """
    low, high = float(z.min()), float(z.max())
    above = max(camera_m - high, 0.1 * (high - low))
    ratio = above / (above + high - low)
    middle = low + (high - low) / (1 + ratio)
    share = (z - np.float32(low)) * np.float32(1 / (high - low))
    out = np.empty((2, *z.shape), np.float32)
    np.multiply(share, np.float32(1 - 1 / ratio), out=out[1])
    out[1] += np.float32(1 / ratio)
    np.divide(share, out[1], out=out[0])
    np.subtract(1, out[0], out=out[1])
    out[1] *= out[0]
    out[1] *= 4
    return np.array([low, middle, high])[:, None, None], out
