"""Rasters of a run as arrays."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import PIP, UsageError
from skyquilt.raster.map_source import Bounds, FileSource
from skyquilt.typed import as_kind

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Raster:
    """A raster, or a part of it, north up."""

    pixels: NDArray[Any]
    """(h, w, bands)."""
    shown: NDArray[np.bool_]
    """(h, w) where it has content."""
    west: float
    """Easting of the left edge in m."""
    north: float
    """Northing of the top edge in m."""
    gsd_m: float
    """Size of a pixel in m."""
    crs: str | None
    """Coordinate system; None if the map is not georeferenced."""

    @property
    def x(self) -> NDArray[np.float64]:
        """(w,) eastings of the pixels' centres in m."""
        return np.asarray(self.west + (np.arange(self.pixels.shape[1]) + 0.5) * self.gsd_m)

    @property
    def y(self) -> NDArray[np.float64]:
        """(h,) northings of the pixels' centres in m, from north to south."""
        return np.asarray(self.north - (np.arange(self.pixels.shape[0]) + 0.5) * self.gsd_m)


def read_raster(
    source: FileSource, name: str, bounds: Bounds | None, gsd_m: float | None
) -> Raster:
    """A part of a GeoTIFF; `bounds` and `gsd_m` None = the whole, as fine as the file.

    Raises:
        UsageError: the part has no area, or lies outside; `gsd_m` is no size of a pixel.
        SideFileError: the file is damaged.
    """
    from rasterio.enums import Resampling
    from rasterio.windows import Window

    bounds = as_kind("bounds", bounds, Bounds | None)
    gsd_m = as_kind("gsd_m", gsd_m, float | None)
    if bounds is not None and not all(map(math.isfinite, bounds)):
        raise UsageError(f"bounds are {bounds}; west, south, east, north are finite numbers")
    if gsd_m is not None and not 0 < gsd_m < math.inf:
        raise UsageError(f"gsd_m is {gsd_m:g}; the size of a pixel in m is expected")
    with source.opened() as file:
        own, left, top = file.res[0], file.bounds.left, file.bounds.top
        west, south, east, north = bounds or tuple(file.bounds)
        c0, c1 = (int(np.clip(round((v - left) / own), 0, file.width)) for v in (west, east))
        r0, r1 = (int(np.clip(round((top - v) / own), 0, file.height)) for v in (north, south))
        if c0 >= c1 or r0 >= r1:
            raise UsageError(
                f"the raster {name} has nothing within {west}, {south}, {east}, {north}"
            )
        # whole pixels of the file, so that places are exact
        factor = min(max(1, round((gsd_m or own) / own)), r1 - r0, c1 - c0)
        h, w = (n // factor for n in (r1 - r0, c1 - c0))
        window = Window(c0, r0, w * factor, h * factor)
        bands = list(range(1, (3 if file.count >= 3 else 1) + 1))
        how = Resampling.nearest if factor == 1 or name == "provenance" else Resampling.average
        pixels = file.read(bands, window=window, out_shape=(len(bands), h, w), resampling=how)
        shown = file.dataset_mask(window=window, out_shape=(h, w)) > 0
    pixels = np.ascontiguousarray(np.moveaxis(pixels, 0, -1))
    if pixels.dtype.kind == "f":
        shown &= np.isfinite(pixels).all(-1)
    return Raster(
        pixels=pixels,
        shown=shown,
        west=left + c0 * own,
        north=top - r0 * own,
        gsd_m=own * factor,
        crs=source.crs or None,
    )


def as_xarray(raster: Raster, name: str, unit: str) -> "xarray.DataArray":
    """A raster as a `DataArray` with coordinates.

    Raises:
        UsageError: xarray is not installed.
    """
    try:
        import xarray
    except ImportError as error:
        raise UsageError(
            f"xarray is not installed; it is the extra `xarray`: {PIP} install -c constraints.txt"
            ' ".[xarray]"'
        ) from error
    measured = raster.pixels.dtype.kind == "f"
    nothing = np.nan if measured else 0
    pixels = np.where(raster.shown[..., None], raster.pixels, raster.pixels.dtype.type(nothing))
    return xarray.DataArray(
        pixels,
        dims=("y", "x", "band"),
        coords={"y": raster.y, "x": raster.x, "band": np.arange(1, pixels.shape[2] + 1)},
        name=name,
        attrs={"crs": raster.crs or "", "units": unit, "gsd_m": raster.gsd_m},
    )
