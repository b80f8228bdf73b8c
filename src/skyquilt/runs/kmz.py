"""A map as KMZ: pictures in levels that Google Earth loads as it comes closer (OGC KML 2.3,
regions).
"""

import math
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.frames import METRES_PER_DEGREE
from skyquilt.raster.atomic import whole_file
from skyquilt.raster.map_source import Bounds, FileSource, between, picture
from skyquilt.raster.picture_files import image_bytes
from skyquilt.runs.grid import ExportGrid
from skyquilt.runs.layers import RunLayer

SIDE = 512
"""Pixels of a picture's side."""
MOST_LEVELS = 14
HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n'
Address = tuple[int, int, int]
"""Level, row, column."""


@dataclass(frozen=True, kw_only=True)
class _Pyramid:
    """A square of ground, halved again and again."""

    source: FileSource
    layer: RunLayer
    scale: tuple[float, float] | None
    part: Bounds
    """What is shown, in degrees."""
    levels: int
    """Number of levels below the first."""

    @property
    def side(self) -> tuple[float, float]:
        """Degrees of longitude and latitude of the whole square."""
        west, south, east, north = self.part
        shrink = math.cos(math.radians((south + north) / 2))
        tall = max(north - south, (east - west) * shrink)
        return tall / shrink, tall

    def box(self, at: Address) -> Bounds:
        level, row, column = at
        w, h = (v / 2**level for v in self.side)
        west, north = self.part[0] + column * w, self.part[3] - row * h
        return west, north - h, west + w, north

    def drawn(self, at: Address) -> NDArray[np.uint8] | None:
        """A picture, clear outside the part; None where there is nothing."""
        box = self.box(at)
        west, south, east, north = self.part
        if box[0] >= east or box[1] >= north or box[2] <= west or box[3] <= south:
            return None
        rgba = picture(self.source, "EPSG:4326", box, SIDE, SIDE, self.scale, self.layer.palette)
        if rgba is None:
            return None
        x = box[0] + (np.arange(SIDE) + 0.5) / SIDE * (box[2] - box[0])
        y = box[3] - (np.arange(SIDE) + 0.5) / SIDE * (box[3] - box[1])
        rgba[:, x > east, 3] = 0
        rgba[y < south, :, 3] = 0
        return rgba if rgba[..., 3].any() else None

    def children(self, at: Address) -> Iterator[Address]:
        level, row, column = at
        if level < self.levels:
            for k in range(4):
                yield level + 1, 2 * row + k // 2, 2 * column + k % 2


def write_kmz(
    path: Path,
    source: FileSource,
    grid: ExportGrid,
    scale: tuple[float, float] | None,
    layer: RunLayer,
    title: str,
) -> None:
    """Writes the part of a map that a grid covers, about as fine as the grid.

    Raises:
        OutputError: the file cannot be written.
    """
    part = between(grid.crs, "EPSG:4326").transform_bounds(*grid.whole)
    pyramid = _Pyramid(source=source, layer=layer, scale=scale, part=part, levels=0)
    pixels = pyramid.side[1] * METRES_PER_DEGREE / grid.metres
    levels = int(np.clip(math.ceil(math.log2(max(pixels / SIDE, 1)) - 0.25), 0, MOST_LEVELS))
    pyramid = _Pyramid(source=source, layer=layer, scale=scale, part=part, levels=levels)
    with whole_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        name = escape(f"{title} - {layer.title}")
        link = _link((0, 0, 0), pyramid)
        doc = f"{HEAD}<Document><name>{name}</name>{link}</Document></kml>\n"
        _put(archive, "doc.kml", doc)
        _write(archive, pyramid, (0, 0, 0))


def _write(archive: zipfile.ZipFile, pyramid: _Pyramid, at: Address) -> bool:
    """Writes a picture and all below it; False if there is nothing."""
    rgba = pyramid.drawn(at)
    if rgba is None:
        return False
    below = [c for c in pyramid.children(at) if _write(archive, pyramid, c)]
    clear = bool((rgba[..., 3] == 0).any())
    kind, ending = ("image/png", "png") if clear else ("image/jpeg", "jpg")
    level, row, column = at
    name = f"{level}-{row}-{column}"
    _put(archive, f"{name}.{ending}", image_bytes(rgba, kind))
    links = "".join(_link(c, pyramid) for c in below)
    overlay = (
        f"<GroundOverlay><drawOrder>{level}</drawOrder>"
        f"<Icon><href>{name}.{ending}</href></Icon>"
        f"<LatLonBox>{_edges(pyramid.box(at))}</LatLonBox></GroundOverlay>"
    )
    region = _region(pyramid.box(at), 128 if level else 0)
    _put(archive, f"{name}.kml", f"{HEAD}<Document>{region}{overlay}{links}</Document></kml>\n")
    return True


def _put(archive: zipfile.ZipFile, name: str, content: str | bytes) -> None:
    """Writes a file without the time of day, so that equal maps give equal archives."""
    about = zipfile.ZipInfo(name)
    about.external_attr = 0o600 << 16
    archive.writestr(about, content)


def _link(at: Address, pyramid: _Pyramid) -> str:
    # all files lie side by side: GDAL since 3.12 refuses links with ".."
    level, row, column = at
    region = _region(pyramid.box(at), 128 if level else 0)
    return (
        f"<NetworkLink>{region}<Link><href>{level}-{row}-{column}.kml</href>"
        "<viewRefreshMode>onRegion</viewRefreshMode></Link></NetworkLink>"
    )


def _region(box: Bounds, least_px: int) -> str:
    return (
        f"<Region><LatLonAltBox>{_edges(box)}</LatLonAltBox>"
        f"<Lod><minLodPixels>{least_px}</minLodPixels><maxLodPixels>-1</maxLodPixels></Lod></Region>"
    )


def _edges(box: Bounds) -> str:
    west, south, east, north = box
    return (
        f"<north>{north:.10f}</north><south>{south:.10f}</south>"
        f"<east>{east:.10f}</east><west>{west:.10f}</west>"
    )
