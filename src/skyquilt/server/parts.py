"""Parts of a map as GeoTIFF, bounded in size."""

import math
from pathlib import Path

from skyquilt.raster.map_source import Bounds, MapSource
from skyquilt.runs.export import write_tif
from skyquilt.runs.grid import grid_of
from skyquilt.runs.layers import RunLayer

MOST_PIXELS = 60_000_000
"""Largest part in pixels; larger ones get coarser pixels."""


def write_part(source: MapSource, layer: RunLayer, bounds: Bounds | None, path: Path) -> bool:
    """Writes what a map has within bounds (its projection; None = all of it); False, and no file,
    where it has nothing.

    Raises:
        UsageError: nothing of the map lies within the bounds. OutputError: the disk is full.
    """
    grid = grid_of(source, bounds, None, None)
    coarser = math.sqrt(grid.width * grid.height / MOST_PIXELS)
    if coarser > 1:
        grid = grid_of(source, bounds, None, coarser * grid.metres)
    return write_tif(source, layer, grid, path)
