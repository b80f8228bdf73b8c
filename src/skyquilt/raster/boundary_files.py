"""Polygons in the file formats people draw them in: each reader returns shapes and the CRS they are
in.
"""

import json
import sqlite3
import struct
import zipfile
from collections.abc import Callable
from contextlib import closing
from functools import reduce
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from defusedxml.ElementTree import fromstring
from shapely import LineString, Polygon, force_2d, from_wkb, from_wkt
from shapely.geometry import shape as from_geojson
from shapely.geometry.base import BaseGeometry

Shapes = tuple[list[BaseGeometry], str | None]
"""Two-dimensional shapes and their CRS as pyproj reads it; None = the output's."""

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
    """All polygons of a KML file; a path that ends where it began counts as one."""
    return _kml_shapes(path.read_bytes()), WGS84


def read_kmz(path: Path) -> Shapes:
    """Every KML inside the archive."""
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
    """Bytes before the WKB: 8 and an envelope of 0, 32, 48 or 64."""
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
    return [reduce(lambda area, ring: area.symmetric_difference(ring), rings)]  # holes lie inside


READERS: dict[str, Callable[[Path], Shapes]] = {
    ".geojson": read_geojson,
    ".json": read_geojson,
    ".kml": read_kml,
    ".kmz": read_kmz,
    ".wkt": read_wkt,
    ".gpkg": read_geopackage,
    ".shp": read_shapefile,
}
