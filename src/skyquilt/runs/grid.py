"""The pixel grid of an export: coordinate system, bounds and pixel size, as asked for."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from skyquilt.errors import UsageError
from skyquilt.geometry.frames import METRES_PER_DEGREE
from skyquilt.raster.map_source import Bounds, MapSource, between

if TYPE_CHECKING:
    from pyproj import CRS

MOST_PIXELS = 20_000_000_000
"""Largest export in pixels."""
BLOCK = 2048
"""Side in px of what is computed at a time."""
ROWS_BYTES = 64_000_000
"""Memory in bytes for the rows that are written at a time."""


@dataclass(frozen=True, kw_only=True)
class ExportGrid:
    """Square pixels, north up."""

    crs: str
    """Coordinate system; empty for a map that is not georeferenced."""
    west: float
    """Left edge in units of `crs`."""
    north: float
    """Top edge in units of `crs`."""
    step: float
    """Size of a pixel in units of `crs`."""
    metres: float
    """About the same in m."""
    width: int
    """Columns."""
    height: int
    """Rows."""

    def bounds(self, row: int, column: int, height: int, width: int) -> Bounds:
        """Bounds of a window in units of `crs`."""
        west, north = self.west + column * self.step, self.north - row * self.step
        return west, north - height * self.step, west + width * self.step, north

    @property
    def whole(self) -> Bounds:
        """Bounds of everything."""
        return self.bounds(0, 0, self.height, self.width)

    def strips(self) -> Iterator[tuple[int, int]]:
        """First row and number of rows of the strips from the top down."""
        rows = max(16, min(BLOCK // 4, ROWS_BYTES // (4 * self.width)))
        for row in range(0, self.height, rows):
            yield row, min(rows, self.height - row)

    def columns(self) -> Iterator[tuple[int, int]]:
        """First column and number of columns of the blocks of a strip."""
        for column in range(0, self.width, BLOCK):
            yield column, min(BLOCK, self.width - column)


def _metres_per_unit(crs: "CRS") -> float:
    """Length in m of a unit of a coordinate system's axes: of a degree, a metre, a foot."""
    if crs.is_geographic:
        return METRES_PER_DEGREE
    return float(crs.axis_info[0].unit_conversion_factor)


def grid_of(
    source: MapSource, bounds: Bounds | None, crs: str | None, gsd_m: float | None
) -> ExportGrid:
    """The grid asked for; None = that of the map.

    Raises:
        UsageError: the map is not georeferenced, there is nothing within the bounds, or it would be
            too large.
    """
    from pyproj import CRS

    if crs is not None and not source.crs:
        raise UsageError("the map is not georeferenced, so --crs cannot be given")
    about = source.about()
    if about is None:
        raise UsageError("the map is empty")
    target, native, extent = crs or source.crs, about.resolution, about.bounds
    own = target == source.crs or (crs is not None and CRS(crs) == CRS(source.crs))
    if not own:
        extent = between(source.crs, target).transform_bounds(*extent)
    unit = 1.0 if not target else _metres_per_unit(CRS(target))
    around = METRES_PER_DEGREE if source.crs and CRS(source.crs).is_geographic else 1.0
    metres = gsd_m or native * around
    step = metres / unit
    west, south, east, north = bounds or extent
    west, south, east, north = (
        max(west, extent[0]),
        max(south, extent[1]),
        min(east, extent[2]),
        min(north, extent[3]),
    )
    if west >= east or south >= north:
        raise UsageError(
            f"the map has nothing within --bounds; it covers"
            f" {','.join(f'{v:.6f}'.rstrip('0').rstrip('.') for v in extent)} in {target}"
        )
    if own:  # whole pixels of the map, or all would be interpolated
        west = extent[0] + math.floor((west - extent[0]) / native + 1e-6) * native
        north = extent[3] - math.floor((extent[3] - north) / native + 1e-6) * native
    width, height = (max(1, math.ceil(v / step - 1e-6)) for v in (east - west, north - south))
    if width * height > MOST_PIXELS:
        raise UsageError(
            f"this part has {width} x {height} px; choose a larger --gsd or smaller --bounds"
        )
    return ExportGrid(
        crs=target, west=west, north=north, step=step, metres=metres, width=width, height=height
    )
