"""Heights of a growing map: a grid of cells filled from ground points, and the surface over any
part of it. The surface at a place is the same whatever part is asked for: tiles are drawn one by
one, and where two took the ground at their common edge for different heights, a straight seam would
run along it.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.neighbours import nearest
from skyquilt.model.surface import Surface

Cells = NDArray[np.int64]
Heights = NDArray[np.float32]
WEIGHT = 0.4
"""Weight of new points in the height of a cell that already has one."""
AROUND = 9
"""Cells by which it is told how far heights have moved between them."""


BLOCK = 32
"""Cells along a side of the blocks in which they are stored, so that parts of the map are read as
arrays.
"""
SQUARE = 8
"""Cells along a side of the squares whose median heights tell the ground far from known cells."""
BESIDE = 12
"""Known squares by which that is told."""
BEYOND = 256
"""Cells beyond which a known square tells nothing; the less, the further away the nearest is."""
WIDTHS = (1.0, 2.5, 6.0)
"""Standard deviations in cells of the surroundings from which gaps are filled, one after the
other.
"""
ENOUGH = 0.08
"""Share of known cells in surroundings from which they fill a gap alone; of fewer, wider ones or
ground far away count, too.
"""
REACH = 26
"""Cells around a part of the map on which its heights depend: OpenCV cuts Gaussians off after four
deviations.
"""


@dataclass(kw_only=True)
class HeightCells:
    """Cells of a regular grid in the map frame, (column, row) from its origin, rows northwards."""

    cell: float
    """Side in m."""
    _blocks: dict[tuple[int, int], NDArray[np.float64]] = field(default_factory=dict)
    _squares: dict[tuple[int, int], NDArray[np.float64]] = field(default_factory=dict)
    """Known squares of blocks, (k, 4): column and row of their middle in cells, median height in m,
    number of known cells; those of blocks that have changed since are missing.
    """

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
            self._squares.pop(key, None)

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
        """Heights over bounds (west, south, east, north) in m, slightly smoothed. Gaps are filled
        from their surroundings, and far from these from the ground nearest to them; `otherwise`:
        the height in m where nothing is known.
        """
        c0, r0, c1, r1 = self._reach(bounds)
        c0, r0, c1, r1 = c0 - 3, r0 - 3, c1 + 3, r1 + 3
        around = self._part(c0 - REACH, r0 - REACH, c1 + REACH, r1 + REACH).astype(np.float32)
        filled, share = _filled(around)
        if (share < 1).any():
            far = self._far(c0 - REACH, r0 - REACH, around.shape, otherwise)
            filled = share * filled + (1 - share) * far
        z = cv2.medianBlur(filled, 3)[REACH:-REACH, REACH:-REACH]
        return Surface(
            z=np.ascontiguousarray(z, np.float32),
            x0=(c0 + 0.5) * self.cell,
            y0=(r0 + 0.5) * self.cell,
            cell=self.cell,
            source="tie points",
        )

    def _far(self, c0: int, r0: int, shape: tuple[int, ...], otherwise: float) -> Heights:
        """Heights (rows, columns) of cells from (c0, r0) on, as far as they are told by known ones
        that are not near them.
        """
        known = self._squares_around(c0, r0, c0 + shape[1], r0 + shape[0])
        if not len(known):
            return np.full(shape, otherwise, np.float32)
        first = np.array([c0, r0]) // SQUARE - 1
        columns, rows = (np.array([c0 + shape[1], r0 + shape[0]]) // SQUARE + 2 - first).tolist()
        middles = (np.indices((rows, columns))[::-1].reshape(2, -1).T + first + 0.5) * SQUARE
        z = _told(known, middles, otherwise).reshape(rows, columns).astype(np.float32)
        at = (
            (np.arange(n) + low + 0.5) / SQUARE - 0.5 - f
            for n, low, f in zip(shape[::-1], (c0, r0), first, strict=True)
        )
        column, row = np.meshgrid(*(a.astype(np.float32) for a in at))
        return np.asarray(cv2.remap(z, column, row, cv2.INTER_LINEAR), np.float32)

    def _squares_around(self, c0: int, r0: int, c1: int, r1: int) -> NDArray[np.float64]:
        """Known squares (k, 4) that tell heights of columns c0 ... c1 of rows r0 ... r1."""
        low, high = -BEYOND - 2 * SQUARE, BEYOND + 2 * SQUARE
        found = [np.zeros((0, 4))]
        for R in range((r0 + low) // BLOCK, (r1 + high) // BLOCK + 1):
            for C in range((c0 + low) // BLOCK, (c1 + high) // BLOCK + 1):
                held, squares = self._blocks.get((C, R)), self._squares.get((C, R))
                if held is not None and squares is None:
                    squares = self._squares[C, R] = _squares((C, R), held)
                found += [] if squares is None else [squares]
        return np.concatenate(found)


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


def _squares(block: tuple[int, int], held: NDArray[np.float64]) -> NDArray[np.float64]:
    """Known squares (k, 4) of a block of cells, see `HeightCells._squares`."""
    row, column = np.nonzero(np.isfinite(held))
    number = row // SQUARE * BLOCK + column // SQUARE
    found, which, many = np.unique(number, return_inverse=True, return_counts=True)
    z = _medians(which.ravel(), held[row, column])
    corner = np.stack([found % BLOCK, found // BLOCK], 1) * SQUARE + np.array(block) * BLOCK
    return np.column_stack([corner + SQUARE / 2, z, many])


def _told(
    known: NDArray[np.float64], places: NDArray[np.float64], otherwise: float
) -> NDArray[np.float64]:
    """Heights (n,) in m at places (n, 2), in cells, by the known squares (k, 4) nearest to them:
    continuous, since the weight of the last of these is zero (Shepard's method as modified by
    Franke and Little).
    """
    distance, at = nearest(known[:, :2], places, min(BESIDE, len(known)))
    distance = np.maximum(distance, 0.5)
    last = distance[:, -1:] if len(known) >= BESIDE else float(BEYOND)
    weight = known[at, 3] * np.maximum(1 / distance - 1 / np.minimum(last, BEYOND), 1e-9) ** 2
    z = (weight * known[at, 2]).sum(1) / weight.sum(1)
    share = np.maximum(1 - distance[:, 0] / BEYOND, 0) ** 2
    return np.asarray(share * z + (1 - share) * otherwise)


def _filled(z: Heights) -> tuple[Heights, Heights]:
    """Fills gaps from increasingly wide surroundings; returns the heights and, from 0 to 1, how
    much they count against those of ground far away.
    """
    known = np.isfinite(z)
    value, weight = np.where(known, z, 0).astype(np.float32), known.astype(np.float32)
    out, share = np.zeros(z.shape, np.float32), np.zeros(z.shape, np.float32)
    for sigma in WIDTHS:
        w, v = (
            cv2.GaussianBlur(one, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
            for one in (weight, value)
        )
        more = (1 - share) * np.minimum(w / ENOUGH, 1)
        out += more * v / np.maximum(w, 1e-9)
        share += more
    return np.asarray(out / np.maximum(share, 1e-9), np.float32), np.asarray(share, np.float32)
