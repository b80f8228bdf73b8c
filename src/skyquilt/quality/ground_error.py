"""Patches of ground from georeferenced rasters with different grids."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.windows import Window

MARGIN = 3
"""Margin in px read around a requested window, for interpolation."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """Grey pixels with their georeference, north up."""

    grey: NDArray[np.float32]
    """(H, W) values; 0 where unknown."""
    known: NDArray[np.float32]
    """(H, W) 1 where the raster has a value, else 0."""
    west: float
    """Easting of the left edge in m."""
    north: float
    """Northing of the top edge in m."""
    px_x: float
    """Width of a pixel in m."""
    px_y: float
    """Height of a pixel in m."""

    def patch(self, x: float, y: float, gsd: float, size: int) -> tuple[NDArray[np.float32], float]:
        """A patch (size, size) of pixels of `gsd` m centred on (x, y), and the share of it that is
        known.

        Unknown pixels get the mean of the others.
        """
        step = (np.arange(size) - (size - 1) / 2) * gsd
        columns = np.float32((x + step - self.west) / self.px_x - 0.5)
        rows = np.float32((self.north - y + step) / self.px_y - 0.5)
        u, v = np.meshgrid(columns, rows)
        grey = cv2.remap(self.grey, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)
        known = (
            cv2.remap(self.known, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) > 0.999
        )
        if not known.any():
            return np.zeros((size, size), np.float32), 0.0
        return np.where(known, grey, grey[known].mean()).astype(np.float32), float(known.mean())


def read_ground(
    raster: rasterio.DatasetReader, factor: int, window: Window | None = None
) -> Ground:
    """A raster, or a window of it, averaged over `factor` px."""
    if window is None:
        window = Window(0, 0, raster.width, raster.height)
    shape = max(1, round(window.height / factor)), max(1, round(window.width / factor))
    bands = min(raster.count, 3) if raster.count != 2 else 1
    values = raster.read(
        list(range(1, bands + 1)),
        window=window,
        out_shape=(bands, *shape),
        resampling=Resampling.average,
    ).astype(np.float32)
    known = raster.dataset_mask(window=window, out_shape=shape) > 0
    known &= np.isfinite(values).all(0)
    return Ground(
        grey=np.where(known, values.mean(0), 0).astype(np.float32),
        known=known.astype(np.float32),
        west=raster.transform.c + window.col_off * raster.transform.a,
        north=raster.transform.f + window.row_off * raster.transform.e,
        px_x=raster.transform.a * window.width / shape[1],
        px_y=-raster.transform.e * window.height / shape[0],
    )


def patches(
    raster: rasterio.DatasetReader, places: NDArray[np.float64], gsd: float, size: int
) -> Iterator[tuple[NDArray[np.float32], float]]:
    """The patch of pixels of `gsd` m around each place (n, 2) in m, as returned by `Ground.patch`.

    A coarse raster is read once as a whole, a fine one window by window, to limit memory.
    """
    factor = max(1, round(gsd / raster.transform.a))
    whole = read_ground(raster, factor) if factor > 1 else None
    for x, y in places:
        ground = whole or read_ground(
            raster, 1, _around(raster, float(x), float(y), gsd * size / 2)
        )
        yield ground.patch(float(x), float(y), gsd, size)


def _around(raster: rasterio.DatasetReader, x: float, y: float, half: float) -> Window:
    """The window that holds a square of `half` m to each side and a margin, cut at the raster's
    edges.
    """
    px = raster.transform.a
    column, row = (x - raster.transform.c) / px, (raster.transform.f - y) / px
    reach = half / px + MARGIN
    left, top = max(0, int(column - reach)), max(0, int(row - reach))
    left, top = min(left, raster.width - 1), min(top, raster.height - 1)
    right = min(raster.width, max(left + 1, int(np.ceil(column + reach))))
    bottom = min(raster.height, max(top + 1, int(np.ceil(row + reach))))
    return Window(left, top, right - left, bottom - top)
