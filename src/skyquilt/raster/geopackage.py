"""Lines and polygons as a GeoPackage (OGC 12-128r18), readable by every GIS."""

import sqlite3
import struct
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shapely import to_wkb
from shapely.geometry import LineString, Polygon

from skyquilt.errors import OutputError
from skyquilt.outside import put_in_place, remove_file

APPLICATION_ID, USER_VERSION = 0x47504B47, 10300
"""`GPKG`, version 1.3."""
UNDEFINED = -1
"""Reference system of the format for plane coordinates that are not on Earth."""
TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY,
    organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL,
    definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT PRIMARY KEY, data_type TEXT NOT NULL,
    identifier TEXT UNIQUE, description TEXT DEFAULT '',
    last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
    min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER);
CREATE TABLE gpkg_geometry_columns (table_name TEXT PRIMARY KEY, column_name TEXT NOT NULL,
    geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL,
    m TINYINT NOT NULL);
INSERT INTO gpkg_spatial_ref_sys VALUES
    ('Undefined Cartesian', -1, 'NONE', -1, 'undefined', NULL),
    ('Undefined geographic', 0, 'NONE', 0, 'undefined', NULL),
    ('WGS 84', 4326, 'EPSG', 4326, 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,'
     || '298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]', NULL);
"""


def write_lines(
    path: Path, table: str, lines: Iterable[tuple[NDArray[np.float64], float]], *, crs: str | None
) -> int:
    """Writes lines (n, 2) in `crs`, each with a height in m, as a table; returns their number.

    Raises:
        OutputError: the file cannot be written.
    """
    rows = [(LineString(np.asarray(line, np.float64)), float(height)) for line, height in lines]
    return _write(path, _Table(name=table, kind="LINESTRING", column="height REAL"), rows, crs)


def write_polygons(
    path: Path, table: str, rings: Iterable[tuple[NDArray[np.float64], str]], *, crs: str | None
) -> int:
    """Writes polygons, each an outer ring (n, 2) in `crs` with a name, as a table; returns their
    number.

    Raises:
        OutputError: the file cannot be written.
    """
    rows = [(Polygon(np.asarray(ring, np.float64)), name) for ring, name in rings]
    return _write(path, _Table(name=table, kind="POLYGON", column="filename TEXT"), rows, crs)


@dataclass(frozen=True, kw_only=True)
class _Table:
    """A table of features."""

    name: str
    kind: str
    column: str


def _write(path: Path, table: _Table, rows: list[tuple[Any, Any]], crs: str | None) -> int:
    partial = path.with_name(path.name + ".partial")
    remove_file(partial)
    try:
        with closing(sqlite3.connect(partial)) as base, base:
            _fill(base, table, rows, crs)
        put_in_place(partial, path)
    except (OSError, sqlite3.Error) as error:
        partial.unlink(missing_ok=True)
        raise OutputError(f"{path} cannot be written: {error}") from error
    return len(rows)


def _fill(
    base: sqlite3.Connection, table: _Table, rows: list[tuple[Any, Any]], crs: str | None
) -> None:
    base.executescript(TABLES)
    base.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    base.execute(f"PRAGMA user_version = {USER_VERSION}")
    srs = _reference(base, crs)
    boxes = np.array([g.bounds for g, _ in rows]) if rows else np.zeros((1, 4))
    (west, south), (east, north) = boxes[:, :2].min(0).tolist(), boxes[:, 2:].max(0).tolist()
    base.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y,"
        " srs_id) VALUES (?, 'features', ?, ?, ?, ?, ?, ?)",
        (table.name, table.name, west, south, east, north, srs),
    )
    base.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)",
        (table.name, table.kind, srs),
    )
    base.execute(f"CREATE TABLE {table.name} (fid INTEGER PRIMARY KEY, geom BLOB, {table.column})")
    header = b"GP\0\1" + struct.pack("<i", srs)
    base.executemany(
        f"INSERT INTO {table.name} (geom, {table.column.split()[0]}) VALUES (?, ?)",
        [(header + to_wkb(shape, byte_order=1), value) for shape, value in rows],
    )


def _reference(base: sqlite3.Connection, crs: str | None) -> int:
    """Number of a reference system in the file."""
    if crs is None:
        return UNDEFINED
    from pyproj import CRS

    known = CRS.from_user_input(crs)
    authority, code = known.to_authority() or ("NONE", "100000")
    number = int(code) if code.isdigit() else 100000
    base.execute(
        "INSERT OR IGNORE INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)",
        (known.name, number, authority, number, known.to_wkt("WKT1_GDAL")),
    )
    return number
