"""Merges heights above the dominant planes of many pairs to heights above one plane: the mosaic of
disparities [Yahyanejad 2013, 5.2.3].

The heights of each pair refer to its own dominant plane, since its homography contains the slope of
the ground. Pairs that show the same ground must have equal heights, so a plane is added to each
pair such that they agree best.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags, hstack
from scipy.sparse.linalg import lsmr

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class OnePlane:
    """Least squares for the height of each cell of the ground and a plane for each pair, outliers
    down-weighted.
    """

    cells: int = 60
    """Cells along the longer side."""
    damping: float = 1e-3
    """Weight of a prior of zero for planes and heights, which holds undetermined ones."""
    rounds: int = 4
    """Rounds of reweighting (Cauchy's function)."""
    version: ClassVar[int] = 1

    def __call__(self, fields: Sequence[Array]) -> Array:
        """All points (n, 3): x, y, height in m, from those of the pairs (n_k, 3), without a general
        slope.
        """
        xyz = np.concatenate(fields)
        owner = np.repeat(np.arange(len(fields)), [len(f) for f in fields])
        middle, extent = xyz[:, :2].mean(0), max(float(np.ptp(xyz[:, :2], axis=0).max()), 1e-9)
        terms = np.c_[np.ones(len(xyz)), (xyz[:, :2] - middle) / extent]
        z = xyz[:, 2].copy()
        if len(fields) > 1:
            place = np.floor((xyz[:, :2] - xyz[:, :2].min(0)) / extent * self.cells).astype(
                np.int64
            )
            _, cell = np.unique(place @ [self.cells + 1, 1], return_inverse=True)
            z += self._planes(z, terms, owner, cell)
        z -= terms @ np.linalg.lstsq(terms, z, rcond=None)[0]
        return np.asarray(np.c_[xyz[:, :2], z])

    def _planes(
        self, z: Array, terms: Array, owner: NDArray[np.int64], cell: NDArray[np.int64]
    ) -> Array:
        """Height of each pair's plane at its points (n,)."""
        row = np.arange(len(z))
        column = 3 * owner[:, None] + np.arange(3)
        planes = csr_matrix((terms.ravel(), (np.repeat(row, 3), column.ravel())))
        both = hstack([planes, -csr_matrix((np.ones(len(z)), (row, cell)))]).tocsr()
        weight, change = np.ones(len(z)), np.zeros(len(z))
        for _ in range(self.rounds):
            root = np.sqrt(weight)
            solved = lsmr(diags(root) @ both, -z * root, damp=self.damping, maxiter=2000)[0]
            change = planes @ solved[: planes.shape[1]]
            lacking = z + both @ solved
            weight = 1 / (1 + (lacking / (1.48 * np.median(np.abs(lacking)) + 1e-9)) ** 2)
        return np.asarray(change)
