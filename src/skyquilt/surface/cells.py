"""Heights of a map that grows: a grid of cells that points of the ground fill, and the surface of any part of it."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.model.surface import Surface

WEIGHT = 0.4
"""How far a cell follows points that come later."""


@dataclass(kw_only=True)
class HeightCells:
    """Cells of a regular grid in the map frame, (column, row) from its origin, rows northwards."""

    cell: float
    """Side in m."""
    z: dict[tuple[int, int], float] = field(default_factory=dict)
    """Height in m of the cells that points have fallen into."""

    def add(self, xyz: NDArray[np.float64], *, anew: bool = False) -> set[tuple[int, int]]:
        """Takes in points (P, 3); `anew` replaces what their cells held. Returns the cells touched."""
        if not len(xyz):
            return set()
        place = np.floor(xyz[:, :2] / self.cell).astype(int)
        cells, which = np.unique(place, axis=0, return_inverse=True)
        touched = [(int(c), int(r)) for c, r in cells.tolist()]
        for at, new in zip(touched, _medians(which.ravel(), xyz[:, 2]).tolist(), strict=True):
            old = self.z.get(at)
            self.z[at] = new if old is None or anew else old + WEIGHT * (new - old)
        return set(touched)

    def median(self, bounds: Iterable[float]) -> float | None:
        """Median height inside bounds (west, south, east, north) in m; None where no point is."""
        c0, r0, c1, r1 = self._reach(bounds)
        found = [
            z for c in range(c0, c1 + 1) for r in range(r0, r1 + 1) if (z := self.z.get((c, r))) is not None
        ]
        return float(np.median(found)) if found else None

    def _reach(self, bounds: Iterable[float]) -> tuple[int, int, int, int]:
        c0, r0, c1, r1 = (int(np.floor(b / self.cell)) for b in bounds)
        return c0, r0, c1, r1

    def surface(self, bounds: Iterable[float], otherwise: float) -> Surface:
        """Heights over bounds (west, south, east, north) in m: gaps filled from around, smoothed a little."""
        c0, r0, c1, r1 = self._reach(bounds)
        c0, r0, c1, r1 = c0 - 3, r0 - 3, c1 + 3, r1 + 3
        z = np.array(
            [[self.z.get((c, r), np.nan) for c in range(c0, c1 + 1)] for r in range(r0, r1 + 1)], np.float32
        )
        return Surface(
            z=_filled(z, otherwise), x0=(c0 + 0.5) * self.cell, y0=(r0 + 0.5) * self.cell, cell=self.cell,
            source="tie points",
        )  # fmt: skip


def _medians(group: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The median of the values (n,) of each group 0, 1, 2 ..., none of them empty."""
    number = np.bincount(group)
    ordered, first = values[np.lexsort((values, group))], np.cumsum(number) - number
    return np.asarray((ordered[first + (number - 1) // 2] + ordered[first + number // 2]) / 2)


def _filled(z: NDArray[np.float32], otherwise: float) -> NDArray[np.float32]:
    """Gaps from ever wider surroundings; a wild cell gives way to its neighbours' median."""
    known = np.isfinite(z)
    if known.sum() < 4:
        return np.full(z.shape, np.median(z[known]) if known.any() else otherwise, np.float32)
    value, weight = np.where(known, z, 0).astype(np.float32), known.astype(np.float32)
    out, settled = np.full(z.shape, np.float32(np.median(z[known]))), np.zeros(z.shape, bool)
    for sigma in (1.0, 2.5, 6.0):
        w = cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        v = cv2.GaussianBlur(value, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT) / np.maximum(w, 1e-6)
        now = (w > 0.08) & ~settled
        out[now], settled = v[now], settled | now
    return np.asarray(cv2.medianBlur(out, 3), np.float32)
