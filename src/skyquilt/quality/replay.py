"""Correlation of each photo with the map so far, computed in order of capture, and the thesis's
quality function lambda (Y 4.6, 6.1, Fig. 6.4).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyquilt.imaging.plane import Overview, Patch

LEAST_PX = 200
"""Smallest overlap in px for a correlation to be used."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """Correlations of photos as they are added; NaN for the first photo and for empty overlaps."""

    with_overview: NDArray[np.float64]
    """(n,) CC of each photo with the map so far: the terms of lambda_corr (6.1)."""
    with_last: NDArray[np.float64]
    """(n,) CC of each photo with the one before it (Fig. 6.4, upper graph)."""


def replay(patches: Iterable[Patch | None]) -> Replay:
    """Merges photos, all on one grid, into an overview, centre first; None is a photo that is not
    placed.
    """
    overview, last = Overview(), None
    whole, pair = [], []
    for patch in patches:
        if patch is None:
            whole.append(np.nan)
            pair.append(np.nan)
            continue
        h, w = patch.shown.shape
        pixels, shown = overview.window(patch.row, patch.column, h, w)
        whole.append(_agreement(patch, pixels, shown))
        pair.append(_agreement(patch, *_alone(last, patch)) if last is not None else np.nan)
        overview.merge(patch)
        last = patch
    return Replay(with_overview=np.array(whole), with_last=np.array(pair))


def _agreement(patch: Patch, pixels: NDArray[np.float32], shown: NDArray[np.bool_]) -> float:
    mask = patch.shown & shown
    return (
        correlation(patch.pixels, pixels, mask)
        if np.count_nonzero(mask) >= LEAST_PX
        else float("nan")
    )


def _alone(last: Patch, patch: Patch) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The last photo's content on this photo's part of the grid."""
    alone = Overview()
    alone.merge(last)
    return alone.window(patch.row, patch.column, *patch.shown.shape)


def correlation(x: NDArray[Any], y: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float:
    """CC of (6.1), covariance over the product of the standard deviations, of two images of equal
    shape.

    `mask` (the images' shape, without a last axis of bands) is True where both have content. NaN
    where there is no overlap, or where one image is constant in it and the correlation is
    undefined.
    """
    if x.shape != y.shape:
        raise ValueError(f"two images of equal shape expected, got {x.shape} and {y.shape}")
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
    """(6.1): mean over distances d of 1 / (1 + |d - estimate| / d), in (0, 1]; both (m,), in the
    same unit.
    """
    return float(np.mean(1 / (1 + _relative(actual, estimated))))


def lambda_spat_of_table(actual: ArrayLike, estimated: ArrayLike) -> float:
    """The values printed as lambda_spat in Table 6.1, which follow not (6.1) but 1 - sum |d -
    estimate| / d; both (m,).
    """
    return float(1 - np.sum(_relative(actual, estimated)))


def lambda_corr(correlations: ArrayLike) -> float:
    """(6.1): mean of (1 + CC) / 2 over the photos added, in [0, 1].

    `correlations` (n,): CC of each new photo with the mosaic so far; NaN values (the first photo,
    no overlap) are ignored. NaN if there are no others.
    """
    cc = np.asarray(correlations, np.float64)
    cc = cc[np.isfinite(cc)]
    return float(np.mean((1 + cc) / 2)) if cc.size else float("nan")


def lambda_quality(spat: float, corr: float, *, alpha: float = 0.5) -> float:
    """(4.6): alpha lambda_spat + (1 - alpha) lambda_corr; alpha weighs distances against visual
    agreement.
    """
    return alpha * spat + (1 - alpha) * corr


def _relative(actual: ArrayLike, estimated: ArrayLike) -> NDArray[np.float64]:
    """Relative errors of distances."""
    d, found = np.asarray(actual, np.float64), np.asarray(estimated, np.float64)
    if d.shape != found.shape or d.size == 0 or (d <= 0).any():
        raise ValueError(
            f"as many estimates as actual distances, all positive, expected: {d} and {found}"
        )
    return np.asarray(np.abs(d - found) / d)
