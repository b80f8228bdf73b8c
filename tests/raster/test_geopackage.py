"""GeoPackages by the tables and bytes that OGC 12-128r18 asks for."""

import sqlite3
import struct
from contextlib import closing

import numpy as np
import pytest
from pyproj import CRS
from shapely import from_wkb

from skyquilt.errors import OutputError
from skyquilt.raster.geopackage import write_lines, write_polygons

LINE = np.array([[500_000.0, 5_000_000.0], [500_010.0, 5_000_005.0], [500_020.0, 5_000_001.0]])
RING = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])


def read(path, table):
    """Number in the reference system, shapes and values of a table, and its two descriptions."""
    with closing(sqlite3.connect(path)) as base:
        assert base.execute("PRAGMA application_id").fetchone()[0] == int.from_bytes(b"GPKG")
        assert base.execute("PRAGMA user_version").fetchone()[0] >= 10200
        assert base.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
        rows = base.execute(f"SELECT * FROM {table} ORDER BY fid").fetchall()
        about = base.execute(
            "SELECT data_type, min_x, min_y, max_x, max_y, srs_id FROM gpkg_contents"
        ).fetchone()
        column = base.execute(
            "SELECT table_name, column_name, geometry_type_name, srs_id FROM gpkg_geometry_columns"
        ).fetchone()
        systems = dict(base.execute("SELECT srs_id, definition FROM gpkg_spatial_ref_sys"))
    shapes = []
    for _, blob, _ in rows:
        magic, version, flags, srs = struct.unpack("<2sBBi", blob[:8])
        assert (magic, version, flags, srs) == (b"GP", 0, 1, about[5])  # no envelope, little-endian
        shapes.append(from_wkb(blob[8:]))
    return shapes, [value for *_, value in rows], about, column, systems


def test_lines_with_heights(tmp_path):
    path = tmp_path / "contours.gpkg"
    number = write_lines(path, "contours", [(LINE, 12.5), (LINE + 100, 13.0)], crs="EPSG:32632")
    shapes, heights, about, column, systems = read(path, "contours")
    assert number == 2 and heights == [12.5, 13.0]
    assert np.array_equal(np.array(shapes[0].coords), LINE)
    both = np.concatenate([LINE, LINE + 100])
    assert about == ("features", *both.min(0), *both.max(0), 32632)
    assert column == ("contours", "geom", "LINESTRING", 32632)
    assert CRS.from_wkt(systems[32632]) == CRS.from_epsg(32632)
    assert {-1, 0, 4326} <= set(systems)  # the three that the format asks for


def test_polygons_with_names_in_no_reference_system(tmp_path):
    path = tmp_path / "footprints.gpkg"
    assert write_polygons(path, "footprints", [(RING, "a'; DROP TABLE x; --.jpg")], crs=None) == 1
    shapes, names, about, column, _ = read(path, "footprints")
    assert names == ["a'; DROP TABLE x; --.jpg"] and shapes[0].area == 12
    assert column[2:] == ("POLYGON", -1) and about[5] == -1


def test_nothing_to_write_is_an_empty_table(tmp_path):
    path = tmp_path / "none.gpkg"
    assert write_lines(path, "contours", [], crs="EPSG:4326") == 0
    shapes, _, about, _, _ = read(path, "contours")
    assert shapes == [] and about[5] == 4326


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "contours.gpkg"
    write_lines(path, "contours", [(LINE, 1.0)], crs="EPSG:32632")
    write_lines(path, "contours", [(LINE, 2.0)], crs="EPSG:32632")
    assert read(path, "contours")[1] == [2.0]
    assert [p.name for p in tmp_path.iterdir()] == ["contours.gpkg"]
    with pytest.raises(OutputError, match="cannot be written"):
        write_lines(tmp_path / "nowhere" / "contours.gpkg", "contours", [(LINE, 1.0)], crs=None)
