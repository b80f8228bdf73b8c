"""infrared.tif: near infrared, red and green as red, green and blue: plants are red."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

from skyquilt.multispectral.draw import BANDS_FILE
from skyquilt.raster import CogWriter, RasterSpec

INFRARED_FILE = "infrared.tif"
INFRARED = ("nir", "red", "green")
"""Bands shown as red, green and blue."""
BRIGHTER = 1.8
"""The eye is used to pictures that are brighter in the dark than values are: exponent."""
ENDS = (1.0, 99.0)
"""Percentiles of a band that are black and white."""
_OVERVIEW = 1000
"""Longer side in px of the overview that they are taken from."""


def ends_of(values: NDArray[np.float32]) -> tuple[float, float]:
    """Values of a band (h, w) that are shown black and white."""
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, ENDS)
    return float(low), float(high)


def composed(
    bands: Sequence[NDArray[np.float32]], ends: Sequence[tuple[float, float]]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """RGB (h, w, 3) of three bands (h, w), and where all of them are known (h, w)."""
    known = np.asarray(np.isfinite(np.stack(bands)).all(0))
    shares = [
        np.clip((np.nan_to_num(v) - low) / max(high - low, 1e-9), 0, 1) ** (1 / BRIGHTER)
        for v, (low, high) in zip(bands, ends, strict=True)
    ]
    return np.asarray(np.rint(255 * np.stack(shares, -1)), np.uint8), known


def reduced(source: rasterio.DatasetReader, longest: int) -> NDArray[np.float32]:
    """All bands (n, h, w) of a raster, with at most so many px on the longer side."""
    factor = max(1.0, max(source.width, source.height) / longest)
    h, w = (max(1, round(n / factor)) for n in (source.height, source.width))
    return np.asarray(source.read(out_shape=(source.count, h, w)), np.float32)


def write_infrared(output: Path) -> bool:
    """Writes infrared.tif beside bands.tif; False, and no file, where that lacks a band.

    Raises:
        OutputError: the disk is full.
    """
    with rasterio.open(output / BANDS_FILE) as source:
        names = list(source.descriptions)
        if not set(INFRARED) <= set(names):
            return False
        numbers = [names.index(n) for n in INFRARED]
        small = reduced(source, _OVERVIEW)
        ends = [ends_of(small[k]) for k in numbers]
        spec = RasterSpec(
            width=source.width,
            height=source.height,
            bands=3,
            dtype="uint8",
            transform=tuple(source.transform)[:6],
            crs=source.crs.to_wkt() if source.crs else None,
            compress="jpeg",
            quality=90,
            mask=True,
            tags={"SOFTWARE": "Skyquilt", "BANDS": " ".join(INFRARED)},
        )
        with CogWriter(output / INFRARED_FILE, spec) as writer:
            for block in writer.blocks():
                window = Window(block.col0, block.row0, block.width, block.height)
                bands = source.read([k + 1 for k in numbers], window=window)
                writer.write_block(block, *composed(bands, ends))
    return True
