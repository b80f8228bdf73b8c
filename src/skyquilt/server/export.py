"""Export of a part of the map as Cloud Optimized GeoTIFF."""

import math
from pathlib import Path

import numpy as np

from skyquilt.raster import RasterSpec, write_array
from skyquilt.raster.map_source import Bounds, MapSource, Part

MOST_PIXELS = 60_000_000
"""Largest export in pixels."""


def write_cog(source: MapSource, bounds: Bounds, path: Path, gsd: float) -> Part | None:
    """Writes the map within bounds (map projection), at `gsd` m per pixel, or coarser if that would
    be too large; None if the map is empty there.

    The file appears complete or not at all.
    """
    area = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1])
    step = max(gsd, math.sqrt(area / MOST_PIXELS))
    part = source.part(bounds, step)
    if part is None or not part.shown.any():
        return None
    rows, columns = np.flatnonzero(part.shown.any(1)), np.flatnonzero(part.shown.any(0))
    r0, r1, c0, c1 = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    pixels, shown = part.pixels[r0:r1, c0:c1], part.shown[r0:r1, c0:c1]
    measured = pixels.dtype != np.uint8
    spec = RasterSpec(
        width=pixels.shape[1],
        height=pixels.shape[0],
        bands=pixels.shape[2],
        dtype=pixels.dtype.name,
        transform=(
            part.gsd,
            0,
            part.west + c0 * part.gsd,
            0,
            -part.gsd,
            part.north - r0 * part.gsd,
        ),
        crs=source.crs,
        nodata=float("nan") if measured else None,
        compress="deflate" if measured else "jpeg",
        mask=not measured,
    )
    write_array(
        path,
        np.ascontiguousarray(np.where(shown[..., None], pixels, np.nan) if measured else pixels),
        spec,
        None if measured else np.ascontiguousarray(shown),
    )
    return part
