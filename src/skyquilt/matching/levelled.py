"""Levelled features: the features on the dominant plane (Yahyanejad 2013, 4.2.2)."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.refine import refine
from skyquilt.geometry.transforms import MINIMAL, fit, symmetric_transfer_errors, transfer
from skyquilt.model.estimate import Estimate

Doubles = NDArray[np.float64]

WORKING_WIDTH = 1500
"""Image width in px for which (4.9) is defined."""
SHARE = 0.1
"""Height variation over flight altitude if either is unknown."""
_NODES = 200
"""Nodes along the longer side at which a depth map is interpolated."""


def threshold_px(relief_m: float | None, height_m: float | None) -> int:
    """(4.9): eps_d in px at a working width of 1500, from the largest height variation and the
    least altitude.
    """
    share = SHARE if relief_m is None or height_m is None else relief_m / height_m
    # 50 * 0.1 is slightly more than 5 in binary; the result must not become 6
    return max(1, math.ceil(round(50 * share, 9)))


@dataclass(frozen=True, kw_only=True, eq=False)
class LevelledFeatures:
    """A transformation from the features of the dominant plane."""

    estimate: Estimate
    """Estimate with the levelled features as its inliers; the former one if there are too few."""
    d_px: Doubles
    """(M, 2) disparity vectors of the former inliers before the removal [(4.8)]."""
    level: NDArray[np.bool_]
    """(M,) which of them are levelled."""
    eps_px: float
    """Largest disparity of a levelled feature, px [(4.9)]."""


@dataclass(frozen=True, kw_only=True)
class Level:
    """Removes inliers whose disparity after the transformation exceeds eps_d, and fits again.

    A fit to all inliers lies between the ground and the objects on it, so that much of the ground
    would be removed. Disparities are therefore measured from the dominant plane, as intended in the
    thesis: from a robust fit whose weights decrease with the disparity, more steeply in each
    iteration.
    """

    relief_m: float | None = None
    """Largest height variation on the ground, m."""
    height_m: float | None = None
    """Least flight altitude above it, m; if either is None, their quotient is taken as 0.1."""
    width: int = WORKING_WIDTH
    """Width in px of the images in which points are given; eps_d holds for 1500 and is scaled with
    the width.
    """
    version: ClassVar[int] = 1

    def __call__(self, a: Doubles, b: Doubles, estimate: Estimate) -> LevelledFeatures:
        """From the matches a, b (N, 2) px and the estimate from them; only its inliers are used."""
        a, b = a[estimate.inliers], b[estimate.inliers]
        eps = max(1.0, threshold_px(self.relief_m, self.height_m) * self.width / WORKING_WIDTH)
        d = disparities(_dominant(estimate, a, b, eps), a, b)
        level = np.linalg.norm(d, axis=1) <= eps
        model = estimate.model
        fitted = fit(model, a[level], b[level]) if level.sum() > MINIMAL[model] else None
        if fitted is None:
            return LevelledFeatures(
                estimate=estimate, d_px=d, level=np.ones(len(d), bool), eps_px=eps
            )
        H = refine(model, fitted, a[level], b[level])
        inliers = estimate.inliers.copy()
        inliers[inliers] = level
        ste = float(symmetric_transfer_errors(H, a[level], b[level]).mean())
        new = replace(estimate, b_H_a=H, inliers=inliers, ste_per_inlier=ste)
        return LevelledFeatures(estimate=new, d_px=d, level=level, eps_px=eps)


def _dominant(estimate: Estimate, a: Doubles, b: Doubles, eps: float) -> Doubles:
    """b_H_a of the plane on which most points lie, by reweighting with a narrowing Geman-McClure
    loss, down to half of eps.
    """
    H = estimate.b_H_a
    d2 = (disparities(H, a, b) ** 2).sum(1)
    scale = max(eps, 2 * math.sqrt(float(d2.max(initial=0.0))))
    while scale > eps / 2:
        scale /= 1.4
        fitted = fit(estimate.model, a, b, (1 + d2 / scale**2) ** -2.0)
        if fitted is None:
            return H
        H = fitted
        d2 = (disparities(H, a, b) ** 2).sum(1)
    return H


def disparities(b_H_a: Doubles, a: Doubles, b: Doubles) -> Doubles:
    """(N, 2) px: from the transformed position of each point of a to its match in b [(4.8)]."""
    return np.asarray(b - transfer(b_H_a, a))


def depth_map(px: Doubles, d_px: Doubles, shape: tuple[int, int]) -> NDArray[np.float32]:
    """DM (H, W, 3) in [0, 1] of disparities d_px (M, 2) at px (M, 2): red d_x, green |d|, blue d_y
    [(4.8)].

    Each channel is scaled from its smallest to its largest value; 0.5 if all are equal. Values are
    interpolated linearly between points and taken from the nearest point outside of them. All 0.5
    if there are no points.
    """
    from scipy.interpolate import (  # imported here: it takes 0.1 s and is rarely needed
        LinearNDInterpolator,
        NearestNDInterpolator,
    )

    values = np.column_stack([d_px[:, 0], np.linalg.norm(d_px, axis=1), d_px[:, 1]])
    if not len(values):
        return np.full((*shape, 3), 0.5, np.float32)
    low, span = values.min(0), np.ptp(values, axis=0)
    scaled = np.where(span > 0, (values - low) / np.where(span > 0, span, 1), 0.5)
    step = max(1.0, max(shape) / _NODES)
    x, y = (np.arange(int(np.ceil(n / step))) for n in (shape[1], shape[0]))
    # nodes at the centres of the cells that result from the enlargement below
    nodes = np.meshgrid((x + 0.5) * shape[1] / len(x) - 0.5, (y + 0.5) * shape[0] / len(y) - 0.5)
    field = NearestNDInterpolator(px, scaled)(*nodes)
    if len(px) > 3 and np.linalg.matrix_rank(px - px.mean(0), tol=1e-6) == 2:
        inside = LinearNDInterpolator(px, scaled)(*nodes)
        field = np.where(np.isfinite(inside), inside, field)
    large = cv2.resize(
        field.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR
    )
    return np.asarray(np.clip(large, 0, 1), np.float32)
