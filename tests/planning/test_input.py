"""Areas from every kind of file, and one sentence for each thing that cannot be meant."""

import json
import sqlite3
import struct
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from shapely import Polygon, to_wkb
from typer.testing import CliRunner

from skyquilt.cli.app import app
from skyquilt.errors import RefusedError, SideFileError, SkyquiltError, UsageError
from skyquilt.planning.fleet import read_fleet
from skyquilt.planning.missing import missing_site
from skyquilt.planning.points import height_of
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.site import read_site
from skyquilt.planning.terrain import read_terrain
from skyquilt.planning.view import find_view, narrowest

SQUARE = [[13.1, 52.1], [13.102, 52.1], [13.102, 52.101], [13.1, 52.101], [13.1, 52.1]]
BARN = [[13.1005, 52.1002], [13.101, 52.1002], [13.101, 52.1004], [13.1005, 52.1002]]
TWIST = [[13.1, 52.1], [13.102, 52.101], [13.102, 52.1], [13.1, 52.101], [13.1, 52.1]]


def feature(kind, coordinates, **words):
    return {
        "type": "Feature",
        "properties": words,
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def geojson(path, *features):
    path.write_text(json.dumps({"type": "FeatureCollection", "features": list(features)}))
    return path


def area(folder):
    return geojson(
        folder / "area.geojson",
        feature("Polygon", [SQUARE]),
        feature("Polygon", [BARN], type="no-fly", ceiling=30, name="barn"),
    )


def test_geojson_kml_geopackage_and_shapefile_say_the_same(tmp_path):
    first = read_site(area(tmp_path))
    assert first.crs == "EPSG:32633" and first.keep_out[0].ceiling_m == 30

    def ring(r):
        return " ".join(f"{x},{y}" for x, y in r)

    placemark = (
        "<Placemark>{}<Polygon><outerBoundaryIs><LinearRing><coordinates>{}</coordinates>"
        "</LinearRing></outerBoundaryIs></Polygon></Placemark>"
    )
    data = '<ExtendedData><Data name="ceiling"><value>30</value></Data></ExtendedData>'
    (tmp_path / "a.kml").write_text(
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
        + placemark.format("<name>field</name>", ring(SQUARE))
        + "<Folder><name>No-fly</name>"
        + placemark.format("<name>barn</name>" + data, ring(BARN))
        + "</Folder></Document></kml>"
    )
    with closing(sqlite3.connect(tmp_path / "a.gpkg")) as base:
        base.executescript(
            "create table gpkg_geometry_columns(table_name, column_name, srs_id);"
            "create table gpkg_spatial_ref_sys(srs_id, organization, organization_coordsys_id,"
            " definition);"
            "insert into gpkg_geometry_columns values ('a', 'geom', 4326);"
            "insert into gpkg_spatial_ref_sys values (4326, 'EPSG', 4326, '');"
            "create table a(geom blob, keep_out int, ceiling_m real);"
        )
        for r, closed, ceiling in ((SQUARE, 0, None), (BARN, 1, 30.0)):
            blob = b"GP\0\x01" + struct.pack("<i", 4326) + to_wkb(Polygon(r))
            base.execute("insert into a values (?, ?, ?)", (blob, closed, ceiling))
        base.commit()
    shapefile(tmp_path / "a.shp", [SQUARE[::-1], BARN], ["field   0 ", "no-fly  30"])
    for name in ("a.kml", "a.gpkg", "a.shp"):
        site = read_site(tmp_path / name)
        assert site.observe.area == pytest.approx(first.observe.area, rel=1e-6), name
        assert [k.ceiling_m for k in site.keep_out] == [30], name
        assert site.keep_out[0].shape.area == pytest.approx(first.keep_out[0].shape.area, rel=1e-6)


def shapefile(path, rings, rows):
    """Polygons with a table of a text `type` (8) and a number `ceiling` (2)."""
    records = b""
    for k, ring in enumerate(rings, 1):
        flat = np.array(ring).ravel().astype("<f8").tobytes()
        body = struct.pack("<i4d", 5, 13, 52, 14, 53)
        body += struct.pack("<iii", 1, len(ring), 0) + flat
        records += struct.pack(">ii", k, len(body) // 2) + body
    head = struct.pack(">i", 9994) + bytes(20) + struct.pack(">i", (100 + len(records)) // 2)
    head = (head + struct.pack("<ii4d", 1000, 5, 13, 52, 14, 53)).ljust(100, b"\0")
    path.write_bytes(head + records)
    fields = b"".join(
        name.ljust(11, b"\0") + kind + bytes(4) + bytes([size]) + bytes(15)
        for name, kind, size in ((b"type", b"C", 8), (b"ceiling", b"N", 2))
    )
    data = struct.pack("<4BIHH", 3, 20, 1, 1, len(rows), 32 + 64 + 1, 11) + bytes(20)
    data += fields + b"\r" + b"".join(b" " + r.encode() for r in rows)
    path.with_suffix(".dbf").write_bytes(data)


def test_lines_are_corridors_of_a_width(tmp_path):
    line = geojson(tmp_path / "l.geojson", feature("LineString", [[13.1, 52.1], [13.11, 52.1]]))
    with pytest.raises(UsageError, match="--width"):
        read_site(line)
    site = read_site(line, width_m=20)
    assert site.observe.area == pytest.approx(20 * 685.5, rel=0.01)


def dem(path, *, crs="EPSG:32633", west=369_000.0, hole=False, at=5_774_100.0):
    z = np.full((200, 400), 50.0, np.float32)
    if hole:
        z[20:60, 100:300] = np.nan
    with rasterio.open(
        path, "w", driver="GTiff", width=400, height=200, count=1, dtype="float32", crs=crs,
        transform=from_origin(west, at, 4, 4),
    ) as raster:  # fmt: skip
        raster.write(z, 1)
    return path


def test_one_sentence_for_each_area_that_cannot_be_meant(tmp_path):
    def refused(words, *features, **more):
        path = geojson(tmp_path / "bad.geojson", *features)
        with pytest.raises(SkyquiltError, match=words) as found:
            read_site(path, **more)
        assert "\n" not in str(found.value)

    refused("crosses or touches itself", feature("Polygon", [TWIST]))
    refused("is a point", feature("Point", [13, 52]))
    refused("no place to fly", feature("Polygon", [[[0, 89], [1, 89], [1, 88.9], [0, 89]]]))
    refused("km long", feature("Polygon", [[[10, 52], [12, 52], [12, 53], [10, 52]]]))
    refused("holds no polygon or line", feature("Polygon", [BARN], keep_out=True))
    refused("holds no shape")
    refused("ceiling is 'low'", feature("Polygon", [BARN], keep_out="yes", ceiling="low"))
    (tmp_path / "a.geojson").write_text("{")
    with pytest.raises(SideFileError, match="readable"):
        read_site(tmp_path / "a.geojson")
    with pytest.raises(SideFileError, match="areas are one of"):
        read_site(tmp_path / "a.doc")


def test_one_sentence_for_each_terrain_that_cannot_be_used(tmp_path):
    site = read_site(area(tmp_path))
    fine = read_terrain(dem(tmp_path / "d.tif"), site.crs, site.observe, 100)
    x, y = site.observe.centroid.coords[0]
    assert float(fine.at(x, y)) == 50.0
    for words, path in (
        ("does not say its coordinate system", dem(tmp_path / "n.tif", crs=None)),
        ("lies elsewhere on Earth", dem(tmp_path / "e.tif", crs="EPSG:32755")),
        ("fill its holes", dem(tmp_path / "h.tif", hole=True)),
    ):
        with pytest.raises(SideFileError, match=words):
            read_terrain(path, site.crs, site.observe, 100)
    (tmp_path / "text.tif").write_text("no raster")
    with pytest.raises(SideFileError, match="cannot be read as a raster"):
        read_terrain(tmp_path / "text.tif", site.crs, site.observe, 100)
    with rasterio.open(tmp_path / "d.tif") as raster:  # a file that names another one
        west, north, cell = raster.transform.c, raster.transform.f, raster.transform.a
        size = f'rasterXSize="{raster.width}" rasterYSize="{raster.height}"'
    (tmp_path / "virtual.tif").write_text(
        f"<VRTDataset {size}><SRS>{site.crs}</SRS>"
        f"<GeoTransform>{west},{cell},0,{north},0,{-cell}</GeoTransform>"
        '<VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename>'
        f"{tmp_path / 'd.tif'}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    with rasterio.open(tmp_path / "virtual.tif") as raster:
        assert float(raster.read(1).max()) == 50.0
    with pytest.raises(SideFileError, match="cannot be read as a raster"):
        read_terrain(tmp_path / "virtual.tif", site.crs, site.observe, 100)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "either --gsd"),
        ({"gsd_cm": 2, "height_m": 50}, "either --gsd"),
        ({"gsd_cm": 0}, "--gsd must be"),
        ({"height_m": float("nan")}, "--height must be"),
        ({"height_m": 50, "overlap": 100}, "--overlap must be"),
        ({"height_m": 50, "views": 0}, "--views must be"),
        ({"height_m": 50, "deadline_s": 0.6}, "--deadline must be 0.02 to 20000 minutes, not 0.01"),
    ],
)
def test_options_that_cannot_be_meant(given, words):
    with pytest.raises(UsageError, match=words):
        PlanSettings(**given).checked()


def test_cameras_by_model_calibration_and_not_at_all(tmp_path):
    view = find_view("fc6310")
    assert (view.along, view.across) == pytest.approx((1.0, 1.5))
    assert height_of(PlanSettings(gsd_cm=2.0), view) == pytest.approx(72.96)
    with pytest.raises(UsageError, match="means flying"):
        height_of(PlanSettings(gsd_cm=0.02), view)
    for wrong in ("FC9999", "", "nothing.jpg"):
        with pytest.raises(UsageError, match="no camera"):
            find_view(wrong)
    record = {"projection_type": "brown", "width": 400, "height": 300, "focal_x": 0.8,
              "focal_y": 0.8, "c_x": 0.01, "c_y": 0.0, "k1": -0.1}  # fmt: skip
    (tmp_path / "cameras.json").write_text(json.dumps({"a": record}))
    own = find_view(str(tmp_path / "cameras.json"))
    assert own.left > own.right and own.across > 400 / 320  # its k1 widens the view
    both = narrowest([view, own])
    assert both.up == min(view.up, own.up) and both.focal == own.focal


FLEET = """
[[drone]]
name = "one"
start = {latitude = 52.1, longitude = 13.1}
landing = {latitude = 52.1005, longitude = 13.1}
endurance_min = 20
speed = 6
formats = ["dji"]
[[drone]]
start = {latitude = 52.1, longitude = 13.101}
camera = "FC330"
"""


def test_fleets(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_text(FLEET)
    one, two = read_fleet(path, "EPSG:32633", find_view("FC6310"))
    assert one.endurance_s == 1200 and one.formats == ("dji",) and one.landing != one.start
    assert two.view.name == "FC330" and two.name == "drone 2"
    for change, words in (
        (("speed = 6", "speed = 0"), "speed of one must be"),
        (("speed = 6", "spede = 6"), "'spede'"),
        (("start = {latitude = 52.1, longitude = 13.1}", ""), "no start"),
        (("latitude = 52.1,", "latitude = 95,"), "expected"),
        (('["dji"]', '["pix4d"]'), "formats of one"),
        (("[[drone]]", "[drone"), "is not TOML"),
    ):
        path.write_text(FLEET.replace(*change))
        with pytest.raises(SideFileError, match=words):
            read_fleet(path, "EPSG:32633", find_view("FC6310"))
    path.write_text(FLEET)
    with pytest.raises(UsageError, match="has no camera"):
        read_fleet(path, "EPSG:32633", None)


@pytest.mark.slow
def test_fleets_of_several_cameras_are_told_what_that_costs(tmp_path):
    fleet, out = tmp_path / "fleet.toml", tmp_path / "out"
    start = "start = {latitude = 52.1, longitude = 13.1}"
    rows = [f'[[drone]]\ncamera = "{c}"\n{start}\n' for c in ("FC6310", "FC330")]
    words = ["plan", str(area(tmp_path)), "-o", str(out), "--fleet", str(fleet), "--height", "100",
             "--overlap", "60", "--sidelap", "50", "--seconds", "1", "--quiet",
             "--overwrite", "--separation", "0"]  # fmt: skip
    found = []
    for text in ("".join(rows), rows[0] * 2):
        fleet.write_text(text)
        CliRunner().invoke(app, words, catch_exceptions=False)
        found.append(json.loads((out / "plan.json").read_text())["warnings"])
    views = [find_view(c) for c in ("FC6310", "FC330")]
    common = narrowest(views)
    shares = {v.name: 1 - common.along * common.across / (v.along * v.across) for v in views}
    name, share = max(shares.items(), key=lambda pair: pair[1])
    assert share > 0.1
    assert any(f"{name} alone would need {100 * share:.0f} % fewer photos" in w for w in found[0])
    assert not any("all cameras" in w for w in found[1])


def test_what_a_run_misses_is_its_hole(tmp_path):
    counts = np.full((100, 120), 5, np.uint8)
    counts[40:60, 50:80] = 1
    with rasterio.open(
        tmp_path / "views.tif", "w", driver="GTiff", width=120, height=100, count=1,
        dtype="uint8", crs="EPSG:32633", transform=from_origin(370_000, 5_773_400, 2, 2),
    ) as raster:  # fmt: skip
        raster.write(counts, 1)
    site = missing_site(tmp_path, 3)
    assert site.observe.contains(Polygon([(370_100, 5_773_281), (370_160, 5_773_281),
                                          (370_160, 5_773_319), (370_100, 5_773_319)]))  # fmt: skip
    assert 40 * 60 <= site.observe.area < 1.3 * 40 * 60
    with pytest.raises(RefusedError, match="nothing is missing"):
        missing_site(tmp_path, 1)
    with pytest.raises(SideFileError, match="no finished run"):
        missing_site(tmp_path / "..", 1)


@pytest.mark.slow
def test_the_command_plans_and_checks(tmp_path):
    out = tmp_path / "out"
    words = ["plan", str(area(tmp_path)), "-o", str(out), "--camera", "FC6310", "--height", "100",
             "--overlap", "60", "--sidelap", "50", "--drones", "2", "--seconds", "1",
             "--quiet"]  # fmt: skip
    assert CliRunner().invoke(app, words, catch_exceptions=False).exit_code == 0
    files = {p.name for p in out.iterdir()}
    assert {"plan.json", "points.geojson", "routes.geojson", "plan.kml", "plan.html"} <= files
    assert {f"0{k}-drone-{k}{e}" for k in (1, 2) for e in (".plan", ".waypoints", ".kmz", ".csv")
            } <= files  # fmt: skip
    said = CliRunner().invoke(
        app, ["plan", "check", str(out / "plan.json")], catch_exceptions=False
    )
    assert "conflicts:   none" in said.output and " 0 m2 have fewer" in said.output
    page = (out / "plan.html").read_text()
    assert "http://" not in page and "https://" not in page and "Least views" in page


@pytest.mark.slow
def test_the_command_ends_with_one_sentence(tmp_path):
    words = ["plan", str(area(tmp_path)), "-o", str(tmp_path / "o"), "--height", "50"]
    code = "import sys; from skyquilt.cli.main import run; sys.argv = sys.argv[1:]; run()"
    said = subprocess.run(
        [sys.executable, "-c", code, "skyquilt", *words],
        capture_output=True,
        text=True,
        check=False,
    )
    assert said.returncode == 2
    assert said.stderr == (
        "skyquilt: no camera is known; give --camera (a model such as FC6310, a cameras.json or a"
        " photo)\n"
    )
