"""Heights of the ground or of a surface model in the plan's zone."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shapely import contains_xy
from shapely.geometry.base import BaseGeometry

from skyquilt.errors import SideFileError
from skyquilt.outside import plain
from skyquilt.planning.records import Array
from skyquilt.raster.drivers import GEOTIFF, why_unreadable

MOST_SIDE = 3000
"""Largest number of heights along one side."""
HEIGHTS = (-500.0, 9000.0)
"""Heights in m that are taken for ground."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrain:
    """A raster of heights; flat at 0 where nothing is known."""

    heights: NDArray[np.float32]
    """(rows, columns) in m, all finite; row 0 is the northernmost."""
    west: float = 0.0
    """Left edge in m."""
    north: float = 0.0
    """Upper edge in m."""
    cell: float = 1.0
    """Side of a cell in m."""
    known: bool = False
    """Whether a file was given."""

    def at(self, x: Array, y: Array) -> Array:
        """Heights in m of places of any shape, interpolated linearly; beyond the raster those of
        its rim.
        """
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        if not self.known:
            return np.zeros(x.shape)
        rows, columns = self.heights.shape
        c = np.clip((x - self.west) / self.cell - 0.5, 0, columns - 1.000001)
        r = np.clip((self.north - y) / self.cell - 0.5, 0, rows - 1.000001)
        i, j = r.astype(np.int64), c.astype(np.int64)
        v, u = r - i, c - j
        z = self.heights
        upper = z[i, j] * (1 - u) + z[i, j + 1] * u
        lower = z[i + 1, j] * (1 - u) + z[i + 1, j + 1] * u
        return np.asarray(upper * (1 - v) + lower * v, np.float64)

    def highest(self, shape: BaseGeometry) -> float:
        """The largest height inside a shape."""
        west, south, east, north = shape.bounds
        x, y = np.meshgrid(np.linspace(west, east, 60), np.linspace(south, north, 60))
        inside = contains_xy(shape, x, y)
        if not inside.any():
            inside[:] = True
        return float(self.at(x[inside], y[inside]).max())

    def around(self, x: Array, y: Array, radius: float) -> Array:
        """The largest heights (n,) within a radius of places (n,)."""
        steps = int(np.clip(np.ceil(radius / self.cell), 1, 8)) if self.known else 0
        offsets = np.linspace(-radius, radius, 2 * steps + 1) if steps else np.zeros(1)
        du, dv = np.meshgrid(offsets, offsets)
        near = np.hypot(du, dv) <= radius * 1.001
        return np.asarray(
            self.at(x[:, None] + du[near][None], y[:, None] + dv[near][None]).max(axis=1)
        )

    def steepest(self) -> float:
        """The largest slope between neighbouring heights, m per m."""
        if not self.known:
            return 0.0
        rows, columns = (np.abs(np.diff(self.heights, axis=k)).max(initial=0) for k in (0, 1))
        return float(np.hypot(rows, columns)) / self.cell


FLAT = Terrain(heights=np.zeros((2, 2), np.float32))
"""Ground of which nothing is known."""


def read_terrain(path: Path, crs: str, area: BaseGeometry, margin: float) -> Terrain:
    """Heights of an area grown by a margin (m), in the zone of the plan.

    Beyond the area, holes are closed with the nearest height.

    Raises:
        SideFileError: the file is no georeferenced raster, lies elsewhere, or has holes in the
            area.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.warp import Resampling, reproject, transform_bounds

    path = Path(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            source = rasterio.open(path, driver=GEOTIFF)
        with source:
            if source.crs is None:
                raise SideFileError(
                    f"{path.name} does not say its coordinate system; write it into the file (for"
                    " instance with gdal_edit -a_srs)"
                )
            _check_place(path, transform_bounds(source.crs, crs, *source.bounds), area)
            empty, west, north, cell = _grid(source, crs, area, margin)
            reproject(
                rasterio.band(source, 1),
                empty,
                src_nodata=source.nodata,
                dst_transform=rasterio.transform.from_origin(west, north, cell, cell),
                dst_crs=crs,
                dst_nodata=np.nan,
                resampling=Resampling.bilinear,
            )
    except rasterio.errors.RasterioError as error:
        raise SideFileError(
            f"{path.name} cannot be read as a raster of heights: {why_unreadable(error)}"
        ) from error
    except (rasterio.errors.CRSError, ValueError) as error:
        raise SideFileError(
            f"{path.name} cannot be read as a raster of heights: {plain(str(error), 200)}"
        ) from error
    return Terrain(
        heights=_closed(path, empty, west, north, cell, area),
        west=west,
        north=north,
        cell=cell,
        known=True,
    )


def _check_place(path: Path, there: tuple[float, float, float, float], area: BaseGeometry) -> None:
    west, south, east, north = area.bounds
    if not np.isfinite(there).all() or (
        there[0] > east or there[2] < west or there[1] > north or there[3] < south
    ):
        raise SideFileError(
            f"{path.name} has no height in the area: it lies elsewhere on Earth; give the terrain"
            " of the area"
        )


def _grid(
    source: Any, crs: str, area: BaseGeometry, margin: float
) -> tuple[NDArray[np.float32], float, float, float]:
    """An empty raster over the area grown by the margin, about as fine as the file."""
    from rasterio.warp import calculate_default_transform

    west, south, east, north = area.buffer(margin).bounds
    affine, _, _ = calculate_default_transform(
        source.crs, crs, source.width, source.height, *source.bounds
    )
    cell = max(abs(affine.a), (east - west) / MOST_SIDE, (north - south) / MOST_SIDE)
    shape = int((north - south) / cell) + 2, int((east - west) / cell) + 2
    return np.full(shape, np.nan, np.float32), west, north, float(cell)


def _closed(
    path: Path,
    heights: NDArray[np.float32],
    west: float,
    north: float,
    cell: float,
    area: BaseGeometry,
) -> NDArray[np.float32]:
    """The heights without holes; raises SideFileError where there are some inside the area."""
    from scipy.ndimage import distance_transform_edt

    good = np.isfinite(heights) & (heights >= HEIGHTS[0]) & (heights <= HEIGHTS[1])
    rows, columns = heights.shape
    x, y = west + (np.arange(columns) + 0.5) * cell, north - (np.arange(rows) + 0.5) * cell
    gx, gy = np.meshgrid(x, y)
    holes = int((contains_xy(area, gx[~good], gy[~good])).sum())
    if holes:
        raise SideFileError(
            f"{path.name} has no height in {holes * cell * cell:.0f} m2 of the area; fill its holes"
            " or give another one"
        )
    if not good.any():
        raise SideFileError(f"{path.name} has no height in the area")
    at = distance_transform_edt(~good, return_distances=False, return_indices=True)
    return np.ascontiguousarray(heights[tuple(at)])
