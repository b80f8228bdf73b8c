"""Geolocation errors per axis [Arteaga 2019, Table 2]."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.poses import Alignment, Prior

Array = NDArray[np.float64]
Axes = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class AxisErrors:
    """Errors of positions, axis by axis; NaN for an axis without a reference."""

    mae_m: Axes
    """Mean absolute error along x, y, z in m."""
    rms_m: Axes
    """Root mean square error along x, y, z in m."""
    mean_m: Axes
    """Mean error along x, y, z in m: the part that a shift of the whole map would remove."""
    count: int
    """Number of positions compared."""


def geolocation_errors(estimated: NDArray[Any], reference: NDArray[Any]) -> AxisErrors:
    """Errors of positions (n, 3) in m against a reference (n, 3); NaN where either has no value."""
    if np.shape(estimated) != np.shape(reference) or np.shape(estimated)[1:] != (3,):
        raise ValueError(
            f"two (n, 3) arrays expected, got {np.shape(estimated)} and {np.shape(reference)}"
        )
    error = np.asarray(estimated, np.float64) - np.asarray(reference, np.float64)
    return AxisErrors(
        mae_m=_axes(np.abs(error)),
        rms_m=_root(_axes(error**2)),
        mean_m=_axes(error),
        count=len(error),
    )


def gps_residuals(alignment: Alignment, priors: Sequence[Prior]) -> Array:
    """(n, 3) solution minus reported position in m (map frame) of the photos connected by tie
    points, in the order of `alignment.held`; NaN where no position was reported.

    Where control points determine the heights, the offset between their datum and that of the
    photos is removed first.
    """
    residual = np.array(
        [alignment.poses[i].map_C - priors[i].map_C for i in alignment.held]
    ).reshape(-1, 3)
    held = any(not c.check and np.isfinite(c.error_m[2]) for c in alignment.control)
    if (held or alignment.frame.vertical_datum == "control") and np.isfinite(residual[:, 2]).any():
        residual[:, 2] -= np.nanmedian(residual[:, 2])
    return residual


def _axes(values: Array) -> Axes:
    """Mean of each column, leaving out NaN."""
    means = [
        float(v[np.isfinite(v)].mean()) if np.isfinite(v).any() else float("nan") for v in values.T
    ]
    return means[0], means[1], means[2]


def _root(axes: Axes) -> Axes:
    """Square root of each."""
    return axes[0] ** 0.5, axes[1] ** 0.5, axes[2] ** 0.5
