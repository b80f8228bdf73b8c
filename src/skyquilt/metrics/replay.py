"""How photos agree where they are placed, one after the other in order of capture (Y 6.1, Fig.
6.4).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.plane import Overview, Patch
from skyquilt.metrics.correlation import correlation

LEAST_PX = 200
"""Pixels that must overlap for a correlation to mean anything."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """Correlations of photos as they are added; NaN for the first photo and for empty overlaps."""

    with_overview: NDArray[np.float64]
    """(n,) CC of each photo with the map so far: the terms of lambda_corr (6.1)."""
    with_last: NDArray[np.float64]
    """(n,) CC of each photo with the one before it (Fig. 6.4, upper graph)."""


def replay(patches: Iterable[Patch | None]) -> Replay:
    """Adds photos, all on one grid, to an overview, centre first; None is a photo that is not
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
    """What the last photo shows on this one's part of the grid."""
    alone = Overview()
    alone.merge(last)
    return alone.window(patch.row, patch.column, *patch.shown.shape)
