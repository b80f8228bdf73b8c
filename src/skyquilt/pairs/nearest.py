"""Candidate pairs from positions: near neighbours, neighbours in time, and retrieval for the
lost.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.neighbours import nearest

Pair = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class Nearest:
    """Photos whose footprints can overlap by the measured positions.

    Altitudes lie (A2 of the methods), so the footprint is not computed from them here: the caller
    gives the ground distance within which photos overlap, learnt from links already found, or None
    to take neighbours only.
    """

    neighbours: int = 12
    """Most neighbours by distance per photo."""
    version: ClassVar[int] = 1

    def __call__(self, map_xy: NDArray[Any], reach_m: float | None = None) -> list[Pair]:
        """Pairs i < j of photos with positions (n, 2) in m (NaN where unknown), nearest first."""
        known = np.flatnonzero(np.isfinite(map_xy).all(1))
        if len(known) < 2:
            return []
        distance, index = nearest(
            map_xy[known], map_xy[known], min(self.neighbours + 1, len(known))
        )
        found: dict[Pair, float] = {}
        for row, (ds, js) in enumerate(zip(distance, index, strict=True)):
            for d, j in zip(ds, js, strict=True):
                if j != row and (reach_m is None or d <= reach_m):
                    i, k = sorted((int(known[row]), int(known[j])))
                    found[i, k] = float(d)
        return sorted(found, key=lambda pair: (found[pair], pair))


def sequence(count: int, step: int = 1) -> list[Pair]:
    """Each photo with the next `step` photos in order of capture."""
    return [(i, i + k) for k in range(1, step + 1) for i in range(count - k)]
