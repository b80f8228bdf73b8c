"""Heights of a growing map: a grid of cells filled from ground points, and the surface over any
part of it.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.neighbours import nearest
from skyquilt.model.surface import Surface

Cells = NDArray[np.int64]
WEIGHT = 0.4
"""Weight of new points in the height of a cell that already has one."""
AROUND = 9
"""Cells by which it is told how far heights have moved between them."""


BLOCK = 32
"""Cells along a side of the blocks in which they are stored, so that parts of the map are read as
arrays.
"""


@dataclass(kw_only=True)
class HeightCells:
    """Cells of a regular grid in the map frame, (column, row) from its origin, rows northwards."""

    cell: float
    """Side in m."""
    _blocks: dict[tuple[int, int], NDArray[np.float64]] = field(default_factory=dict)

    def add(
        self, xyz: NDArray[np.float64], *, anew: bool = False
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Adds points (P, 3) in m; `anew` replaces the former heights of their cells.

        Returns the cells touched, (k, 2) in order, and their heights now, (k,) in m.
        """
        place = np.floor(xyz[:, :2] / self.cell).astype(np.int64)
        cells, which = np.unique(place, axis=0, return_inverse=True)
        new = _medians(which.ravel(), xyz[:, 2])
        old = self.at(cells)
        z = np.where(np.isnan(old) | anew, new, old + WEIGHT * (new - old))
        self.put(cells, z)
        return cells, z

    def renew(
        self, xyz: NDArray[np.float64], own: NDArray[np.int64], gone: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Replaces the heights of all cells `own` (k, 2) of photos that were adjusted together by
        those of their ground points (P, 3) in m: cells without a point follow those around them up
        or down; they are removed where that is more than a cell, or `gone` (k,) says so, since the
        ground that they told of lies elsewhere now.

        Returns the cells touched, (n, 2), and their heights now, (n,) in m; NaN = removed.
        """
        before = self.at(own)
        cells, z = self.add(xyz, anew=True)
        touched = {*map(tuple, cells.tolist())}
        rest = np.array([cell not in touched for cell in map(tuple, own.tolist())], bool)
        step = self.at(own) - before
        if rest.any():
            known = np.flatnonzero(~rest)
            lift = np.full(int(rest.sum()), np.nan)
            if len(known):
                _, at = nearest(own[known], own[rest], min(AROUND, len(known)))
                lift = np.median(step[known][at], axis=1)
            lift[gone[rest] | ~(np.abs(lift) <= self.cell)] = np.nan
            self.put(own[rest], before[rest] + lift)
            cells = np.concatenate([cells, own[rest]])
            z = np.concatenate([z, before[rest] + lift])
        return cells, z

    def put(self, cells: NDArray[np.int64], z: NDArray[np.float64]) -> None:
        """Sets cells (k, 2) to heights (k,) in m; NaN = without a height."""
        for key, mine, (column, row) in _by_block(cells):
            held = self._blocks.setdefault(key, np.full((BLOCK, BLOCK), np.nan))
            held[row, column] = z[mine]

    def at(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """Heights (k,) in m of cells (k, 2); NaN where there is no point."""
        z = np.full(len(cells), np.nan)
        for key, mine, (column, row) in _by_block(cells):
            if (held := self._blocks.get(key)) is not None:
                z[mine] = held[row, column]
        return z

    def median(self, bounds: Iterable[float]) -> float | None:
        """Median height inside bounds (west, south, east, north) in m; None if there is no
        point.
        """
        z = self._known(bounds)[1]
        return float(np.median(z)) if len(z) else None

    def places(self, bounds: Iterable[float]) -> NDArray[np.float64]:
        """Centres (k, 2) in m of the cells with a height inside bounds (m, map frame)."""
        return np.asarray((self._known(bounds)[0] + 0.5) * self.cell, np.float64)

    def _known(self, bounds: Iterable[float]) -> tuple[Cells, NDArray[np.float64]]:
        """Cells (k, 2) with a height inside bounds, row by row, and their heights (k,); whatever
        the bounds, no more is looked at than what is stored.
        """
        c0, r0, c1, r1 = self._reach(bounds)
        cells, heights = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
        for (C, R), held in self._blocks.items():
            first, last = np.array([C, R]) * BLOCK, np.array([C, R]) * BLOCK + BLOCK - 1
            if (first > (c1, r1)).any() or (last < (c0, r0)).any():
                continue
            row, column = np.nonzero(np.isfinite(held))
            at = np.column_stack([column + C * BLOCK, row + R * BLOCK])
            inside = ((at >= (c0, r0)) & (at <= (c1, r1))).all(axis=1)
            cells.append(at[inside])
            heights.append(held[row, column][inside])
        found, z = np.concatenate(cells), np.concatenate(heights)
        order = np.lexsort(found.T)
        return found[order], z[order]

    def _reach(self, bounds: Iterable[float]) -> tuple[int, int, int, int]:
        c0, r0, c1, r1 = (int(np.floor(b / self.cell)) for b in bounds)
        return c0, r0, c1, r1

    def _part(self, c0: int, r0: int, c1: int, r1: int) -> NDArray[np.float64]:
        """Columns c0 ... c1 of rows r0 ... r1, both ends included."""
        z = np.full((r1 - r0 + 1, c1 - c0 + 1), np.nan)
        for R in range(r0 // BLOCK, r1 // BLOCK + 1):
            for C in range(c0 // BLOCK, c1 // BLOCK + 1):
                held = self._blocks.get((C, R))
                if held is not None:
                    row, column = max(r0, R * BLOCK), max(c0, C * BLOCK)
                    end_row, end_column = (
                        min(r1, R * BLOCK + BLOCK - 1) + 1,
                        min(c1, C * BLOCK + BLOCK - 1) + 1,
                    )
                    z[row - r0 : end_row - r0, column - c0 : end_column - c0] = held[
                        row - R * BLOCK : end_row - R * BLOCK,
                        column - C * BLOCK : end_column - C * BLOCK,
                    ]
        return z

    def surface(self, bounds: Iterable[float], otherwise: float) -> Surface:
        """Heights over bounds (west, south, east, north) in m: gaps are filled from their
        surroundings, and the result is slightly smoothed.
        """
        c0, r0, c1, r1 = self._reach(bounds)
        c0, r0, c1, r1 = c0 - 3, r0 - 3, c1 + 3, r1 + 3
        z = self._part(c0, r0, c1, r1).astype(np.float32)
        return Surface(
            z=_filled(z, otherwise),
            x0=(c0 + 0.5) * self.cell,
            y0=(r0 + 0.5) * self.cell,
            cell=self.cell,
            source="tie points",
        )


def _by_block(cells: Cells) -> Iterator[tuple[tuple[int, int], NDArray[np.bool_], Cells]]:
    """Groups cells (k, 2) by block: yields the block, the cells in it, and their columns and rows
    within it.
    """
    block, inner = np.divmod(cells, BLOCK)
    for column, row in np.unique(block, axis=0).tolist():
        mine = (block == (column, row)).all(1)
        yield (column, row), mine, inner[mine].T


def _medians(group: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The median of the values (n,) of each group 0, 1, 2 ..., none of them empty."""
    if not len(group):
        return np.zeros(0)
    number = np.bincount(group)
    ordered, first = values[np.lexsort((values, group))], np.cumsum(number) - number
    return np.asarray((ordered[first + (number - 1) // 2] + ordered[first + number // 2]) / 2)


def _filled(z: NDArray[np.float32], otherwise: float) -> NDArray[np.float32]:
    """Fills gaps from increasingly wide surroundings; outlier cells are replaced by their
    neighbours' median.
    """
    known = np.isfinite(z)
    if known.sum() < 4:
        return np.full(z.shape, np.median(z[known]) if known.any() else otherwise, np.float32)
    value, weight = np.where(known, z, 0).astype(np.float32), known.astype(np.float32)
    out, filled = np.full(z.shape, np.float32(np.median(z[known]))), np.zeros(z.shape, bool)
    for sigma in (1.0, 2.5, 6.0):
        w = cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        v = cv2.GaussianBlur(value, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT) / np.maximum(
            w, 1e-6
        )
        now = (w > 0.08) & ~filled
        out[now], filled = v[now], filled | now
    return np.asarray(cv2.medianBlur(out, 3), np.float32)
