"""Bodies that nobody means, sent to every path that takes one: each is refused or taken, quickly,
and the server goes on.
"""

import gzip
import io
import json
import math
import sqlite3
import time
import zipfile

import httpx
import pytest

from skyquilt.live.settings import LiveSettings
from skyquilt.server.access import Guard
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import open_survey
from tests.live.conftest import served

NEST = 200_000
RING = [[13.1, 52.1], [13.101, 52.1], [13.101, 52.101], [13.1, 52.1]]


def _feature(**geometry):
    whole = {"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {}, "geometry": geometry}]}  # fmt: skip
    return json.dumps(whole).encode()


def _geopackage(change):
    base = sqlite3.connect(":memory:")
    base.executescript(
        "PRAGMA application_id = 1196444487; CREATE TABLE gpkg_contents (table_name TEXT,"
        " data_type TEXT, identifier TEXT, srs_id INTEGER); CREATE TABLE gpkg_geometry_columns"
        " (table_name TEXT, column_name TEXT, geometry_type_name TEXT, srs_id INTEGER, z INTEGER,"
        " m INTEGER); CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT, srs_id INTEGER,"
        " organization TEXT, organization_coordsys_id INTEGER, definition TEXT);"
        " INSERT INTO gpkg_spatial_ref_sys VALUES ('WGS 84', 4326, 'EPSG', 4326, '');"
        " CREATE TABLE a (fid INTEGER PRIMARY KEY, geom BLOB);"
        " INSERT INTO gpkg_contents VALUES ('a', 'features', 'a', 4326);"
        " INSERT INTO gpkg_geometry_columns VALUES ('a', 'geom', 'POLYGON', 4326, 0, 0);"
    )
    base.executescript(change)
    return base.serialize()


def _zip(name, data):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
    return file.getvalue()


def _multipart(data):
    return (
        b'--x\r\nContent-Disposition: form-data; name="file"; filename="a.jpg"\r\n\r\n'
        + data
        + b"\r\n--x--\r\n"
    )


def _deep(depth):
    inner = {"type": "Point", "coordinates": [13.1, 52.1]}
    for _ in range(depth):
        inner = {"type": "GeometryCollection", "geometries": [inner]}
    return inner


ENDLESS = (
    "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c WHERE n < 4000000000)"
    " SELECT n AS fid, zeroblob(n) AS geom FROM c"
)
STAR = [[round(math.sin(k * 2.7), 6), round(math.cos(k * 2.7), 6)] for k in range(3000)]
STAR += STAR[:1]
TEETH = [[k / 1e4, 1 if k % 4 in (1, 2) else 0.01] for k in range(9000)]
COMB = [*TEETH, [0.9, 0], [0, 0], [0, 0.01]]
BODIES = {
    "nothing": b"",
    "a zero": b"\x00",
    "deep lists": b"[" * NEST,
    "deep objects": b'{"features":' * NEST,
    "deep in the right place": b'{"type":"FeatureCollection","features":[{"type":"Feature",'
    b'"geometry":{"type":"Polygon","coordinates":' + b"[" * NEST + b"]" * NEST + b"}}]}",
    "deep collections": _feature(**_deep(400)),
    "many digits": b'{"crs":"EPSG:32633","points":[{"name":"a","x":'
    + b"9" * 100_000
    + b',"y":1}],"marks":[]}',
    "infinite": b'{"type":"FeatureCollection","features":[{"type":"Feature","properties":{},'
    b'"geometry":{"type":"Point","coordinates":[1e999,-1e999]}}]}',
    "not a number": b'{"crs":"EPSG:32633","points":[{"name":"a","x":NaN,"y":Infinity}],"marks":[]}',
    "squares": json.dumps(
        {"crs": "EPSG:32633", "points": [{"name": "a", "x": "\u00b2", "y": "\u0663"}], "marks": []},
        ensure_ascii=False,
    ).encode(),
    "lone surrogates": b'{"crs":"\\ud800","points":[{"name":"\\udfff","x":1,"y":2}],"marks":[]}',
    "names as lists": b'{"crs":"EPSG:32633","points":[{"name":'
    + b"[" * 900
    + b"]" * 900
    + b',"x":1,"y":2}],"marks":[{"point":{},"photo":[],"x":{},"y":[]}]}',
    "objects for lists": b'{"crs":{},"points":{},"marks":"aaaa"}',
    "half a million nulls": b'{"type":"FeatureCollection","features":['
    + b"null," * 500_000
    + b"null]}",
    "true places": _feature(type="Polygon", coordinates=[[[True, False]] * 4]),
    "words for places": _feature(type="Polygon", coordinates=[[["a", "b"]] * 4]),
    "places of no dimension": _feature(type="Polygon", coordinates=[[[]] * 4]),
    "places of nine dimensions": _feature(type="Polygon", coordinates=[[[1] * 9] * 4]),
    "off the Earth": _feature(type="Polygon", coordinates=[[[1e300, 1e300]] * 4]),
    "a hundred thousand corners": lambda: _feature(
        type="Polygon",
        coordinates=[[[13 + (k % 7) / 9, 52 + (k % 11) / 9] for k in range(100_000)] + [[13, 52]]],
    ),
    "no geometry": _feature(),
    "UTF-16": json.dumps({"type": "FeatureCollection", "features": []}).encode("utf-16"),
    "compressed": lambda: gzip.compress(b"[" * 10_000_000),
    "a form": _multipart(b"\xff\xd8\xff"),
    "XML that grows": b'<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "'
    + b"&a;" * 1000
    + b'"><!ENTITY c "'
    + b"&b;" * 1000
    + b'">]><kml>&c;</kml>',
    "XML that reads": b'<!DOCTYPE a [<!ENTITY a SYSTEM "file:///etc/passwd">]><kml>&a;</kml>',
    "deep XML": b"<kml>" + b"<Folder>" * NEST,
    "an archive of zeros": lambda: _zip("doc.kml", bytes(30_000_000)),
    "an archive that climbs": _zip("../../a.kml", b"<kml/>"),
    "an empty database": _geopackage("DROP TABLE a;"),
    "a database of views": _geopackage(f"DROP TABLE a; CREATE VIEW a AS {ENDLESS};"),
    "a database of blobs": _geopackage("INSERT INTO a VALUES (1, zeroblob(2000000));"),
    "a database of deep blobs": _geopackage(
        "INSERT INTO a VALUES (1, x'" + "47500001E6100000" + "010700000001000000" * 20_000 + "');"
    ),
    "a database of counts": _geopackage(
        "INSERT INTO a VALUES (1, x'47500001E61000000103000000FFFFFFFFFFFFFFFF');"
    ),
    "a database of names": _geopackage(
        "UPDATE gpkg_geometry_columns SET table_name = 'a\"; DROP TABLE a; --',"
        " column_name = zeroblob(100), srs_id = 'x';"
    ),
    "a database of one huge blob": _geopackage(
        "DROP TABLE a; CREATE VIEW a AS SELECT 1 AS fid, zeroblob(900000000) AS geom;"
    ),
    "a database of huge text": _geopackage(
        "DROP TABLE a; CREATE VIEW a AS SELECT 1 AS fid,"
        " replace(hex(zeroblob(200000000)), '0', 'aa') AS geom;"
    ),
    "a database that is sorted": _geopackage(
        "DROP TABLE a; CREATE VIEW a AS WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1"
        " FROM c WHERE n < 300000) SELECT n AS fid, zeroblob(2000) AS geom FROM c ORDER BY"
        " random();"
    ),
    "a database of endless tables": _geopackage(
        "DROP TABLE gpkg_geometry_columns; CREATE VIEW gpkg_geometry_columns AS WITH RECURSIVE"
        " c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c) SELECT 'a' AS table_name, 'geom' AS"
        " column_name, n AS srs_id FROM c WHERE n < 0;"
    ),
    "a database of endless systems": _geopackage(
        "DROP TABLE gpkg_spatial_ref_sys; CREATE VIEW gpkg_spatial_ref_sys AS WITH RECURSIVE c(n)"
        " AS (SELECT 1 UNION ALL SELECT n + 1 FROM c) SELECT n AS srs_id, 'EPSG' AS organization,"
        " n AS organization_coordsys_id, '' AS definition FROM c WHERE n < 0;"
    ),
    "a star of 3,000 corners": _feature(type="Polygon", coordinates=[STAR]),
    "two combs": lambda: json.dumps(
        {
            "type": "FeatureCollection",
            "features": [
                {
                    "type": "Feature",
                    "properties": {},
                    "geometry": {"type": "Polygon", "coordinates": [[p[::way] for p in COMB]]},
                }
                for way in (1, -1)
            ],
        }
    ).encode(),
    "half a database": _geopackage("INSERT INTO a VALUES (1, zeroblob(9000));")[:-5000],
    "a megabyte of one letter": b"a" * 1_000_000,
}
"""Those that take long are made when they are sent."""
PLACES = (
    ("PUT", "/areas"),
    ("POST", "/layers?name=a.geojson"),
    ("POST", "/layers?name=a.kml"),
    ("POST", "/layers?name=a.kmz"),
    ("POST", "/layers?name=a.gpkg"),
    ("POST", "/layers?name=a.zip"),
    ("POST", "/plan?camera=FC6310&height=50"),
    ("POST", "/photos?name=a.jpg"),
    ("POST", "/photos?name=a.tif"),
    ("POST", "/photos?name=a.mp4"),
    ("POST", "/photos?name=a.srt"),
    ("PUT", "/control"),
    ("POST", "/control/read?crs=EPSG:32633"),
    ("POST", "/control/run"),
    ("POST", "/plan/missing"),
    ("POST", "/photos/uploads"),
    ("PATCH", "/photos/uploads/1"),
    ("DELETE", "/photos/uploads/1"),
    ("DELETE", "/layers/a"),
    ("POST", "/nothing"),
    ("POST", "/finish"),  # last, since it ends the flight
)
TYPES = ("application/json", "multipart/form-data; boundary=x", "text/\u00e9; charset=utf-99", "")
SLOWEST_S = 5.0


def attack(web, method, path):
    """Sends every body; returns what was answered with an error of the server, or late."""
    bad = []
    for k, (name, made) in enumerate(BODIES.items()):
        body = made() if callable(made) else made
        headers = {"Content-Type": TYPES[k % len(TYPES)].encode("latin-1")}
        if name == "compressed":
            headers["Content-Encoding"] = "gzip"
        started = time.perf_counter()
        answer = web.request(method, path, content=body, headers=headers)
        took = time.perf_counter() - started
        if answer.status_code >= 500 or took > SLOWEST_S:
            bad.append((name, answer.status_code, answer.text[:200], round(took, 1)))
        elif answer.status_code >= 400:
            assert len(answer.text) < 5000, name
    return bad


@pytest.fixture(scope="module")
def live_web(tmp_path_factory):
    with served(tmp_path_factory.mktemp("bodies") / "out", LiveSettings(features=300)) as site:
        yield site.web


@pytest.mark.slow
@pytest.mark.parametrize(("method", "path"), PLACES)
def test_bodies_that_nobody_means_are_answered(live_web, method, path):
    assert attack(live_web, method, path) == []
    assert live_web.get("/info").status_code == 200


@pytest.mark.slow
@pytest.mark.parametrize(("method", "path"), [p for p in PLACES if "control" in p[1]])
def test_the_same_for_a_finished_map(finished, method, path):
    survey = open_survey(finished.output)
    serving = ServerThread(survey=survey, guard=Guard(), folder=finished.output)
    with serving, httpx.Client(base_url=serving.url, timeout=60, verify=False) as web:
        assert attack(web, method, path) == []
        assert web.get("/info").status_code == 200
