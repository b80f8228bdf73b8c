"""The area to be mapped: polygons from GeoJSON, KML, GeoPackage or Shapefile in the output CRS, and
the map's pixels inside them.
"""

import json
import sqlite3
import struct
import zipfile
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import reduce
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from defusedxml.ElementTree import fromstring
from numpy.typing import NDArray
from shapely import (
    LineString,
    MultiPolygon,
    Polygon,
    force_2d,
    from_wkb,
    from_wkt,
    make_valid,
    segmentize,
    transform,
    union_all,
)
from shapely.geometry import shape as from_geojson
from shapely.geometry.base import BaseGeometry
from shapely.prepared import prep

from skyquilt.errors import SideFileError

SEGMENTS = 100
"""An outline is divided into segments of at most its extent over this number before it is
projected, because straight lines become curved.
"""


def read_boundary(path: Path, crs: str | None) -> Polygon | MultiPolygon:
    """The union of all polygons of a GeoJSON, KML, KMZ, WKT, GeoPackage or Shapefile, in `crs`.

    WKT is in the output CRS already; the others state theirs. For an output without georeference
    (`crs` None) only WKT is accepted.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise SideFileError(
            f"{path.name}: a boundary is one of {', '.join(READERS)}, got '{path.suffix}'"
        )
    try:
        shapes, source = reader(path)
    except OSError as error:
        raise SideFileError(f"{path} cannot be read: {error.strerror or error}") from error
    except Exception as error:
        raise SideFileError(
            f"{path.name} is not a readable {path.suffix[1:]} file: {error}"
        ) from error
    areas = [area for shape in shapes for area in _areas(make_valid(shape))]
    if not areas:
        kinds = sorted({shape.geom_type for shape in shapes}) or ["nothing"]
        raise SideFileError(
            f"{path.name}: a boundary needs at least one polygon, found {', '.join(kinds)}"
        )
    return _polygonal(_projected(union_all(areas), path, source, crs))


def inside(
    polygon: BaseGeometry, affine: Sequence[float], *, row0: int, col0: int, height: int, width: int
) -> NDArray[np.bool_]:
    """(height, width), True where a pixel's centre lies in the polygon, for a window of a raster.

    `affine` is that of the whole raster (a, b, c, d, e, f); the polygon is in its CRS.
    """
    from rasterio.features import geometry_mask
    from rasterio.transform import Affine

    a, b, c, d, e, f = tuple(affine)[:6]
    x, y = a * col0 + b * row0 + c, d * col0 + e * row0 + f
    corners = [(0, 0), (width, 0), (width, height), (0, height)]
    window = Polygon([(x + a * col + b * row, y + d * col + e * row) for col, row in corners])
    prepared = prep(polygon)
    if not prepared.intersects(window):
        return np.zeros((height, width), bool)
    if prepared.contains(window):
        return np.ones((height, width), bool)
    return np.asarray(
        geometry_mask([polygon], (height, width), Affine(a, b, x, d, e, y), invert=True)
    )


def _areas(shape: BaseGeometry) -> list[Polygon]:
    parts = getattr(shape, "geoms", None)
    if parts is not None:
        return [area for part in parts for area in _areas(part)]
    return [shape] if isinstance(shape, Polygon) and shape.area > 0 else []


def _polygonal(shape: BaseGeometry) -> Polygon | MultiPolygon:
    areas = _areas(make_valid(shape))
    return areas[0] if len(areas) == 1 else MultiPolygon(areas)


def _projected(
    shape: BaseGeometry, path: Path, source: str | None, crs: str | None
) -> BaseGeometry:
    if source is None:
        return shape
    if crs is None:
        raise SideFileError(
            f"{path.name} is in {source}, but this mosaic is not georeferenced. "
            "Give the boundary as WKT in the mosaic's own coordinates, or leave it out."
        )
    import pyproj

    try:
        transformer = pyproj.Transformer.from_crs(source, pyproj.CRS(crs).to_2d(), always_xy=True)
    except pyproj.exceptions.CRSError as error:
        raise SideFileError(
            f"{path.name}: the CRS '{source[:60]}' is not known: {error}"
        ) from error
    west, south, east, north = shape.bounds
    fine = segmentize(shape, max(east - west, north - south) / SEGMENTS)
    placed = transform(fine, lambda xy: np.column_stack(transformer.transform(xy[:, 0], xy[:, 1])))
    if not np.isfinite(placed.bounds).all():
        raise SideFileError(
            f"{path.name}: its coordinates {shape.bounds} do not fit its CRS ({source[:60]})"
        )
    return placed


Shapes = tuple[list[BaseGeometry], str | None]
"""Two-dimensional shapes and their CRS as pyproj reads it; None = the output's CRS."""

WGS84 = "EPSG:4326"


def read_geojson(path: Path) -> Shapes:
    """RFC 7946, or the older form with a `crs` member that GIS programs still write."""
    content = json.loads(path.read_text(encoding="utf-8-sig"))
    named = content.get("crs") or {}
    crs = named.get("properties", {}).get("name", WGS84)
    return [force_2d(from_geojson(geometry)) for geometry in _geometries(content)], str(crs)


def _geometries(content: dict[str, Any]) -> list[dict[str, Any]]:
    if content.get("type") == "FeatureCollection":
        return [geometry for feature in content["features"] for geometry in _geometries(feature)]
    if content.get("type") == "Feature":
        return [content["geometry"]] if content.get("geometry") else []
    return [content]


def read_kml(path: Path) -> Shapes:
    """All polygons of a KML file; a path whose last point equals its first counts as a polygon."""
    return _kml_shapes(path.read_bytes()), WGS84


def read_kmz(path: Path) -> Shapes:
    """All polygons of every KML file inside the archive."""
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.lower().endswith(".kml")]
        return [shape for name in names for shape in _kml_shapes(archive.read(name))], WGS84


def _kml_shapes(text: bytes) -> list[BaseGeometry]:
    root = fromstring(text)
    shapes: list[BaseGeometry] = []
    for polygon in root.iterfind(".//{*}Polygon"):
        (outer,) = (
            _kml_places(ring) for ring in polygon.iterfind("{*}outerBoundaryIs//{*}coordinates")
        )
        holes = [
            _kml_places(ring) for ring in polygon.iterfind("{*}innerBoundaryIs//{*}coordinates")
        ]
        shapes.append(Polygon(outer, holes))
    for line in root.iterfind(".//{*}LineString/{*}coordinates"):
        places = _kml_places(line)
        closed = len(places) > 3 and places[0] == places[-1]
        shapes.append(Polygon(places) if closed else LineString(places))
    return shapes


def _kml_places(element: Any) -> list[tuple[float, float]]:
    triples = [word.split(",") for word in (element.text or "").split()]
    return [(float(triple[0]), float(triple[1])) for triple in triples]


def read_wkt(path: Path) -> Shapes:
    """One geometry as well-known text, in the output's CRS; `SRID=32615;POLYGON ...` states
    another.
    """
    text = path.read_text(encoding="utf-8-sig").strip()
    srid, _, rest = text.partition(";") if text.upper().startswith("SRID=") else ("", "", text)
    return [force_2d(from_wkt(rest))], f"EPSG:{int(srid[5:])}" if srid else None


def read_geopackage(path: Path) -> Shapes:
    """The first feature table of a GeoPackage (OGC 12-128r18)."""
    if not path.is_file():
        raise FileNotFoundError(2, "No such file or directory")
    with closing(sqlite3.connect(path.absolute().as_uri() + "?mode=ro", uri=True)) as base:
        found = "SELECT table_name, column_name, srs_id FROM gpkg_geometry_columns LIMIT 1"
        table, column, srs = base.execute(found).fetchone()
        columns = "organization, organization_coordsys_id, definition"
        naming = f"SELECT {columns} FROM gpkg_spatial_ref_sys WHERE srs_id = ?"
        authority, code, definition = base.execute(naming, (srs,)).fetchone()
        table, column = (name.replace('"', '""') for name in (table, column))
        blobs = [row[0] for row in base.execute(f'SELECT "{column}" FROM "{table}"') if row[0]]
    crs = f"{authority}:{code}" if authority.upper() == "EPSG" else definition
    return [force_2d(from_wkb(blob[_gpkg_header(blob) :])) for blob in blobs], crs


def _gpkg_header(blob: bytes) -> int:
    """Number of bytes before the WKB: 8 plus an envelope of 0, 32, 48 or 64."""
    return 8 + (0, 32, 48, 48, 64)[blob[3] >> 1 & 7]


def read_shapefile(path: Path) -> Shapes:
    """Polygons (types 5, 15, 25) of a Shapefile with its `.prj` beside it (ESRI white paper,
    1998).
    """
    data, at, shapes = path.read_bytes(), 100, []
    if data[:4] != b"\0\0\x27\x0a":
        raise ValueError("the file code is not 9994")
    while at < len(data):
        size = 2 * int.from_bytes(data[at + 4 : at + 8], "big")
        shapes += _shp_polygon(data[at + 8 : at + 8 + size])
        at += 8 + size
    projection = path.with_suffix(".prj")
    return shapes, projection.read_text() if projection.exists() else WGS84


def _shp_polygon(record: bytes) -> list[BaseGeometry]:
    (kind,) = struct.unpack_from("<i", record)
    if kind not in (5, 15, 25):
        return []
    parts, count = struct.unpack_from("<ii", record, 36)
    starts = [*struct.unpack_from(f"<{parts}i", record, 44), count]
    places = np.frombuffer(record, "<f8", 2 * count, 44 + 4 * parts).reshape(count, 2)
    rings = [Polygon(places[start:end]) for start, end in pairwise(starts)]
    # rings inside others are holes
    return [reduce(lambda area, ring: area.symmetric_difference(ring), rings)]


READERS: dict[str, Callable[[Path], Shapes]] = {
    ".geojson": read_geojson,
    ".json": read_geojson,
    ".kml": read_kml,
    ".kmz": read_kmz,
    ".wkt": read_wkt,
    ".gpkg": read_geopackage,
    ".shp": read_shapefile,
}
