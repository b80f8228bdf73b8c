"""The area to be mapped: polygons from GeoJSON, KML, GeoPackage or Shapefile in the output CRS, and
the map's pixels inside them.
"""

import json
import sqlite3
import struct
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
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
    STRtree,
    force_2d,
    get_coordinates,
    get_num_coordinates,
    get_rings,
    linestrings,
    make_valid,
    segmentize,
    transform,
    union_all,
)
from shapely.geometry import shape as from_geojson
from shapely.geometry.base import BaseGeometry
from shapely.prepared import prep

from skyquilt.errors import SideFileError
from skyquilt.outside import MOST_TEXT_BYTES, open_regular, plain, read_bounded, unzipped
from skyquilt.raster.well_known import of_wkb, of_wkt

MOST_VERTICES = 200_000
"""Largest number of vertices of a boundary."""
MOST_RINGS = 2000
"""Largest number of rings of one record of a Shapefile."""
MOST_COORDINATE = 1e8
"""Largest coordinate, in degrees or m."""
MOST_CROSSINGS, MOST_OWN_CROSSINGS = 50_000, 500
"""Crossings of edges of all shapes; of one that crosses itself: GEOS takes 0.5 s for 50,000 in a
union, and for the areas within one outline a time that grows with the square, 8 s for 4,500.
"""
MOST_NEAR = 20_000_000
"""Pairs of edges whose boxes overlap, that are looked at for crossings."""
MOST_QUERY_S, MOST_PRJ = 3.0, 100_000
"""CPU time in s that SQLite may take with a GeoPackage; bytes of a .prj file."""
Places = NDArray[np.float64]
"""(n, 2)."""
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
        check_size(shapes)
        areas = [area for part in _parts(shapes) for area in _areas(make_valid(part))]
        if not areas:
            kinds = sorted({shape.geom_type for shape in shapes}) or ["nothing"]
            raise SideFileError(
                f"{path.name}: a boundary needs at least one polygon, found {', '.join(kinds)}"
            )
        outline = _polygonal(_projected(union_all(areas), path, source, crs))
        if outline.is_empty or not np.isfinite(outline.bounds).all():
            raise SideFileError(f"{path.name}: nothing is left of its outline in {crs}")
        return outline
    except SideFileError:
        raise
    except OSError as error:
        raise SideFileError(f"{path} cannot be read: {error.strerror or error}") from error
    except Exception as error:  # GEOS, PROJ and the parsers raise many exceptions
        raise SideFileError(
            f"{path.name} is not a readable {path.suffix[1:]} file:"
            f" {plain(str(error), 200) or type(error).__name__}"
        ) from error


def check_size(shapes: Sequence[BaseGeometry]) -> None:
    """Refuses outlines that would take minutes, and numbers that are no places."""
    count = sum(int(get_num_coordinates(shape)) for shape in shapes)
    if count > MOST_VERTICES:
        raise ValueError(f"it has {count} vertices, and {MOST_VERTICES} are the most")
    for shape in shapes:
        places = get_coordinates(shape)
        if not np.isfinite(places).all() or (np.abs(places) > MOST_COORDINATE).any():
            raise ValueError(f"a coordinate is no number or beyond {MOST_COORDINATE:g}")
    parts = _parts(shapes)
    tangled = [p for p in parts if not (p.is_valid if isinstance(p, Polygon) else p.is_simple)]
    if any(_crossings([part], MOST_OWN_CROSSINGS) > MOST_OWN_CROSSINGS for part in tangled):
        raise ValueError(f"an outline crosses itself more than {MOST_OWN_CROSSINGS} times")
    if len(parts) > 1 and _crossings(parts, MOST_CROSSINGS) > MOST_CROSSINGS:
        raise ValueError(f"its outlines cross more than {MOST_CROSSINGS} times")


def _crossings(parts: Sequence[BaseGeometry], most: int) -> int:
    """How often edges of polygons and lines cross within both; counted up to where there are more
    than `most`, or where too many edges would have to be compared.
    """
    lines = [r for p in parts for r in (get_rings(p) if isinstance(p, Polygon) else (p,))]
    places, owner = get_coordinates(lines, return_index=True)
    edges = np.stack([places[:-1], places[1:]], axis=1)[owner[1:] == owner[:-1]]
    if not len(edges):
        return 0
    boxes = linestrings(edges)
    tree, found, near = STRtree(boxes), 0, 0
    step = max(1, MOST_NEAR // 10 // len(edges))
    for first in range(0, len(edges), step):
        i, j = tree.query(boxes[first : first + step])
        i, j = i[i + first < j] + first, j[i + first < j]
        near += len(i)
        (a, b), (c, d) = np.swapaxes(edges[i], 0, 1), np.swapaxes(edges[j], 0, 1)
        apart = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
        found += int(apart.sum())
        if found > most or near > MOST_NEAR:
            return most + 1
    return found


def _parts(shapes: Iterable[BaseGeometry]) -> list[BaseGeometry]:
    """The polygons, lines and points of which shapes consist."""
    found = []
    for shape in shapes:
        found += _parts(shape.geoms) if hasattr(shape, "geoms") else [shape]
    return found


def _side(a: Places, b: Places, c: Places) -> NDArray[np.float64]:
    """On which side of the lines from a to b the points c lie (n,)."""
    (x, y), (u, v) = (b - a).T, (c - a).T
    return np.asarray(np.sign(x * v - y * u))


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
            f"{path.name}: the CRS '{plain(source, 60)}' is not known: {plain(str(error), 200)}"
        ) from error
    west, south, east, north = shape.bounds
    if (
        len(get_coordinates(shape)) * 2 + shape.length / max(east - west, north - south) * SEGMENTS
        > MOST_VERTICES
    ):
        raise SideFileError(f"{path.name}: its outline is too long for its extent")
    fine = segmentize(shape, max(east - west, north - south) / SEGMENTS)
    placed = transform(fine, lambda xy: np.column_stack(transformer.transform(xy[:, 0], xy[:, 1])))
    if not np.isfinite(placed.bounds).all():
        raise SideFileError(
            f"{path.name}: its coordinates {shape.bounds} do not fit its CRS ({plain(source, 60)})"
        )
    return placed


Shapes = tuple[list[BaseGeometry], str | None]
"""Two-dimensional shapes and their CRS as pyproj reads it; None = the output's CRS."""

WGS84 = "EPSG:4326"
_TABLES = ("gpkg_geometry_columns", "gpkg_spatial_ref_sys")


def read_geojson(path: Path) -> Shapes:
    """RFC 7946, or the older form with a `crs` member that GIS programs still write."""
    content = json.loads(_text(path))
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
    return kml_shapes(fromstring(read_bounded(path))), WGS84


def read_kmz(path: Path) -> Shapes:
    """All polygons of every KML file inside the archive."""
    return [shape for text in kml_texts(path) for shape in kml_shapes(fromstring(text))], WGS84


def kml_texts(path: Path) -> Iterator[bytes]:
    """The KML files inside an archive."""
    left = MOST_TEXT_BYTES
    with open_regular(path) as file, zipfile.ZipFile(file) as archive:
        for name in [n for n in archive.namelist() if n.lower().endswith(".kml")]:
            text = unzipped(archive, name, left)
            left -= len(text)
            yield text


def _text(path: Path) -> str:
    return read_bounded(path).decode("utf-8-sig")


def kml_shapes(root: Any) -> list[BaseGeometry]:
    """Polygons and lines below an element; closed lines are polygons."""
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
    text = _text(path).strip()
    srid, _, rest = text.partition(";") if text.upper().startswith("SRID=") else ("", "", text)
    return [of_wkt(rest)], f"EPSG:{int(srid[5:])}" if srid else None


def read_geopackage(path: Path) -> Shapes:
    """The first feature table of a GeoPackage (OGC 12-128r18)."""
    rows, crs = geopackage_rows(path)
    return [of_wkb(blob[gpkg_header(blob) :]) for blob, _ in rows], crs


def geopackage_rows(
    path: Path, *, everything: bool = False
) -> tuple[list[tuple[bytes, dict[str, Any]]], str]:
    """Shapes of the first feature table, as stored, and its CRS; with `everything` also the other
    columns by name.
    """
    with open_regular(path):
        pass  # it exists, and is a file
    with closing(sqlite3.connect(path.absolute().as_uri() + "?mode=ro", uri=True)) as base:
        end = time.thread_time() + MOST_QUERY_S
        # a column may be any formula
        base.set_progress_handler(lambda: time.thread_time() > end, 1000)
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_TEXT_BYTES)
        found = "SELECT table_name, column_name, srs_id FROM gpkg_geometry_columns LIMIT 1"
        for name in _TABLES:
            _is_table(base, name)
        table, column, srs = base.execute(found).fetchone()
        _is_table(base, table)
        columns = "organization, organization_coordsys_id, definition"
        naming = f"SELECT {columns} FROM gpkg_spatial_ref_sys WHERE srs_id = ?"
        authority, code, definition = base.execute(naming, (srs,)).fetchone()
        table, column = (name.replace('"', '""') for name in (table, column))
        wanted = f'"{column}", *' if everything else f'"{column}"'
        rows = base.execute(f'SELECT {wanted} FROM "{table}" LIMIT {MOST_VERTICES}')
        names = [about[0] for about in rows.description[1:]]
        kept, size = [], 0
        for blob, *others in rows:
            size += sum(len(v) for v in (blob, *others) if isinstance(v, str | bytes))
            if size > MOST_TEXT_BYTES:
                raise ValueError(f"its rows have more than {MOST_TEXT_BYTES // 10**6} MB")
            if isinstance(blob, bytes):
                words = {
                    n: v for n, v in zip(names, others, strict=True) if not isinstance(v, bytes)
                }
                kept.append((blob, words))
    return kept, f"{authority}:{code}" if authority.upper() == "EPSG" else definition


def _is_table(base: sqlite3.Connection, name: str) -> None:
    """Refuses views, which may be any query: without end, or sorting more than the disk holds."""
    kinds = "SELECT type, sql FROM sqlite_master WHERE lower(name) = lower(?)"
    kind, made = base.execute(kinds, (name,)).fetchone() or ("missing", "")
    if kind != "table" or "virtual" in made[:30].lower():
        raise ValueError(f"its table '{plain(str(name), 60)}' is a {kind}; export it as a layer")


def gpkg_header(blob: bytes) -> int:
    """Number of bytes before the WKB: 8 plus an envelope of 0, 32, 48 or 64."""
    return 8 + (0, 32, 48, 48, 64)[blob[3] >> 1 & 7]


def read_shapefile(path: Path) -> Shapes:
    """Polygons (types 5, 15, 25) of a Shapefile with its `.prj` beside it (ESRI white paper,
    1998).
    """
    shapes = [shape for record in shapefile_records(path) for shape in shp_polygon(record)]
    return shapes, projection_beside(path)


def shapefile_records(path: Path) -> Iterator[bytes]:
    """The contents of the records of a Shapefile."""
    data, at = read_bounded(path), 100
    if data[:4] != b"\0\0\x27\x0a":
        raise ValueError("the file code is not 9994")
    while at < len(data):
        size = 2 * int.from_bytes(data[at + 4 : at + 8], "big")
        yield data[at + 8 : at + 8 + size]
        at += 8 + size


def projection_beside(path: Path) -> str:
    """The CRS in the `.prj` beside a Shapefile; WGS 84 where there is none."""
    projection = path.with_suffix(".prj")
    if not projection.exists():
        return WGS84
    return read_bounded(projection, MOST_PRJ).decode("utf-8", "replace")


def shp_parts(record: bytes) -> tuple[list[int], NDArray[np.float64]]:
    """Where the parts of a polygon or line start, and where the last one ends, and all vertices
    (n, 2).
    """
    parts, count = struct.unpack_from("<ii", record, 36)
    if not (0 < parts <= MOST_RINGS and 0 < count <= MOST_VERTICES):
        raise ValueError(f"a record has {parts} rings with {count} vertices")
    starts = [*struct.unpack_from(f"<{parts}i", record, 44), count]
    return starts, np.frombuffer(record, "<f8", 2 * count, 44 + 4 * parts).reshape(count, 2)


def shp_polygon(record: bytes) -> list[BaseGeometry]:
    """The polygon of a record; nothing where it holds another kind of shape."""
    (kind,) = struct.unpack_from("<i", record)
    if kind not in (5, 15, 25):
        return []
    starts, places = shp_parts(record)
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
