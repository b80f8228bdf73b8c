"""How many photos see each place of an area, counted as they come: a raster in Web Mercator, which
maps in browsers show as it is.
"""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer
from rasterio.features import rasterize
from rasterio.io import MemoryFile
from rasterio.transform import Affine
from shapely import Polygon, transform
from shapely.geometry.base import BaseGeometry

from skyquilt.raster.atomic import whole_file

MERCATOR = "EPSG:3857"
MOST_CELLS = 250_000
"""Cells of a raster; large areas have larger cells."""
FINEST_M = 0.25
"""Least side of a cell on the ground."""
OUTSIDE = 65_535
"""Stands for cells outside the area in files."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cover:
    """Cells over an area and the photos that see them."""

    west: float
    """Left edge in Web Mercator."""
    north: float
    """Upper edge."""
    cell: float
    """Side of a cell in Web Mercator."""
    inside: NDArray[np.bool_]
    """(rows, columns), True where the middle of a cell lies in the area."""
    ground_m: float
    """Side of a cell on the ground in m."""

    @property
    def affine(self) -> Affine:
        """From columns and rows to Web Mercator."""
        return Affine(self.cell, 0, self.west, 0, -self.cell, self.north)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north in degrees."""
        rows, columns = self.inside.shape
        back = Transformer.from_crs(MERCATOR, "EPSG:4326", always_xy=True)
        west, north = back.transform(self.west, self.north)
        east, south = back.transform(self.west + columns * self.cell, self.north - rows * self.cell)
        return float(west), float(south), float(east), float(north)

    def seen(self, ring: NDArray[np.float64]) -> NDArray[np.int32]:
        """Flat indices of the area's cells whose middles lie in a footprint (n, 2), Mercator."""
        rows, columns = self.inside.shape
        if len(ring) < 3 or not np.isfinite(ring).all():
            return np.empty(0, np.int32)
        c = (ring[:, 0] - self.west) / self.cell
        r = (self.north - ring[:, 1]) / self.cell
        c0, c1 = max(int(c.min()), 0), min(int(c.max()) + 1, columns)
        r0, r1 = max(int(r.min()), 0), min(int(r.max()) + 1, rows)
        if c0 >= c1 or r0 >= r1:
            return np.empty(0, np.int32)
        local = Polygon(np.column_stack([c - c0, r - r0]))
        drawn = rasterize([local], (r1 - r0, c1 - c0), transform=Affine.identity(), dtype=np.uint8)
        found = (drawn > 0) & self.inside[r0:r1, c0:c1]
        i, j = np.nonzero(found)
        return np.asarray((i + r0) * columns + j + c0, np.int32)

    def counts(self, seen: Sequence[NDArray[np.int32]]) -> NDArray[np.int32]:
        """(rows, columns) number of photos."""
        flat = np.concatenate(seen) if len(seen) else np.empty(0, np.int32)
        found = np.bincount(flat, minlength=self.inside.size).astype(np.int32)
        return found.reshape(self.inside.shape)


def cover_of(area: BaseGeometry, crs: str, cell_m: float | None = None) -> Cover:
    """The cells of an area given in a projection."""
    there = Transformer.from_crs(crs, MERCATOR, always_xy=True)
    shape = transform(area, lambda xy: np.column_stack(there.transform(xy[:, 0], xy[:, 1])))
    west, south, east, north = shape.bounds
    back = Transformer.from_crs(MERCATOR, "EPSG:4326", always_xy=True)
    latitude = back.transform((west + east) / 2, (south + north) / 2)[1]
    scale = 1 / math.cos(math.radians(latitude))
    least = math.sqrt((east - west) * (north - south) / MOST_CELLS)
    cell = max(least, (cell_m or FINEST_M) * scale, FINEST_M * scale)
    form = int((north - south) / cell) + 1, int((east - west) / cell) + 1
    drawn = rasterize([shape], form, transform=Affine(cell, 0, west, 0, -cell, north),
                      dtype=np.uint8)  # fmt: skip
    return Cover(west=west, north=north, cell=cell, inside=drawn > 0, ground_m=cell / scale)


def to_mercator(ring: NDArray[np.float64], crs: str = "EPSG:4326") -> NDArray[np.float64]:
    """Places (n, 2) in Web Mercator."""
    there = Transformer.from_crs(crs, MERCATOR, always_xy=True)
    return np.column_stack(there.transform(ring[:, 0], ring[:, 1]))


def picture_of(cover: Cover, counts: NDArray[np.int32], views: int) -> bytes:
    """A PNG of the raster: red = none, orange to yellow = too few, greens = enough."""
    rgba = np.zeros((*counts.shape, 4), np.uint8)
    short = np.clip(counts / max(views, 1), 0, 1)
    rgba[..., 2] = 220
    rgba[..., 1] = (40 + 150 * short).astype(np.uint8)
    rgba[..., 0] = 30
    enough = counts >= views
    more = np.clip((counts - views) / max(views, 1), 0, 1)[enough]
    rgba[enough] = np.column_stack([
        90 - 40 * more, 175 - 75 * more, 40 + 0 * more, np.zeros(len(more))
    ]).astype(np.uint8)  # fmt: skip
    rgba[..., 3] = np.where(cover.inside, 150, 0)
    return bytes(cv2.imencode(".png", rgba)[1])


def as_uri(png: bytes) -> str:
    """A picture inside JSON."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def write_cover(path: Path, cover: Cover, counts: NDArray[np.int32]) -> None:
    """A GeoTIFF of the counts; outside the area 65535."""
    values = np.where(cover.inside, np.minimum(counts, OUTSIDE - 1), OUTSIDE).astype(np.uint16)
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff", width=values.shape[1], height=values.shape[0], count=1, dtype="uint16",
            crs=MERCATOR, transform=cover.affine, nodata=OUTSIDE, compress="deflate",
        ) as raster:  # fmt: skip
            raster.write(values, 1)
        with whole_file(path) as file:
            file.write(memory.read())
