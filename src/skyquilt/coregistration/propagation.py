"""Registration of two blocks from those pairs of photos that could be registered [Yahyanejad 2013,
5.2.3, (5.7)].

Photos of one spectral band are connected by homographies, which are reliable even with little
overlap. So correspondences between the bands found in one pair can be transferred to every other
pair and to both mosaics. One registered pair is enough; all pairs together are more accurate.
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
    """Index of the photo of the first band."""
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
    """(n, 2) in the frame of the first band."""
    px_b: NDArray[np.float64]
    """(n, 2) in the frame of the second band."""
    pair: NDArray[np.int64]
    """(n,) index of the pair of each correspondence."""


def carried(
    pairs: Sequence[PairPoints], common_H_a: Mapping[int, Matrix], common_H_b: Mapping[int, Matrix]
) -> Carried:
    """(5.7): R(x_V2, x_T2) = R(H_V1V2 x_V1, H_T1T2 x_T1), for all pairs whose photos are placed.

    The homographies map the pixels of each photo of a band to one frame: another photo of the band,
    or its mosaic.
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

    So a place covered by many pairs, or by many points of one pair, gets about the same weight as
    any other. The thesis names this double counting as the weakness of equal weights.
    """
    if not len(px):
        return np.zeros(0)
    tree = cKDTree(px)
    return 1 / np.asarray(tree.query_ball_point(px, radius, return_length=True), np.float64)


@dataclass(frozen=True, kw_only=True)
class Propagate:
    """One transform between two blocks from all of their registered pairs."""

    model: Model = "homography"
    """Type of the transform."""
    balanced: bool = True
    """Whether places seen in several pairs weigh no more than others."""
    radius: float = 0.05
    """Radius for the balanced weights, as a share of the extent of the points."""
    scale_px: float = 3.0
    """Error in px of b's frame above which the weight of a correspondence decreases (Cauchy)."""
    inlier_px: float = 9.0
    """Error in px below which it is an inlier."""
    minimum: int = 9
    """Fewest inliers."""
    least_pairs: int = 1
    """Fewest pairs that agree, that is, half of whose correspondences are inliers."""
    least_share: float = 0.0
    """Least share of all pairs that agree. One pair has hundreds of correspondences, so inliers
    alone do not tell whether pairs contradict each other.
    """
    steps: int = 20
    """Steps of reweighting."""
    version: ClassVar[int] = 2

    def __call__(
        self,
        pairs: Sequence[PairPoints],
        common_H_a: Mapping[int, Matrix],
        common_H_b: Mapping[int, Matrix],
    ) -> Registration | RefusedRegistration:
        """The registration of b's frame to a's, or the reason why there is none."""
        points = carried(pairs, common_H_a, common_H_b)
        if len(points.px_a) < self.minimum:
            reason = f"{len(points.px_a)} correspondences were found, {self.minimum} are needed"
            return RefusedRegistration(reason=reason)
        extent = float(np.linalg.norm(np.ptp(points.px_a, axis=0)))
        balance = (
            balanced_weights(points.px_a, self.radius * extent)
            if self.balanced
            else np.ones(len(points.px_a))
        )
        matrix, error = self._agreed(points, balance)
        if matrix is None or (error < self.inlier_px).sum() < self.minimum:
            return RefusedRegistration(
                reason="the correspondences of the pairs do not fit a common transform"
            )
        inside = error < self.inlier_px
        agreeing, of = _agreeing(points.pair, inside)
        if agreeing < max(self.least_pairs, self.least_share * of):
            return RefusedRegistration(
                reason=f"{agreeing} of {of} registered pairs agree on one transform"
            )
        return Registration(
            model="similarity" if self.model == "translation" else self.model,
            b_H_a=matrix,
            px_a=points.px_a[inside],
            px_b=points.px_b[inside],
            evidence={
                "correspondences": float(len(inside)),
                "pairs": float(of),
                "pairs_agreeing": float(agreeing),
            },
        )

    def _agreed(
        self, points: Carried, balance: NDArray[np.float64]
    ) -> tuple[Matrix | None, NDArray[np.float64]]:
        """The transform with which most pairs agree, and the error (n,) of each correspondence. It
        is fitted from that of all pairs, and where not all agree from that of each pair, since one
        pair far off keeps the first from the others.
        """
        best: tuple[Matrix | None, NDArray[np.float64]] = None, np.full(len(points.px_a), np.inf)
        most, known = -1, np.unique(points.pair)
        for one in (None, *known):
            of = slice(None) if one is None else points.pair == one
            start = fit(self.model, points.px_a[of], points.px_b[of], balance[of])
            matrix = self._fitted(points, balance, start)
            if matrix is None:
                continue
            error = np.linalg.norm(transfer(matrix, points.px_a) - points.px_b, axis=1)
            agreeing, _ = _agreeing(points.pair, error < self.inlier_px)
            if agreeing > most:
                best, most = (matrix, error), agreeing
            if most == len(known):
                break
        return best

    def _fitted(
        self, points: Carried, balance: NDArray[np.float64], matrix: Matrix | None
    ) -> Matrix | None:
        """Least squares with Cauchy weights from a start; their scale decreases from the median
        error.
        """
        for k in range(self.steps):
            if matrix is None:
                return None
            error = np.linalg.norm(transfer(matrix, points.px_a) - points.px_b, axis=1)
            scale = max(self.scale_px, float(np.median(error)) * 0.7**k)
            matrix = fit(self.model, points.px_a, points.px_b, balance / (1 + (error / scale) ** 2))
        return matrix


def _agreeing(pair: NDArray[np.int64], inside: NDArray[np.bool_]) -> tuple[int, int]:
    """Number of pairs half of whose correspondences are inliers, and of all pairs. `pair` (n,) and
    `inside` (n,) are those of each correspondence.
    """
    all_, good = np.bincount(pair), np.bincount(pair, weights=inside)
    return int(((all_ > 0) & (2 * good >= all_)).sum()), int((all_ > 0).sum())
