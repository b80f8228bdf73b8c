"""The bare ground: hills, other shapes of land, and level ponds."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy import sparse

from skyquilt.simulate.grid import Doubles, Floats, Grid
from skyquilt.simulate.noise import Noise
from skyquilt.simulate.terrain import Terrain, shaped, stands, stands_anywhere

_POND_RES = 0.25
_BANK_M = 9.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Basin:
    """Level of a pond, and the weight with which it levels the ground around it."""

    grid: Grid
    """Coarse grid over the pond and its banks."""
    pull: Floats
    """(height, width) weight: 1 in the water, falling to 0 at the top of the banks."""
    level: float
    """Water level, m above the base."""
    shore: Doubles
    """(n, 2) map polygon."""

    def weight(self, grid: Grid) -> Floats | None:
        """The weight on a window; None where the pond is far away."""
        own, (x0, x1, y0, y1) = self.grid, grid.span  # plain numbers: most ponds are far away
        if (x1 - own.left) / own.res - 0.5 - own.col < 0:
            return None
        if (own.top - y1) / own.res - 0.5 - own.row < 0:
            return None
        if (x0 - own.left) / own.res - 0.5 - own.col > own.width:
            return None
        if (own.top - y0) / own.res - 0.5 - own.row > own.height:
            return None
        u = self.grid.pixels(np.stack([grid.xs, np.full(grid.width, grid.ys[0])], axis=1))[:, 0]
        v = self.grid.pixels(np.stack([np.full(grid.height, grid.xs[0]), grid.ys], axis=1))[:, 1]
        uu, vv = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
        return np.asarray(
            cv2.remap(self.pull, uu, vv, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """Heights of the bare ground above the base elevation."""

    noise: Noise
    """Noise of the scene."""
    relief: float
    """Height between low and high places of a site, m."""
    shores: tuple[Doubles, ...] = ()
    """Outlines of the ponds."""
    kind: Terrain = "landscape"
    """Shape of the land besides its hills."""

    def hills(self, grid: Grid) -> Floats:
        """Heights without ponds; (height, width), m."""
        return shaped(self.kind, self._smooth(grid), grid)

    def _smooth(self, grid: Grid) -> Floats:
        coarse = max(
            1, int(1.0 / grid.res)
        )  # no wavelength below 10 m: compute it per metre and enlarge
        if coarse < 3 or min(grid.width, grid.height) < 8:
            return self.noise.fractal(grid, 170.0, 10.0, 0.42, 1) * np.float32(self.relief / 3.6)
        return _enlarged(self._smooth, grid, coarse)

    def heights(self, grid: Grid) -> Floats:
        """Heights (height, width), m above the base."""
        out = self.hills(grid)
        for basin in self.basins:
            weight = basin.weight(grid)
            if weight is not None:
                out = out + weight * (np.float32(basin.level) - out)
        return out

    def at(self, x: float, y: float) -> float:
        """Height of one point, m above the base."""
        return float(self.heights(_point(x, y))[0, 0])

    def stands(self, x: float, y: float) -> bool:
        """Whether a house, a tree or a target stands firmly there: not in a lake or on a cliff."""
        if stands_anywhere(self.kind):
            return True
        around = Grid(left=x - 2.5, top=y + 2.5, res=1.0, width=5, height=5)
        return stands(self.kind, self.hills(around), around)

    @cached_property
    def basins(self) -> tuple[Basin, ...]:
        """The ponds with their levels."""
        return tuple(self._basin(shore) for shore in self.shores)

    def _basin(self, shore: Doubles) -> Basin:
        level = min(float(self.hills(_point(x, y))[0, 0]) for x, y in shore[::6]) - 0.25
        left, top = shore[:, 0].min() - _BANK_M - 2, shore[:, 1].max() + _BANK_M + 2
        width, height = np.ptp(shore, axis=0) + 2 * _BANK_M + 4
        grid = Grid(
            left=float(left),
            top=float(top),
            res=_POND_RES,
            width=int(width / _POND_RES),
            height=int(height / _POND_RES),
        )
        dry = np.ones((grid.height, grid.width), dtype=np.uint8)
        cv2.fillPoly(dry, [np.round(grid.pixels(shore)).astype(np.int32)], 0)
        away = cv2.distanceTransform(dry, cv2.DIST_L2, 5) * _POND_RES
        fall = np.clip((away - 0.6) / _BANK_M, 0, 1)
        pull = (1 - fall * fall * (3 - 2 * fall)).astype(np.float32)
        return Basin(grid=grid, pull=pull, level=level, shore=shore)


def _point(x: float, y: float) -> Grid:
    return Grid(left=x - 0.5, top=y + 0.5, res=1.0, width=1, height=1)


def _enlarged(field: Callable[[Grid], Floats], grid: Grid, factor: int) -> Floats:
    """A smooth field computed on cells `factor` times as large, aligned with the unbounded
    raster.
    """
    c0, r0 = grid.col // factor - 1, grid.row // factor - 1
    c1, r1 = (grid.col + grid.width) // factor + 2, (grid.row + grid.height) // factor + 2
    large = Grid(
        left=grid.left,
        top=grid.top,
        res=grid.res * factor,
        col=c0,
        row=r0,
        width=c1 - c0,
        height=r1 - r0,
    )
    u = ((grid.col + np.arange(grid.width) + 0.5) / factor - 0.5 - c0).astype(np.float32)
    v = ((grid.row + np.arange(grid.height) + 0.5) / factor - 0.5 - r0).astype(np.float32)
    values = field(large)
    across = _linear(u, values.shape[1])
    down = _linear(v, values.shape[0])
    return np.asarray(cv2.transpose(across @ (down @ values).T))


def _linear(positions: Floats, count: int) -> sparse.csr_matrix:
    """Sparse matrix of linear interpolation."""
    base = np.clip(np.floor(positions).astype(np.int64), 0, count - 2)
    t = positions - base
    weights = np.stack([1 - t, t], axis=1).ravel()
    columns = np.stack([base, base + 1], axis=1).ravel()
    starts = np.arange(len(positions) + 1) * 2
    return sparse.csr_matrix((weights, columns, starts), shape=(len(positions), count))
