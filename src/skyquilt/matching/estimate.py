"""Functions shared by all estimators: checks of the points, and the record of a transformation with
its inliers.
"""

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyquilt.geometry.refine import refine
from skyquilt.geometry.transforms import MINIMAL, fit, symmetric_transfer_errors
from skyquilt.model.estimate import Estimate, NoEstimate

Doubles = NDArray[np.float64]


class Estimator(Protocol):
    """Interface of the estimators of a transformation from matches a, b (N, 2) px: `Ransac`,
    `Lmeds`, `Magsac`, `RansacSte`.
    """

    def __call__(self, a: ArrayLike, b: ArrayLike) -> Estimate | NoEstimate:
        """b_H_a with its inliers, or the reason why there is none."""
        ...


def matched(a: ArrayLike, b: ArrayLike) -> tuple[Doubles, Doubles]:
    """Both as (N, 2) float; ValueError if they are not matches."""
    pa, pb = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if pa.ndim != 2 or pa.shape[1] != 2 or pa.shape != pb.shape:
        raise ValueError(f"two equal (N, 2) expected, got {pa.shape} and {pb.shape}")
    if not (np.isfinite(pa).all() and np.isfinite(pb).all()):
        raise ValueError("points must be finite")
    return pa, pb


def too_few(model: str, count: int, minimum: int) -> NoEstimate | None:
    """Why `count` matches are not enough; None if they are. At least one match more than the
    minimal sample is needed, since the sample itself always agrees.
    """
    least = max(minimum, MINIMAL[model] + 1)
    return NoEstimate(reason=f"too few matches ({count} of {least})") if count < least else None


def weak(model: str, count: int, total: int, minimum: int) -> NoEstimate | None:
    """Why `count` inliers of `total` matches are not enough; None if they are."""
    if count >= max(minimum, MINIMAL[model] + 1):
        return None
    return NoEstimate(reason=f"weak inliers ({count} of {total} matches)")


def polished(
    model: str, H: Doubles, a: Doubles, b: Doubles, limit: float, *, rounds: int = 5
) -> tuple[Doubles, NDArray[np.bool_]]:
    """The model fitted to the matches with a symmetric transfer error below `limit` px^2, repeated
    until these no longer change; and these matches.
    """
    inliers = symmetric_transfer_errors(H, a, b) < limit
    for _ in range(rounds):
        if inliers.sum() < MINIMAL[model]:
            break
        fitted = fit(model, a[inliers], b[inliers])
        if fitted is None:
            break
        H = refine(model, fitted, a[inliers], b[inliers])
        before, inliers = inliers, symmetric_transfer_errors(H, a, b) < limit
        if (before == inliers).all():
            break
    return H, inliers


__all__ = ["Estimate", "Estimator", "NoEstimate", "matched", "polished", "too_few", "weak"]
