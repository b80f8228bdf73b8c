"""Registration of two blocks by the pairs that could be registered [Yahyanejad 2013, 5.2.3, (5.7)].

Photos of one spectrum are tied to one another by homographies, which hold even with little overlap.
So correspondences of one pair between spectra are correspondences of every other pair, and of both
mosaics: one pair that registers is enough, and all of them together are better.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from skyquilt.geometry.transforms import Model, fit, transfer
from skyquilt.model.registration import Matrix, RefusedRegistration, Registration


@dataclass(frozen=True, kw_only=True, eq=False)
class PairPoints:
    """Correspondences of one photo of a with one of b."""

    a: int
    """Index of the photo of the first spectrum."""
    b: int
    """Index of the photo of the second."""
    px_a: NDArray[np.float64]
    """(n, 2) px of photo a."""
    px_b: NDArray[np.float64]
    """(n, 2) px of photo b."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Carried:
    """Correspondences of all pairs in two common frames."""

    px_a: NDArray[np.float64]
    """(n, 2) in the frame of the first spectrum."""
    px_b: NDArray[np.float64]
    """(n, 2) in that of the second."""
    pair: NDArray[np.int64]
    """(n,) index of the pair that each comes from."""


def carried(
    pairs: Sequence[PairPoints], common_H_a: Mapping[int, Matrix], common_H_b: Mapping[int, Matrix]
) -> Carried:
    """(5.7): R(x_V2, x_T2) = R(H_V1V2 x_V1, H_T1T2 x_T1), for all pairs whose photos are placed.

    The homographies take pixels of each photo of a spectrum to one frame: another photo of it, or
    its mosaic.
    """
    known = [
        (k, p)
        for k, p in enumerate(pairs)
        if p.a in common_H_a and p.b in common_H_b and len(p.px_a)
    ]
    if not known:
        return Carried(px_a=np.zeros((0, 2)), px_b=np.zeros((0, 2)), pair=np.zeros(0, np.int64))
    return Carried(
        px_a=np.concatenate([transfer(common_H_a[p.a], p.px_a) for _, p in known]),
        px_b=np.concatenate([transfer(common_H_b[p.b], p.px_b) for _, p in known]),
        pair=np.concatenate([np.full(len(p.px_a), k, np.int64) for k, p in known]),
    )


def balanced_weights(px: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """(n,) one over the number of points within `radius` px, itself included.

    A place that many pairs see, or that one pair sees many times, then weighs about as much as any
    other: the thesis names the double counting as the flaw of fitting all points alike.
    """
    if not len(px):
        return np.zeros(0)
    tree = cKDTree(px)
    return 1 / np.asarray(tree.query_ball_point(px, radius, return_length=True), np.float64)


@dataclass(frozen=True, kw_only=True)
class Propagate:
    """One transform between two blocks from all of their registered pairs."""

    model: Model = "homography"
    """What is fitted."""
    radius: float = 0.05
    """Radius of balancing, as a share of the extent of the points."""
    scale_px: float = 3.0
    """Error in px of b's frame beyond which a correspondence counts ever less (Cauchy)."""
    inlier_px: float = 9.0
    """Error below which it is an inlier."""
    minimum: int = 9
    """Fewest inliers."""
    steps: int = 20
    """Of reweighting."""
    version: ClassVar[int] = 1

    def __call__(
        self,
        pairs: Sequence[PairPoints],
        common_H_a: Mapping[int, Matrix],
        common_H_b: Mapping[int, Matrix],
    ) -> Registration | RefusedRegistration:
        """b's frame on a's, or why there is no such transform."""
        points = carried(pairs, common_H_a, common_H_b)
        if len(points.px_a) < self.minimum:
            reason = (
                f"{len(points.px_a)} correspondences were carried, and {self.minimum} are needed"
            )
            return RefusedRegistration(reason=reason)
        extent = float(np.linalg.norm(np.ptp(points.px_a, axis=0)))
        balance = balanced_weights(points.px_a, self.radius * extent)
        matrix = self._fitted(points, balance)
        error = (
            None
            if matrix is None
            else np.linalg.norm(transfer(matrix, points.px_a) - points.px_b, axis=1)
        )
        if matrix is None or error is None or (error < self.inlier_px).sum() < self.minimum:
            return RefusedRegistration(
                reason="the pairs' correspondences agree on no common transform"
            )
        inside = error < self.inlier_px
        return Registration(
            model="similarity" if self.model == "translation" else self.model,
            b_H_a=matrix,
            px_a=points.px_a[inside],
            px_b=points.px_b[inside],
            evidence={
                "correspondences": float(len(inside)),
                "pairs": float(len(np.unique(points.pair))),
                "pairs_agreeing": float(len(np.unique(points.pair[inside]))),
            },
        )

    def _fitted(self, points: Carried, balance: NDArray[np.float64]) -> Matrix | None:
        """Least squares reweighted by Cauchy's function, its scale narrowing from the median
        error.
        """
        matrix = fit(self.model, points.px_a, points.px_b, balance)
        for k in range(self.steps):
            if matrix is None:
                return None
            error = np.linalg.norm(transfer(matrix, points.px_a) - points.px_b, axis=1)
            scale = max(self.scale_px, float(np.median(error)) * 0.7**k)
            matrix = fit(self.model, points.px_a, points.px_b, balance / (1 + (error / scale) ** 2))
        return matrix
