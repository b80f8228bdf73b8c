"""Heights above the dominant planes of many pairs, brought to one: the mosaic of disparities [Yahyanejad 2013, 5.2.3].

Each pair counts from its own dominant plane, and its homography has swallowed the slope of the ground. Where pairs
show the same ground their heights must agree, so each gets a plane of its own that makes them agree best.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class OnePlane:
    """Alternates between the mean of all pairs in each cell and each pair's plane towards it."""

    cells: int = 60
    """Cells along the longer side."""
    rounds: int = 40
    """Of the alternation."""
    damping: float = 0.02
    """Pull of each pair's plane towards none, as a share of its own points: what nothing else ties down stays."""
    version: ClassVar[int] = 1

    def __call__(self, fields: Sequence[Array]) -> Array:
        """All points (n, 3), x, y, height in m, of the pairs' own (n_k, 3), without a general slope."""
        xyz = np.concatenate(fields)
        owner = np.repeat(np.arange(len(fields)), [len(f) for f in fields])
        middle, extent = xyz[:, :2].mean(0), max(float(np.ptp(xyz[:, :2], axis=0).max()), 1e-9)
        terms = np.c_[np.ones(len(xyz)), (xyz[:, :2] - middle) / extent]
        place = np.floor((xyz[:, :2] - xyz[:, :2].min(0)) / extent * self.cells).astype(np.int64)
        _, cell = np.unique(place @ [self.cells + 1, 1], return_inverse=True)
        z = xyz[:, 2].copy()
        for _ in range(self.rounds if len(fields) > 1 else 0):
            z += self._towards(_smoothed(z, cell) - z, terms, owner)
        z -= terms @ np.linalg.lstsq(terms, z, rcond=None)[0]
        return np.c_[xyz[:, :2], z]

    def _towards(self, lacking: Array, terms: Array, owner: NDArray[np.int64]) -> Array:
        """Each pair's plane through what it lacks, at its points."""
        change = np.zeros(len(lacking))
        for k in range(int(owner.max()) + 1):
            mine = owner == k
            own = terms[mine].copy()
            own[:, 1:] -= own[:, 1:].mean(0)
            pull = self.damping * np.diag((own**2).sum(0))
            change[mine] = own @ np.linalg.solve(
                own.T @ own + pull + 1e-12 * np.eye(3), own.T @ lacking[mine]
            )
        return change


def _smoothed(z: Array, cell: NDArray[np.int64]) -> Array:
    """The mean of each point's cell, twice: outliers count little the second time."""
    number = np.bincount(cell)
    mean = np.bincount(cell, z) / number
    spread = 1.48 * float(np.median(np.abs(z - mean[cell]))) + 1e-9
    weight = 1 / (1 + ((z - mean[cell]) / spread) ** 2)
    return np.asarray((np.bincount(cell, z * weight) / np.bincount(cell, weight))[cell])
