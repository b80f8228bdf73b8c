"""Photo pixels of the map's pixels where heights step, so that nodes cannot be interpolated, or
bend between nodes, so that these must lie closer.

Photos are projected at the nodes of three levels. Along a vertical line a photo pixel moves, but
for distortion, in proportion to the reciprocal of its depth, so that the pixels at any height
between are interpolated, at a fraction of the cost of projecting each map pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import STEP, Nodes, View, inside, node_places, project_nodes, projected
from skyquilt.model.raster import Grid, Window
from skyquilt.model.surface import Surface


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

    def lifted(self, n: Nodes, row: int, column: int, h: int, w: int) -> Nodes:
        """Nodes of a part (h, w) of the piece, which begins at a multiple of STEP px, replaced by
        the closer ones.
        """
        at = tuple(
            slice(k // self.step, k // self.step - (-size // self.step) + 2)
            for k, size in ((row, h), (column, w))
        )
        return replace(project_nodes(n.view, self.x[at], self.y[at], self.z[at]), step=self.step)


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

    def lifted(self, n: Nodes, row: int, column: int, h: int, w: int) -> Nodes:
        """Nodes of a part (h, w) of the piece, which begins at a multiple of STEP px, with the
        places of its pixels at their heights. They are unchanged if the photo was placed in the
        plane, or if a level is not in front of the camera or its distortion folds back there.
        """
        if n.view.pose.cam_H_map is not None:
            return n
        at = tuple(
            slice(k // STEP, k // STEP + size)
            for k, size in zip((row, column), n.u.shape, strict=True)
        )
        u, v, real = projected(n.view, self.x[at], self.y[at], self.levels)
        if not (real | ~n.real).all():
            return n
        return replace(
            n,
            levels=np.stack([u, v]),
            rise=self.rise[:, row : row + h, column : column + w],
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
