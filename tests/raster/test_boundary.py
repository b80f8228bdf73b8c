"""One outline in every format, and its pixels."""

import json
import sqlite3
import struct
import time
import zipfile

import numpy as np
import pyproj
import pytest
from shapely import Polygon, box, to_wkb
from shapely.geometry import mapping

from skyquilt.errors import SideFileError
from skyquilt.raster.boundary import inside, read_boundary

from .raster_cases import PLACE

UTM = Polygon(
    [(500_000, 4_500_000), (500_900, 4_500_000), (500_900, 4_500_700), (500_000, 4_500_700)],
    [[(500_100, 4_500_100), (500_200, 4_500_100), (500_200, 4_500_200), (500_100, 4_500_200)]],
)


def degrees(places):
    project = pyproj.Transformer.from_crs(32615, 4326, always_xy=True)
    return list(zip(*project.transform(*np.array(places).T[:2]), strict=True))


LONLAT = Polygon(degrees(UTM.exterior.coords), [degrees(ring.coords) for ring in UTM.interiors])
FEATURES = {
    "type": "FeatureCollection",
    "features": [{"type": "Feature", "geometry": mapping(LONLAT), "properties": {}}],
}
LEGACY = mapping(UTM) | {
    "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32615"}}
}


def kml():
    def ring(kind, places):
        text = " ".join(f"{x:.12f},{y:.12f},0" for x, y in places)
        return f"<{kind}><LinearRing><coordinates>{text}</coordinates></LinearRing></{kind}>"

    rings = ring("outerBoundaryIs", LONLAT.exterior.coords) + ring(
        "innerBoundaryIs", LONLAT.interiors[0].coords
    )
    return (
        "<kml"
        ' xmlns="http://www.opengis.net/kml/2.2">'
        f"<Document><Polygon>{rings}</Polygon></Document></kml>"
    )


def write_geopackage(path):
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE gpkg_geometry_columns (table_name, column_name, srs_id)")
        base.execute(
            "CREATE TABLE gpkg_spatial_ref_sys (srs_id, organization, organization_coordsys_id,"
            " definition)"
        )
        base.execute("INSERT INTO gpkg_geometry_columns VALUES ('my area', 'geom', 7)")
        base.execute("INSERT INTO gpkg_spatial_ref_sys VALUES (7, 'EPSG', 32615, '')")
        base.execute('CREATE TABLE "my area" (fid, geom)')
        head = b"GP\0\x03" + struct.pack("<i4d", 7, 0, 0, 0, 0)
        base.execute('INSERT INTO "my area" VALUES (1, ?)', (head + to_wkb(UTM),))
    base.close()


def write_shapefile(path):
    rings = [np.array(UTM.exterior.coords)[::-1], np.array(UTM.interiors[0].coords)[::-1]]
    body = (
        struct.pack("<i4dii2i", 5, 0, 0, 0, 0, 2, 10, 0, 5)
        + np.vstack(rings).astype("<f8").tobytes()
    )
    path.write_bytes(
        struct.pack(">i", 9994).ljust(100, b"\0") + struct.pack(">ii", 1, len(body) // 2) + body
    )
    path.with_suffix(".prj").write_text(pyproj.CRS(32615).to_wkt("WKT1_ESRI"))


@pytest.fixture
def files(tmp_path):
    (tmp_path / "a.geojson").write_text(json.dumps(FEATURES))
    (tmp_path / "b.json").write_text(json.dumps(LEGACY))
    (tmp_path / "c.kml").write_text(kml())
    with zipfile.ZipFile(tmp_path / "d.kmz", "w") as archive:
        archive.writestr("doc.kml", kml())
    (tmp_path / "e.wkt").write_text(UTM.wkt)
    (tmp_path / "f.wkt").write_text(f"SRID=4326;{LONLAT.wkt}")
    write_geopackage(tmp_path / "g.gpkg")
    write_shapefile(tmp_path / "h.shp")
    return tmp_path


@pytest.mark.parametrize(
    "name", ["a.geojson", "b.json", "c.kml", "d.kmz", "e.wkt", "f.wkt", "g.gpkg", "h.shp"]
)
def test_every_format_gives_the_same_outline(files, name):
    area = read_boundary(files / name, "EPSG:32615")
    assert area.symmetric_difference(UTM).area < 20  # of 620,000 m2: edges straight in degrees
    assert area.hausdorff_distance(UTM) < 0.02


def test_long_edges_bend_as_they_should(tmp_path):
    """20 km along a parallel leave the chord by some 6 m at latitude 50."""
    (tmp_path / "a.geojson").write_text(json.dumps(mapping(box(8.6, 50.0, 8.9, 50.1))))
    area = read_boundary(tmp_path / "a.geojson", "EPSG:32632")
    middle = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(8.75, 50.0)
    assert area.exterior.distance(Polygon([middle] * 4).centroid) < 0.01


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.dxf", "", "a boundary is one of .geojson"),
        ("a.geojson", "{", "not a readable geojson"),
        ("a.kml", "<kml><Polygon/></kml>", "not a readable kml"),
        ("a.kml", "<!DOCTYPE x [<!ENTITY a 'b'>]><kml>&a;</kml>", "not a readable kml"),
        (
            "a.geojson",
            '{"type": "Point", "coordinates": [1, 2]}',
            "at least one polygon, found Point",
        ),
        ("a.kml", "<kml/>", "at least one polygon, found nothing"),
        ("a.gpkg", "no database", "not a readable gpkg"),
        ("a.shp", "none", "not a readable shp"),
        ("a.geojson", json.dumps(mapping(UTM)), "do not fit its CRS"),
        ("a.wkt", f"SRID=999999;{UTM.wkt}", "is not known"),
    ],
)
def test_bad_files_get_a_sentence(tmp_path, name, text, says):
    (tmp_path / name).write_text(text)
    with pytest.raises(SideFileError, match=says):
        read_boundary(tmp_path / name, "EPSG:32615")


@pytest.mark.parametrize("suffix", ["geojson", "kml", "kmz", "wkt", "gpkg", "shp"])
def test_missing_file(tmp_path, suffix):
    with pytest.raises(SideFileError, match="cannot be read: No such file"):
        read_boundary(tmp_path / f"a.{suffix}", "EPSG:32615")


def test_ungeoreferenced_mosaic(files):
    assert read_boundary(files / "e.wkt", None).equals(UTM)
    with pytest.raises(SideFileError, match="not georeferenced"):
        read_boundary(files / "a.geojson", None)


def test_pixels_whose_centre_is_inside():
    area = box(500_000.5, 4_499_990.2, 500_003.0, 4_499_999.0)
    whole = inside(area, PLACE, row0=0, col0=0, height=600, width=300)
    assert whole.sum() == 125 * 440
    np.testing.assert_array_equal(
        whole[40:60, 20:70], inside(area, PLACE, row0=40, col0=20, height=20, width=50)
    )
    assert inside(area, PLACE, row0=100, col0=50, height=9, width=9).all()
    assert not inside(area, PLACE, row0=900, col0=50, height=9, width=9).any()


def test_outlines_that_cross_a_thousand_times_are_refused_at_once(tmp_path):
    """GEOS takes 8 s for the areas within 4,500 crossings, and 12 GB for those of a few more; what
    people draw badly is still mended.
    """
    k = np.arange(400)
    star = np.stack([np.sin(2.7 * k), np.cos(2.7 * k)], axis=1)
    comb = np.stack([k / 400, np.where(k % 4 // 2, 1.0, 0.01)], axis=1)
    comb = np.concatenate([comb, [[1, 0], [0, 0]]])
    cases = {
        "one": ([star], "crosses itself more than 500 times"),
        "two": ([comb + [0, j * 0.001] for j in range(30)] + [comb[:, ::-1]] * 2, "cross more"),
    }
    for name, (rings, words) in cases.items():
        rings = [np.concatenate([r, r[:1]]) for r in rings]
        path = tmp_path / f"{name}.geojson"
        shape = {"type": "MultiPolygon", "coordinates": [[r.tolist()] for r in rings]}
        path.write_text(json.dumps(shape))
        started = time.process_time()
        with pytest.raises(SideFileError, match=words):
            read_boundary(path, "EPSG:32631")
        assert time.process_time() - started < 1
    bow = tmp_path / "bow.geojson"
    ring = [[0, 0], [1, 1], [1, 0], [0, 1], [0, 0]]
    bow.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    assert len(read_boundary(bow, "EPSG:32631").geoms) == 2
