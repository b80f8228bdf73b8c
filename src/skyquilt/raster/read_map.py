"""Reads georeferenced rasters in parts or reduced: our maps or those of other programs."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.raster.drivers import open_raster, why_unreadable


@dataclass(frozen=True, kw_only=True, eq=False)
class MapFile:
    """A raster file and its georeference."""

    path: Path
    """The file."""
    width: int
    """Columns."""
    height: int
    """Rows."""
    bands: int
    """Number of image bands: 1 or 3; an alpha band is validity and does not count."""
    dtype: str
    """Type of its pixels."""
    affine: tuple[float, float, float, float, float, float]
    """(a, b, c, d, e, f): corner x = a col + b row + c, y = d col + e row + f."""
    crs: str | None
    """As WKT; None where the file states none."""
    unit: str = ""
    """Unit of the first band, where stated."""


def open_map(path: Path) -> MapFile | None:
    """A raster's description, or None where the file is not georeferenced or GDAL cannot read
    it.
    """
    import rasterio

    try:
        with warnings.catch_warnings():
            # reported by None
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            raster = open_raster(path)
        with raster:
            placed = raster.crs is not None or not raster.transform.is_identity
            if not placed:
                return None
            return MapFile(
                path=path,
                width=raster.width,
                height=raster.height,
                bands=3 if raster.count >= 3 else 1,
                dtype=raster.dtypes[0],
                affine=tuple(raster.transform)[:6],
                unit=raster.units[0] or "",
                crs=raster.crs.to_wkt() if raster.crs else None,
            )
    except rasterio.errors.RasterioError:
        return None


def read_reduced(source: MapFile, longest: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Pixels (h, w[, 3]) and validity (h, w), averaged so that the longer side has at most
    `longest` px.

    Raises:
        OSError: the file's data are damaged.
    """
    scale = max(1.0, max(source.width, source.height) / longest)
    shape = (max(1, round(source.height / scale)), max(1, round(source.width / scale)))
    return _read(source, None, shape)


def read_window(
    source: MapFile, row: int, column: int, height: int, width: int
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Pixels (height, width[, 3]) and validity of a part that lies inside the raster.

    Raises:
        OSError: the file's data are damaged.
    """
    from rasterio.windows import Window

    return _read(source, Window(column, row, width, height), (height, width))


def _read(
    source: MapFile, window: object, shape: tuple[int, int]
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    import rasterio
    from rasterio.enums import Resampling

    try:
        with open_raster(source.path) as raster:
            values = raster.read(
                list(range(1, source.bands + 1)),
                window=window,
                out_shape=(source.bands, *shape),
                resampling=Resampling.average,
            )
            valid = raster.dataset_mask(window=window, out_shape=shape) > 0
    except rasterio.errors.RasterioError as error:
        raise OSError(f"its pixels cannot be decoded: {why_unreadable(error)}") from error
    pixels = np.moveaxis(values, 0, -1) if source.bands > 1 else values[0]
    if pixels.dtype.kind == "f":
        valid &= np.isfinite(pixels if pixels.ndim == 2 else pixels.sum(2))
    return np.ascontiguousarray(pixels), valid
