"""Shapes with their properties from GeoJSON, KML, KMZ, GeoPackage and Shapefile."""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from defusedxml.ElementTree import fromstring
from shapely import MultiLineString, force_2d
from shapely.geometry import shape as from_geojson
from shapely.geometry.base import BaseGeometry

from skyquilt.errors import SideFileError
from skyquilt.outside import plain, read_bounded
from skyquilt.raster import boundary
from skyquilt.raster.well_known import of_wkb

MOST_FEATURES = 2000
"""Largest number of shapes of a file."""
MOST_FIELDS = 256
"""Largest number of columns of a .dbf file."""


@dataclass(frozen=True, kw_only=True)
class Feature:
    """A shape and what the file says of it."""

    shape: BaseGeometry
    """In the file's coordinates."""
    properties: dict[str, str] = field(default_factory=dict)
    """Text by name in small letters."""


Found = tuple[list[Feature], str]
"""The features and their CRS as pyproj reads it."""


def read_features(path: Path) -> Found:
    """All shapes of a file; raises SideFileError where it cannot be read."""
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise SideFileError(
            f"{path.name}: areas are one of {', '.join(READERS)}, got '{path.suffix}'"
        )
    try:
        found, crs = reader(path)
        if len(found) > MOST_FEATURES:
            raise ValueError(f"it has {len(found)} shapes, and {MOST_FEATURES} are the most")
        boundary.check_size([f.shape for f in found])
        return found, crs
    except SideFileError:
        raise
    except OSError as error:
        raise SideFileError(f"{path} cannot be read: {error.strerror or error}") from error
    except Exception as error:  # GEOS and the parsers raise many exceptions
        raise SideFileError(
            f"{path.name} is not a readable {path.suffix[1:]} file:"
            f" {plain(str(error), 200) or type(error).__name__}"
        ) from error


def _words(properties: Any) -> dict[str, str]:
    """Properties as text by name in small letters."""
    if not isinstance(properties, dict):
        return {}
    return {
        plain(str(name), 60).lower(): plain(str(value), 200)
        for name, value in list(properties.items())[:MOST_FIELDS]
        if value is not None
    }


def read_geojson(path: Path) -> Found:
    """RFC 7946, or the older form with a `crs` member."""
    content = json.loads(read_bounded(path).decode("utf-8-sig"))
    named = content.get("crs") or {}
    crs = str(named.get("properties", {}).get("name", boundary.WGS84))
    records = content["features"] if content.get("type") == "FeatureCollection" else [content]
    found = []
    for record in records:
        geometry = record.get("geometry") if record.get("type") == "Feature" else record
        if geometry:
            shape = force_2d(from_geojson(geometry))
            found.append(Feature(shape=shape, properties=_words(record.get("properties"))))
    return found, crs


def read_kml(path: Path) -> Found:
    """All placemarks; a folder's name counts as the kind of those that name none."""
    return _placemarks(read_bounded(path)), boundary.WGS84


def read_kmz(path: Path) -> Found:
    """All placemarks of every KML file inside the archive."""
    return [f for text in boundary.kml_texts(path) for f in _placemarks(text)], boundary.WGS84


def _placemarks(text: bytes) -> list[Feature]:
    root = fromstring(text)
    kinds = {
        id(mark): (folder.findtext("{*}name") or "")
        for folder in root.iterfind(".//{*}Folder")
        for mark in folder.iterfind(".//{*}Placemark")
    }
    found = []
    for mark in root.iterfind(".//{*}Placemark"):
        words = {"name": mark.findtext("{*}name"), "folder": kinds.get(id(mark))}
        for data in mark.iterfind(".//{*}Data"):
            words[data.get("name", "")] = data.findtext("{*}value")
        for data in mark.iterfind(".//{*}SimpleData"):
            words[data.get("name", "")] = data.text
        found += [
            Feature(shape=shape, properties=_words(words)) for shape in boundary.kml_shapes(mark)
        ]
    return found


def read_geopackage(path: Path) -> Found:
    """The first feature table."""
    rows, crs = boundary.geopackage_rows(path, everything=True)
    return [
        Feature(shape=of_wkb(blob[boundary.gpkg_header(blob) :]), properties=_words(words))
        for blob, words in rows
    ], crs


def read_shapefile(path: Path) -> Found:
    """Polygons and lines with the `.prj` and `.dbf` beside them (ESRI white paper, 1998)."""
    shapes: list[list[BaseGeometry]] = []
    for record in boundary.shapefile_records(path):
        (kind,) = struct.unpack_from("<i", record)
        lines = kind in (3, 13, 23)
        shapes.append(_lines(record) if lines else boundary.shp_polygon(record))
    words = _table(path.with_suffix(".dbf"))
    crs = boundary.projection_beside(path)
    return [
        Feature(shape=shape, properties=words[k] if k < len(words) else {})
        for k, found in enumerate(shapes)
        for shape in found
    ], crs


def _lines(record: bytes) -> list[BaseGeometry]:
    starts, places = boundary.shp_parts(record)
    return [MultiLineString([places[a:b] for a, b in pairwise(starts) if b - a > 1])]


def _table(path: Path) -> list[dict[str, str]]:
    """Rows of a dBase III file; none where there is no such file."""
    if not path.exists():
        return []
    data = read_bounded(path)
    count, head, width = struct.unpack_from("<IHH", data, 4)
    columns, at = [], 1
    for start in range(32, min(head - 1, 32 + 32 * MOST_FIELDS), 32):
        name = data[start : start + 11].split(b"\0")[0].decode("latin-1")
        size = data[start + 16]
        columns.append((name, at, size))
        at += size
    rows = []
    for k in range(min(count, MOST_FEATURES)):
        row = data[head + k * width : head + (k + 1) * width]
        cells = {name: row[a : a + n].decode("utf-8", "replace").strip() for name, a, n in columns}
        rows.append(_words({name: cell for name, cell in cells.items() if cell}))
    return rows


READERS: dict[str, Callable[[Path], Found]] = {
    ".geojson": read_geojson,
    ".json": read_geojson,
    ".kml": read_kml,
    ".kmz": read_kmz,
    ".gpkg": read_geopackage,
    ".shp": read_shapefile,
}
