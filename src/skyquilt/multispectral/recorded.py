"""What a file of a band recorded, before it is drawn: black, white and damaged files are left out.

Such a file is placed beside the map's photo of its capture, whatever it shows, so nothing else
would tell: a black file of the near infrared would make an NDVI of -1.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.grey import detail
from skyquilt.model.photo import Photo
from skyquilt.multispectral.reflectance import Reflectance
from skyquilt.photos.pixels import lost, read_color
from skyquilt.photos.read import rejected

_EVERY = 4
"""Rows and columns of which one is looked at."""
_DARK = 0.001
"""Share of the range up to which the median of a black file lies above its black level: noise of a
detector of 12 bits, a few counts of whose 4096 is."""
_BRIGHT = 0.004
"""The same of all but the brightest hundredth of it: a night's street lamps are brighter."""
_WHITE = 0.9
"""Share of saturated pixels from which a file shows too little."""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What one file recorded."""

    reason: str = ""
    """Why it is not drawn; empty where it is."""
    saturated: float = 0.0
    """Share of its pixels that are saturated."""
    detail: float = math.nan
    """Logarithm of its fine over its coarse detail (`imaging.grey.detail`), along the axis on which
    it is less; NaN where it is too small."""
    brightest: float = 0.0
    """Its largest count."""
    step: int = 1
    """What all its counts are multiples of; 1 of real numbers."""
    gone: bool = False
    """Whether it changed or disappeared since it was found, so that another run may see it."""


def look_at(item: tuple[Photo, Reflectance]) -> Recorded:
    """What a file recorded whose counts are converted so. Never raises."""
    photo, convert = item
    try:
        pixels = read_color(photo)
    except Exception as error:  # whatever it is, it concerns this file alone
        gone = lost(photo)
        return Recorded(reason=gone or rejected(photo.name, error).reason, gone=bool(gone))
    counts = np.asarray(pixels[::_EVERY, ::_EVERY], np.float32)
    known = counts[np.isfinite(counts)]
    if not known.size or known.min() == known.max():
        return Recorded(reason="all its pixels have one value")
    brightest = float(np.nanmax(pixels))
    step = int(np.gcd.reduce(known.astype(np.int64))) if pixels.dtype.kind in "ui" else 1
    saturated = float((known >= convert.saturated).mean())
    if saturated > _WHITE:
        why = f"{saturated:.0%} of its pixels are saturated"
        return Recorded(reason=why, brightest=brightest, step=step)
    if convert.kind != "counts":
        median, bright = np.percentile(known, (50, 99)) - convert.black_level
        if median < _DARK * convert.full and bright < _BRIGHT * convert.full:
            return Recorded(reason="it is black: nothing in it is brighter than its black level")
    return Recorded(
        saturated=saturated, detail=_detail(pixels, known), brightest=brightest, step=step
    )


def _detail(pixels: NDArray[Any], known: NDArray[np.float32]) -> float:
    """Logarithm of fine over coarse detail of counts (h, w[, 1]); `known`: a sample of them."""
    low, high = np.percentile(known, (1, 99))
    scaled = (pixels.astype(np.float32) - low) * np.float32(255 / max(high - low, 1e-6))
    grey = np.clip(np.nan_to_num(scaled, nan=0.0), 0, 255).astype(np.uint8)
    cells = detail(grey)[..., :2]
    known_cells = cells[np.isfinite(cells).all(-1)]
    return float(np.median(known_cells, axis=0).min()) if len(known_cells) else math.nan
