"""A map as web tiles (EPSG:3857), and as MBTiles."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skyquilt.outside import put_in_place, remove_file
from skyquilt.raster.atomic import mended
from skyquilt.raster.map_source import MERCATOR, Bounds, FileSource, between, mercator, picture
from skyquilt.raster.mbtiles import touched, write_mbtiles
from skyquilt.raster.picture_files import image_bytes
from skyquilt.runs.grid import ExportGrid
from skyquilt.runs.layers import RunLayer

SIDE = 256
"""Pixels of a tile's side."""
MOST_ZOOM = 24
AT_ONCE = 500
"""Tiles kept in memory before they are written."""
Tile = tuple[int, int, int, NDArray[np.uint8]]
"""Zoom, column, row from the north, RGBA."""


@dataclass(frozen=True, kw_only=True)
class WebTiles:
    """The tiles of a part of a map, drawn one after the other."""

    source: FileSource
    """The map."""
    layer: RunLayer
    """Its colours."""
    scale: tuple[float, float] | None
    """Values shown in the first and in the last colour."""
    degrees: Bounds
    """The part in degrees."""
    box: Bounds
    """The part in EPSG:3857."""
    zooms: tuple[int, int]
    """Coarsest and finest level."""

    def __iter__(self) -> Iterator[Tile]:
        for z in range(self.zooms[0], self.zooms[1] + 1):
            for x, y in sorted(touched([self.box], z)):
                if not (0 <= x < 2**z and 0 <= y < 2**z):
                    continue
                bounds = mercator(z, x, y)
                rgba = picture(
                    self.source, "EPSG:3857", bounds, SIDE, SIDE, self.scale, self.layer.palette
                )
                if rgba is not None and self._cut(rgba, bounds):
                    yield z, x, y, rgba

    def _cut(self, rgba: NDArray[np.uint8], bounds: Bounds) -> bool:
        """Clears what lies outside the part; whether anything is left."""
        size = (bounds[2] - bounds[0]) / SIDE
        x = bounds[0] + (np.arange(SIDE) + 0.5) * size
        y = bounds[3] - (np.arange(SIDE) + 0.5) * size
        west, south, east, north = self.box
        rgba[:, (x < west) | (x > east), 3] = 0
        rgba[(y < south) | (y > north), :, 3] = 0
        return bool(rgba[..., 3].any())


def web_tiles(
    source: FileSource, grid: ExportGrid, scale: tuple[float, float] | None, layer: RunLayer
) -> WebTiles:
    """The tiles of the part that a grid covers, about as fine as the grid."""
    degrees = between(grid.crs, "EPSG:4326").transform_bounds(*grid.whole)
    box = between(grid.crs, "EPSG:3857").transform_bounds(*grid.whole)
    shrunk = math.cos(math.radians((degrees[1] + degrees[3]) / 2))
    finest = math.log2(2 * MERCATOR / SIDE * shrunk / grid.metres)
    top = int(np.clip(round(finest), 0, MOST_ZOOM))
    longest = max(box[2] - box[0], box[3] - box[1])
    low = int(np.clip(math.floor(math.log2(2 * MERCATOR / longest)), 0, top))
    return WebTiles(
        source=source, layer=layer, scale=scale, degrees=degrees, box=box, zooms=(low, top)
    )


def write_mbtiles_file(
    path: Path,
    source: FileSource,
    grid: ExportGrid,
    scale: tuple[float, float] | None,
    layer: RunLayer,
) -> None:
    """Writes the tiles as MBTiles (WebP).

    Raises:
        OutputError: the file cannot be written.
    """
    tiles = web_tiles(source, grid, scale, layer)
    partial = path.with_name(path.name + ".partial")
    with mended(path):
        remove_file(partial)
        made: list[tuple[int, int, int, bytes | None]] = []

        def write() -> None:
            write_mbtiles(partial, made, name=layer.title, bounds=tiles.degrees, zooms=tiles.zooms)
            made.clear()

        for z, x, y, rgba in tiles:
            made.append((z, x, y, image_bytes(rgba, "image/webp")))
            if len(made) >= AT_ONCE:
                write()
        write()
        put_in_place(partial, path)
