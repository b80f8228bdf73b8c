"""What cameras have in common that are one lens behind different digital zooms.

A digital zoom enlarges the middle of the sensor's picture, so the lens stays what it was: its
distortion is the same, the focal length and how far the principal point lies beside the middle grow
with the zoom. Calibrated each by itself, a zoom of one or two photos takes up their tilt.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.problem import InCommon
from skyquilt.model.camera import PARAMETERS
from skyquilt.model.photo import Zoom

Array = NDArray[np.float64]
ROUNDED = 3e-3
"""Deviation of a factor that files tell, as a share: they tell it with two decimals."""
OFF_CENTRE = 5e-4
"""Deviation of the middle of what is enlarged, as a share of the picture's longer side."""
DEVIATION = {"k1": 1e-3, "k2": 1e-3, "k3": 1e-3, "p1": 1e-4, "p2": 1e-4, "aspect": 2e-4}
"""Deviations of what does not change with the zoom."""


def same_lens(
    zooms: Sequence[Zoom], K0: Array, size: Array, free: NDArray[np.bool_]
) -> InCommon | None:
    """What the intrinsics of cameras have in common, with their priors (m, 11) and the size (m, 2)
    of their pictures; None where no two of them are one lens. `free` (m, 11): which are estimated;
    those that are not are left as they are.
    """
    rows, zero = list[Array](), list[Array]()
    for lens in dict.fromkeys(zoom.camera for zoom in zooms):
        own = [k for k, zoom in enumerate(zooms) if zoom.camera == lens]
        for column, name in enumerate(PARAMETERS) if len(own) > 1 else ():
            if name not in {"focal", "cx", "cy", *DEVIATION} or not free[own, column].all():
                continue
            value, at_zero, sigma = _of_lens(name, [zooms[k] for k in own], K0[own, 0], size[own])
            weight = sigma**-2 / (sigma**-2).sum()
            apart = (np.eye(len(own)) - weight) / sigma[:, None]  # from their weighted mean
            row = np.zeros((len(own), *free.shape))
            row[:, own, column] = apart * value
            rows.append(row.reshape(len(own), -1))
            zero.append(apart @ at_zero)
    return InCommon(rows=np.concatenate(rows), zero=np.concatenate(zero)) if rows else None


def _of_lens(
    name: str, zooms: Sequence[Zoom], focal: Array, size: Array
) -> tuple[Array, Array, Array]:
    """Factors (n,) and what is taken off (n,) that make an intrinsic of each camera that of their
    lens, and its deviations (n,).
    """
    n, factor = len(zooms), np.array([zoom.factor for zoom in zooms])
    if name in DEVIATION:
        return np.ones(n), np.zeros(n), np.full(n, DEVIATION[name])
    if name == "focal":
        share = np.hypot(ROUNDED, [zoom.sigma for zoom in zooms])
        return 1 / factor, np.zeros(n), focal / factor * share
    middle = (size[:, 0 if name == "cx" else 1] - 1) / 2
    return 1 / factor, middle / factor, OFF_CENTRE * size.max(1)
