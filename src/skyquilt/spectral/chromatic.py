"""Edges of colour instead of brightness: what remains of a picture when the light on it is taken
away.

Sun, shade and slope scale all bands of a surface's colour nearly alike, so ratios of bands tell one
material from another and know little of shadows and shading (Gevers and Smeulders 1999; the same
idea as Finlayson's invariants). Thermal pictures have shadows and sunny slopes of their own hour.
Where the other picture has some too, both are alike a little aside of the true place, along both
suns' directions; edges of materials are alike in the true place alone.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.registration import Picture
from skyquilt.spectral.orientation import Orientation, of_bands, shrunken

DARK = 1 / 64
"""Share of the largest value that is added to all: the ratios of black are noise."""


def chromaticity(rgb: NDArray[Any]) -> NDArray[np.float32]:
    """Logarithms (h, w, 3) of an RGB picture's values, less their mean over the bands: the same for
    any brightness.
    """
    largest = float(np.iinfo(rgb.dtype).max) if rgb.dtype.kind == "u" else float(np.nanmax(rgb))
    logarithm = np.log(
        np.maximum(rgb.astype(np.float32), 0) / np.float32(max(largest, 1e-9)) + np.float32(DARK)
    )
    return np.asarray(logarithm - logarithm.mean(2, keepdims=True), np.float32)


def chromatic(picture: Picture, valid: NDArray[np.bool_], side: float) -> Orientation | None:
    """Fields of a picture's colours, shrunken as `orientation` does; None where it has no
    colours.
    """
    values = picture.values
    if values.ndim != 3 or values.shape[2] != 3:
        return None
    kind = values.dtype
    known = np.where(valid[..., None], values, kind.type(0))
    if kind.kind != "u":
        known = known.astype(np.float32)
    small, whole, small_S_full = shrunken(known, valid, side)
    return of_bands(chromaticity(small), whole, small_S_full)
