"""Images of any part of a map, in any projection, from any kind of source."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from skyquilt.errors import SideFileError
from skyquilt.raster.colours import Palette, coloured
from skyquilt.raster.drivers import open_raster, why_unreadable
from skyquilt.raster.tile_store import LEVELS, SIDE, Address, TileStore

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

MERCATOR = 20037508.342789244
"""Half the width of the Web Mercator square in m."""
NODES = 16
"""Spacing in px of the points that are transformed exactly."""
ROWS = 256
"""Rows of an image that are computed at a time."""
MOST_TILES = 320
"""Largest number of tiles read for one image."""
Bounds = tuple[float, float, float, float]
"""West, south, east, north."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """A piece of a map in its own projection."""

    pixels: NDArray[Any]
    """(h, w, bands)."""
    shown: NDArray[np.bool_]
    """(h, w) where the map has content."""
    west: float
    """Left edge in m."""
    north: float
    """Top edge in m."""
    gsd: float
    """Size of a pixel in m."""


@dataclass(frozen=True, kw_only=True)
class About:
    """What a map says of itself."""

    crs: str
    """Projection; empty where there is none."""
    bounds: Bounds
    """Extent in it."""
    bands: int
    """1, or 3 for colours."""
    dtype: str
    """Type of its pixels."""
    resolution: float
    """Size of a pixel."""
    tags: dict[str, str] = field(default_factory=dict)
    """Its own tags."""
    units: tuple[str, ...] = ()
    """Unit of each band; empty where none is stated."""
    names: tuple[str, ...] = ()
    """Name of each band; empty where none is stated."""


class MapSource(Protocol):
    """A map that can be read in parts."""

    @property
    def crs(self) -> str:
        """Its projection."""

    def about(self) -> About | None:
        """What it says of itself; None while it is empty."""

    def bounds(self) -> Bounds | None:
        """Its extent in its own projection; None while it is empty."""

    def part(self, bounds: Bounds, gsd: float) -> Part | None:
        """Pixels within the bounds, about as fine as `gsd`; None where the map has no content."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TileSource:
    """One layer of a growing map."""

    tiles: TileStore
    """The tiles."""
    layer: str
    """Its layer."""
    crs: str
    """Projection of the tiles."""
    origin: tuple[float, float]
    """Easting and northing of the map frame's origin in m."""
    gsd: float
    """Ground size of a pixel of level 0 in m."""

    def about(self) -> About | None:
        """Type and extent of the layer's content."""
        bounds = self.bounds()
        longest = 0.0 if bounds is None else max(bounds[2] - bounds[0], bounds[3] - bounds[1])
        part = None if bounds is None else self.part(bounds, longest / SIDE)
        if bounds is None or part is None:
            return None
        return About(
            crs=self.crs,
            bounds=bounds,
            bands=part.pixels.shape[2],
            dtype=part.pixels.dtype.name,
            resolution=self.gsd,
        )

    def bounds(self) -> Bounds | None:
        """Extent of the layer's content."""
        found = self.tiles.extent(self.layer, self.gsd)
        if found is None:
            return None
        x, y = self.origin
        return found[0] + x, found[1] + y, found[2] + x, found[3] + y

    def part(self, bounds: Bounds, gsd: float) -> Part | None:
        """The tiles of the level that is about as fine as requested, joined."""
        level = int(np.clip(np.floor(np.log2(max(gsd / self.gsd, 1e-9)) + 0.25), 0, LEVELS - 1))
        x, y = self.origin
        west, south, east, north = bounds[0] - x, bounds[1] - y, bounds[2] - x, bounds[3] - y
        while True:
            size = SIDE * self.gsd * 2**level
            r0, r1 = int(np.floor(-north / size)), int(np.floor(-south / size))
            c0, c1 = int(np.floor(west / size)), int(np.floor(east / size))
            if (r1 - r0 + 1) * (c1 - c0 + 1) <= MOST_TILES or level == LEVELS - 1:
                break
            level += 1
        if (r1 - r0 + 1) * (c1 - c0 + 1) > MOST_TILES:
            return None
        found = {}
        for r in range(r0, r1 + 1):
            for c in range(c0, c1 + 1):
                tile = self.tiles.get(Address(self.layer, level, r, c))
                if tile is not None:
                    found[r - r0, c - c0] = tile
        if not found:
            return None
        like = next(iter(found.values())).pixels
        shape = ((r1 - r0 + 1) * SIDE, (c1 - c0 + 1) * SIDE)
        pixels, shown = np.zeros((*shape, like.shape[2]), like.dtype), np.zeros(shape, bool)
        for (r, c), tile in found.items():
            at = (slice(r * SIDE, (r + 1) * SIDE), slice(c * SIDE, (c + 1) * SIDE))
            pixels[at], shown[at] = tile.pixels, tile.shown
        return Part(
            pixels=pixels,
            shown=shown,
            west=c0 * size + x,
            north=-r0 * size + y,
            gsd=self.gsd * 2**level,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class FileSource:
    """A finished map (GeoTIFF)."""

    path: Path
    """The file."""
    _known: dict[str, About] = field(default_factory=dict)

    @contextmanager
    def opened(self) -> "Iterator[DatasetReader]":
        """The file; it may be damaged, or have been replaced since it was opened first.

        Raises:
            SideFileError: it cannot be read.
        """
        from rasterio.errors import RasterioError

        try:
            with open_raster(self.path) as raster:
                yield raster
        except (RasterioError, UnicodeDecodeError) as error:
            raise SideFileError(
                f"{self.path.name} cannot be read as a map: {why_unreadable(error)}; copy it again,"
                " or make it again"
            ) from error

    def about(self) -> About:
        """What the file says of itself, read once.

        Raises:
            SideFileError: it cannot be read.
        """
        if not self._known:
            with self.opened() as raster:
                bands = 3 if raster.count >= 3 else 1
                system = raster.crs
                units, names = (
                    tuple(word or "" for word in words[:bands])
                    for words in (raster.units, raster.descriptions)
                )
                self._known["about"] = About(
                    crs=plane(system.to_string()) if system else "",
                    bounds=tuple(raster.bounds),
                    bands=bands,
                    dtype=raster.dtypes[0],
                    resolution=float(raster.res[0]),
                    tags={k: str(v) for k, v in raster.tags().items() if k != "AREA_OR_POINT"},
                    units=units if any(units) else (),
                    names=names if any(names) else (),
                )
        return self._known["about"]

    @property
    def crs(self) -> str:
        """Its projection; empty where it has none."""
        return self.about().crs

    def bounds(self) -> Bounds | None:
        """Its extent."""
        return self.about().bounds

    def resolution(self) -> float:
        """Size of a pixel in units of its projection."""
        return self.about().resolution

    def part(self, bounds: Bounds, gsd: float) -> Part | None:
        """The part, read from a suitable overview of the file.

        Raises:
            SideFileError: it cannot be read.
        """
        from rasterio.windows import from_bounds

        with self.opened() as raster:
            left, top = raster.bounds.left, raster.bounds.top
            west, south, east, north = (
                max(bounds[0], left),
                max(bounds[1], raster.bounds.bottom),
                min(bounds[2], raster.bounds.right),
                min(bounds[3], top),
            )
            if west >= east or south >= north:
                return None
            step = step_of(gsd, raster.res[0], max(east - west, north - south))
            # whole steps from the corner, or neighbouring parts would show shifted pixels
            west = left + math.floor((west - left) / step + 1e-6) * step
            north = top - math.floor((top - north) / step + 1e-6) * step
            h, w = (max(1, math.ceil(v / step - 1e-6)) for v in (north - south, east - west))
            window = from_bounds(west, south, west + w * step, north, raster.transform)
            window = from_bounds(west, north - h * step, west + w * step, north, raster.transform)
            bands = list(range(1, self.about().bands + 1))
            pixels = raster.read(
                bands, window=window, out_shape=(len(bands), h, w), boundless=True, fill_value=0
            )
            mask = raster.dataset_mask(window=window, out_shape=(h, w), boundless=True) > 0
        moved = np.ascontiguousarray(np.moveaxis(pixels, 0, -1))
        if moved.dtype.kind == "f":
            mask &= np.isfinite(moved).all(-1)
            moved = np.nan_to_num(moved).astype(np.float32)
        return Part(pixels=moved, shown=mask, west=west, north=north, gsd=step)


def step_of(gsd: float, own: float, longest: float) -> float:
    """Size of a part's pixels: as wanted, none finer than the map's own, at most 4096 of them."""
    step = max(gsd, own, longest / 4096)
    return own if step < 1.001 * own else step


def plane(crs: str) -> str:
    """The horizontal part of a projection: a map is a plane, whatever its heights refer to."""
    from pyproj import CRS

    known = CRS(crs)
    if not known.is_compound and len(known.axis_info) < 3:
        return crs
    flat = known.sub_crs_list[0] if known.is_compound else known.to_2d()
    code = flat.to_epsg()
    return f"EPSG:{code}" if code else str(flat.to_wkt())


@lru_cache(maxsize=64)
def between(source: str, target: str) -> Transformer:
    """The transformation of coordinates (x, y) from one projection to another."""
    return Transformer.from_crs(source, target, always_xy=True)


def picture(
    source: MapSource,
    crs: str,
    bounds: Bounds,
    width: int,
    height: int,
    scale: tuple[float, float] | None = None,
    palette: Palette = "heat",
) -> NDArray[np.uint8] | None:
    """RGBA (height, width, 4) of bounds in any projection; None where the map has no content.

    `scale`: for measured values, those (degrees Celsius, counts, m) shown in the first and in the
    last colour of the palette.
    """
    found = _located(source, crs, bounds, width, height)
    if found is None:
        return None
    part, u, v = found
    if scale is None and part.pixels.dtype != np.uint8 and palette != "numbers":
        scale = _scale_of(part)
    colour, shown = coloured(part.pixels, scale, palette), part.shown.astype(np.uint8) * 255
    out = np.empty((height, width, 4), np.uint8)
    for r0 in range(0, height, ROWS):  # the coordinates of all pixels would need most memory
        band = slice(r0, min(r0 + ROWS, height))
        ui, vi = (_dense(m, band, width) for m in (u, v))
        warped = cv2.remap(colour, ui, vi, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        out[band, :, :3] = warped.reshape(-1, width, 3)
        out[band, :, 3] = cv2.remap(
            shown, ui, vi, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT
        )
    return out if out[..., 3].any() else None


def _scale_of(part: Part) -> tuple[float, float]:
    """The range of what is shown; what stands where nothing is may be anything."""
    shown = part.pixels[part.shown]
    return (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 1.0)


def values(
    source: MapSource, crs: str, bounds: Bounds, width: int, height: int
) -> tuple[NDArray[Any], NDArray[np.bool_]] | None:
    """The map's own values (height, width, bands) of bounds in any projection, and where it has
    any; None where it has no content.

    Measured values are interpolated among valid ones only; numbers (of photos) are never mixed.
    """
    found = _located(source, crs, bounds, width, height)
    if found is None:
        return None
    part, u, v = found
    pixels, shown = part.pixels, part.shown.astype(np.float32)
    whole = slice(0, height)
    ui, vi = (_dense(m, whole, width) for m in (u, v))
    inside = cv2.remap(shown, ui, vi, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 0
    if pixels.dtype.kind == "f":
        weighted = np.where(part.shown[..., None], pixels, 0).astype(np.float32)
        sums = cv2.remap(weighted, ui, vi, cv2.INTER_LINEAR).reshape(height, width, -1)
        weight = cv2.remap(shown, ui, vi, cv2.INTER_LINEAR)
        inside &= weight > 0.01
        out: NDArray[Any] = sums / np.maximum(weight, 0.01)[..., None]
    else:
        how = cv2.INTER_LINEAR if pixels.dtype == np.uint8 else cv2.INTER_NEAREST
        out = np.asarray(cv2.remap(pixels, ui, vi, how, borderMode=cv2.BORDER_REPLICATE))
    return out.reshape(height, width, -1).astype(pixels.dtype), inside


def _located(
    source: MapSource, crs: str, bounds: Bounds, width: int, height: int
) -> tuple[Part, NDArray[np.float32], NDArray[np.float32]] | None:
    """The part of a map that an image shows, and its columns and rows at the image's nodes."""
    columns, rows = (
        np.arange(-1, width // NODES + 2) * NODES,
        np.arange(-1, height // NODES + 2) * NODES,
    )
    x = bounds[0] + (columns + 0.5) / width * (bounds[2] - bounds[0])
    y = bounds[3] - (rows + 0.5) / height * (bounds[3] - bounds[1])
    gx, gy = np.meshgrid(x, y)
    mx, my = between(crs, source.crs).transform(gx, gy) if crs != source.crs else (gx, gy)
    mx, my = np.asarray(mx, np.float64), np.asarray(my, np.float64)
    extent = source.bounds()
    if extent is None or not np.isfinite(mx).all() or not np.isfinite(my).all():
        return None
    box = (
        max(mx.min(), extent[0]),
        max(my.min(), extent[1]),
        min(mx.max(), extent[2]),
        min(my.max(), extent[3]),
    )
    if box[0] >= box[2] or box[1] >= box[3]:
        return None
    gsd = float(np.median(np.hypot(np.diff(mx, axis=1), np.diff(my, axis=1)))) / NODES
    part = source.part(box, gsd)
    if part is None:
        return None
    u = ((mx - part.west) / part.gsd - 0.5).astype(np.float32)
    v = ((part.north - my) / part.gsd - 0.5).astype(np.float32)
    return part, u, v


def _dense(nodes: NDArray[np.float32], rows: slice, width: int) -> NDArray[np.float32]:
    """Values at every NODES-th pixel, the first one at -NODES, interpolated to all pixels of these
    rows.
    """
    c, r = np.meshgrid(
        np.arange(width, dtype=np.float32), np.arange(rows.start, rows.stop, dtype=np.float32)
    )
    return np.asarray(cv2.remap(nodes, c / NODES + 1, r / NODES + 1, cv2.INTER_LINEAR), np.float32)


def mercator(z: int, x: int, y: int) -> Bounds:
    """Bounds of a tile in EPSG:3857."""
    size = 2 * MERCATOR / 2**z
    return (
        x * size - MERCATOR,
        MERCATOR - (y + 1) * size,
        (x + 1) * size - MERCATOR,
        MERCATOR - y * size,
    )
