"""The quality function of incremental mosaicking [Yahyanejad 2013, (4.6) and (6.1)]."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def correlation(x: NDArray[Any], y: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float:
    """CC of (6.1), covariance over the product of the standard deviations, of two images of one
    shape.

    `mask` (the images' shape, without a last axis of bands) says where both show something. NaN
    where there is no overlap, or where one image is constant in it and correlation means nothing.
    """
    if x.shape != y.shape:
        raise ValueError(f"two images of one shape expected, got {x.shape} and {y.shape}")
    if mask is not None:
        x, y = x[mask], y[mask]
    if x.size == 0:
        return float("nan")
    u = np.ravel(x).astype(np.float64)
    v = np.ravel(y).astype(np.float64)
    u, v = u - u.mean(), v - v.mean()
    norm = float(np.sqrt((u @ u) * (v @ v)))
    return float(u @ v) / norm if norm > 0 else float("nan")


def lambda_spat(actual: ArrayLike, estimated: ArrayLike) -> float:
    """(6.1): mean over distances d of 1 / (1 + |d - estimate| / d), in (0, 1]; both (m,), any one
    unit.
    """
    return float(np.mean(1 / (1 + _relative(actual, estimated))))


def lambda_spat_of_table(actual: ArrayLike, estimated: ArrayLike) -> float:
    """What Table 6.1 prints as lambda_spat, which is not (6.1) but 1 - sum |d - estimate| / d; both
    (m,).
    """
    return float(1 - np.sum(_relative(actual, estimated)))


def lambda_corr(correlations: ArrayLike) -> float:
    """(6.1): mean of (1 + CC) / 2 over the photos added, in [0, 1].

    `correlations` (n,): CC of each new photo with the mosaic so far; NaN (the first photo, no
    overlap) is left out. NaN if nothing is left.
    """
    cc = np.asarray(correlations, np.float64)
    cc = cc[np.isfinite(cc)]
    return float(np.mean((1 + cc) / 2)) if cc.size else float("nan")


def lambda_quality(spat: float, corr: float, *, alpha: float = 0.5) -> float:
    """(4.6): alpha lambda_spat + (1 - alpha) lambda_corr; alpha weighs distances against looks."""
    return alpha * spat + (1 - alpha) * corr


def _relative(actual: ArrayLike, estimated: ArrayLike) -> NDArray[np.float64]:
    """Relative errors of distances."""
    d, found = np.asarray(actual, np.float64), np.asarray(estimated, np.float64)
    if d.shape != found.shape or d.size == 0 or (d <= 0).any():
        raise ValueError(
            f"as many estimates as actual distances, all positive, expected: {d} and {found}"
        )
    return np.asarray(np.abs(d - found) / d)
