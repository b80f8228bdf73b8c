"""The server as other programs use it, and as those use it who mean no good."""

import http.client
import io
import json
import math
import re
import sqlite3
import time
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import parse_qsl

import cv2
import defusedxml.ElementTree as ElementTree
import httpx
import numpy as np
import piexif
import pytest
import rasterio
from PIL import Image

from skyquilt.errors import UsageError
from skyquilt.live.settings import LiveSettings
from skyquilt.server import published_files
from skyquilt.server.access import Guard
from skyquilt.server.published_files import PublishedFiles
from skyquilt.server.survey import LiveSurvey
from tests.live.conftest import served

QUICK = LiveSettings(features=600, most_bytes=3_000_000)


@pytest.fixture(scope="module")
def site(flight, tmp_path_factory):
    """Four photos, sent over HTTP."""
    with served(tmp_path_factory.mktemp("site") / "out", QUICK) as site:
        for path in flight.photos[:4]:
            assert site.send(path).status_code == 201
        site.until(lambda: list(site.states().values()) == ["refined"] * 4)
        site.until(lambda: all(p["ring"] for p in site.web.get("/photos").json()["photos"]))
        site.settle()
        yield site


def middle(site):
    west, south, east, north = site.web.get("/info").json()["layers"][0]["bounds"]
    return (west + east) / 2, (south + north) / 2


def tile_of(lon, lat, z):
    n, phi = 2**z, np.radians(lat)
    return int((lon + 180) / 360 * n), int(
        (1 - np.log(np.tan(phi) + 1 / np.cos(phi)) / np.pi) / 2 * n
    )


def test_tiles_tilejson_and_info(site):
    info = site.web.get("/info").json()
    assert info["layers"][0]["name"] == "visible"
    x, y = tile_of(*middle(site), 19)
    tile = site.web.get(f"/tiles/19/{x}/{y}")
    assert tile.status_code == 200
    with Image.open(io.BytesIO(tile.content)) as image:
        assert image.format == "WEBP"
        assert image.size == (256, 256)
        assert np.asarray(image.convert("RGBA"))[..., 3].max() == 255
    assert site.web.get("/tiles/19/0/0").status_code == 204
    assert site.web.get("/tiles/2/9/0").status_code == 404
    assert site.web.get(f"/tiles/19/{x}/{y}", params={"layer": "../../x"}).status_code == 404
    said = site.web.get("/tiles.json").json()
    assert said["tilejson"] == "3.0.0"
    assert said["tiles"][0].startswith(site.url + "tiles/{z}/{x}/{y}")


def test_a_point_lists_the_photos_that_cover_it(site, flight):
    at = site.web.get("/photos/1").json()["at"]
    found = site.web.get("/photos", params={"lon": at[0], "lat": at[1]}).json()["photos"]
    assert found[0]["id"] == 1  # nearest to its own centre
    assert len(found) > 1
    assert site.web.get("/photos", params={"lon": at[0] + 1, "lat": at[1]}).json()["photos"] == []
    file = site.web.get("/photos/1/file")
    assert file.content == next(p for p in flight.photos if p.name == found[0]["name"]).read_bytes()


@pytest.mark.parametrize("version", ["1.1.1", "1.3.0"])
@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857", "utm"])
def test_wms_as_a_desktop_gis_asks(site, version, crs):
    """GetCapabilities, then GetMap on the extent stated there, in the axis order of the version."""
    info = site.web.get("/info").json()
    crs = info["layers"][0]["crs"] if crs == "utm" else crs
    base = {"SERVICE": "WMS", "VERSION": version}
    text = site.web.get("/wms", params={**base, "REQUEST": "GetCapabilities"}).text
    root = ElementTree.fromstring(text)
    tag = "SRS" if version == "1.1.1" else "CRS"
    boxes = [e for e in root.iter() if e.tag.endswith("}BoundingBox") or e.tag == "BoundingBox"]
    box = next(e for e in boxes if e.get(tag) == crs)
    bbox = ",".join(box.get(k) for k in ("minx", "miny", "maxx", "maxy"))
    if crs == "EPSG:4326":  # 1.3.0 puts the latitude first
        assert (float(box.get("minx")) > 40) == (version == "1.3.0")
    want = {
        **base,
        "REQUEST": "GetMap",
        "LAYERS": "visible",
        "STYLES": "",
        tag: crs,
        "BBOX": bbox,
        "WIDTH": 300,
        "HEIGHT": 300,
        "FORMAT": "image/png",
        "TRANSPARENT": "TRUE",
    }
    answer = site.web.get("/wms", params=want)
    assert answer.headers["content-type"] == "image/png"
    with Image.open(io.BytesIO(answer.content)) as image:
        alpha = np.asarray(image)[..., 3]
    assert 0.2 < (alpha > 0).mean() < 1.0
    lower = site.web.get("/wms", params={k.lower(): v for k, v in want.items()})
    assert lower.content == answer.content
    wrong = site.web.get("/wms", params={**want, "LAYERS": "<b>"})
    assert wrong.status_code == 400
    assert "LayerNotDefined" in wrong.text
    assert "<b>" not in wrong.text
    for name, value in (
        ("WIDTH", "100000"),
        ("WIDTH", "-1"),
        ("BBOX", "1,2,3"),
        ("BBOX", "nan,0,1,1"),
        ("FORMAT", "x"),
        (tag, "EPSG:0"),
    ):
        assert site.web.get("/wms", params={**want, name: value}).status_code == 400, name


def recorded():
    """(version, CRS) and queries, in order, of what a real QGIS asked; the first picture of a group
    is the whole map.
    """
    groups = {}
    lines = (Path(__file__).parent / "qgis_3_22.txt").read_text().splitlines()
    for line in lines[1:]:
        query = dict(parse_qsl(line.partition("?")[2], keep_blank_values=True))
        if query["REQUEST"] == "GetMap":
            key = query["VERSION"], query.get("CRS") or query["SRS"]
            groups.setdefault(key, []).append(query)
    return groups


@pytest.mark.slow
@pytest.mark.parametrize(("version", "crs"), list(recorded()))
def test_the_requests_of_a_real_qgis(site, version, crs):
    """Replayed with this map's extent in place of the one that was recorded; closer views show a
    part of the whole.
    """
    asked = {"SERVICE": "WMS", "REQUEST": "GetCapabilities"} | (
        {"VERSION": version} if version != "1.3.0" else {}
    )
    root = ElementTree.fromstring(
        site.web.get("/wms", params=asked).text
    )  # QGIS leaves the version to the server
    assert root.get("version") == version
    tag = "SRS" if version == "1.1.1" else "CRS"
    here = site.web.get("/info").json()["layers"][0]["crs"] if crs == "EPSG:32615" else crs
    box = next(e for e in root.iter() if e.tag.endswith("BoundingBox") and e.get(tag) == here)
    own = np.array([float(box.get(k)) for k in ("minx", "miny", "maxx", "maxy")])
    queries = recorded()[version, crs]
    whole = np.array([float(v) for v in queries[0]["BBOX"].split(",")])
    pictures = []
    for query in queries:
        part = (
            np.array([float(v) for v in query["BBOX"].split(",")]) - whole[[0, 1, 0, 1]]
        ) / np.tile(whole[2:] - whole[:2], 2)
        bbox = own[[0, 1, 0, 1]] + part * np.tile(own[2:] - own[:2], 2)
        sent = {**query, tag: here, "LAYERS": "visible", "BBOX": ",".join(map(repr, bbox.tolist()))}
        answer = site.web.get("/wms", params=sent)
        assert answer.status_code == 200
        assert answer.headers["content-type"] == query["FORMAT"]
        with Image.open(io.BytesIO(answer.content)) as image:
            assert image.size == (int(query["WIDTH"]), int(query["HEIGHT"]))
            pictures.append((part, np.asarray(image.convert("L")).astype(np.float32)))
    for (wide, far), (close, near) in pairwise(pictures):
        flipped = crs == "EPSG:4326" and version == "1.3.0"  # latitude comes first
        order = [1, 0, 3, 2] if flipped else [0, 1, 2, 3]
        (x0, y0, x1, y1), (wx0, wy0, wx1, wy1) = close[order], wide[order]
        h, w = far.shape
        columns = [round((x - wx0) / (wx1 - wx0) * w) for x in (x0, x1)]
        rows = [round((wy1 - y) / (wy1 - wy0) * h) for y in (y1, y0)]
        shown = far[rows[0] : rows[1], columns[0] : columns[1]]
        again = cv2.resize(near, shown.shape[::-1], interpolation=cv2.INTER_AREA)
        assert np.corrcoef(shown.ravel(), again.ravel())[0, 1] > 0.95


def test_the_requests_of_mission_planner(site):
    """As its source makes them and checks the answers (ArduPilot/MissionPlanner:
    ExtLibs/Maps/WMSProvider.cs and GCSViews/FlightPlanner.cs): capabilities asked for as 1.1.0,
    then tiles in degrees, as 1.1.1.
    """
    answer = site.web.get("/wms?version=1.1.0&Request=GetCapabilities&service=WMS")
    root = ElementTree.fromstring(answer.content)
    assert root.tag == "WMT_MS_Capabilities"
    assert len(root.findall(".//GetMap")) == 1
    assert any("image/png" in e.text for e in root.iter("Format"))
    assert any("EPSG:4326" in e.text for e in root.iter("SRS"))
    names = {e.findtext("Name"): e.findtext("Title") for e in root.findall(".//Layer/Layer")}
    assert all(names) and all(names.values()) and "visible" in names

    zoom = 19
    x, y = tile_of(*middle(site), zoom)
    west, east = (n / 2**zoom * 360 - 180 for n in (x, x + 1))
    north, south = (
        math.degrees(math.atan(math.sinh(math.pi * (1 - n / 2 ** (zoom - 1))))) for n in (y, y + 1)
    )
    bbox = f"{west},{south},{east},{north}"
    query = f"VERSION=1.1.1&REQUEST=GetMap&SERVICE=WMS&layers=visible&styles=&bbox={bbox}"
    answer = site.web.get(f"/wms?{query}&width=256&height=256&srs=EPSG:4326&format=image/png")
    assert answer.status_code == 200 and answer.headers["content-type"] == "image/png"
    tile = site.web.get(f"/tiles/{zoom}/{x}/{y}")
    with (
        Image.open(io.BytesIO(answer.content)) as image,
        Image.open(io.BytesIO(tile.content)) as like,
    ):
        seen, expected = (np.asarray(i.convert("RGBA")).astype(float) for i in (image, like))
    shown = expected[..., 3] == 255
    assert shown.mean() > 0.2
    off = np.abs(seen - expected)[shown][:, :3].mean()
    assert off < 6  # WebP, and degrees for metres
    assert (
        np.abs(np.roll(seen, 40, 0) - expected)[shown][:, :3].mean() > 2 * off
    )  # the figure means something


def test_export_is_a_georeferenced_cog(site, tmp_path):
    from rio_cogeo import cog_validate

    west, south, east, north = site.web.get("/info").json()["layers"][0]["bounds"]
    answer = site.web.get("/export", params={"bbox": f"{west},{south},{east},{north}"})
    path = tmp_path / "e.tif"
    path.write_bytes(answer.content)
    valid, errors, _ = cog_validate(path)
    assert valid, errors
    with rasterio.open(path) as raster:
        assert raster.crs.to_string() == site.web.get("/info").json()["layers"][0]["crs"]
        assert raster.dataset_mask().mean() > 50
    assert site.web.get("/export", params={"bbox": "1,2,3"}).status_code == 400
    assert site.web.get("/export", params={"bbox": "10,10,11,11"}).status_code == 404


def test_an_error_of_one_step_does_not_end_publishing(site, tmp_path, monkeypatch):
    """Whatever it is, it is logged once, and the files follow when the next step succeeds."""
    steps = []

    def step(self, *, now=False):
        steps.append(now)
        if len(steps) < 4:
            raise ValueError("of one kind")

    monkeypatch.setattr(published_files, "PAUSE_S", 0.01)
    monkeypatch.setattr(PublishedFiles, "step", step)
    with PublishedFiles(LiveSurvey(site.folder), tmp_path):
        deadline = time.monotonic() + 20
        while len(steps) < 6 and time.monotonic() < deadline:
            time.sleep(0.01)
    assert len(steps) >= 6
    assert (tmp_path / "errors.log").read_text().count("ValueError: of one kind") == 1


def test_a_map_without_a_picture_is_not_published(tmp_path):
    """A layer that tells its bounds but shows nothing yet."""

    class Empty:
        crs = "EPSG:32632"

        def bounds(self):
            return (0.0, 0.0, 1.0, 1.0)

        def about(self):
            return None

    class Survey:
        ledger = SimpleNamespace(told=lambda known: [])

        def layers(self):
            return {"visible": Empty()}

        def styles(self):
            return {"visible": None}

    PublishedFiles(Survey(), tmp_path).step(now=True)
    assert not list(tmp_path.iterdir())


def test_files_for_other_programs(site):
    survey = LiveSurvey(site.folder)
    PublishedFiles(survey, site.folder).step(now=True)
    with sqlite3.connect(site.folder / "map.mbtiles") as db:
        about = dict(db.execute("select name, value from metadata"))
        z, x, y, data = db.execute(
            "select * from tiles order by zoom_level desc limit 1"
        ).fetchone()
    assert about["format"] == "webp"
    assert z == int(about["maxzoom"])
    assert data == site.web.get(f"/tiles/{z}/{x}/{2**z - 1 - y}").content
    with (
        rasterio.open(site.folder / "map.tif") as raster,
        rasterio.open(site.folder / "map.mbtiles") as tiles,
    ):
        assert raster.count == 3
        assert tiles.crs.to_epsg() == 3857


def test_openapi_names_the_fixed_paths(site):
    paths = site.web.get("/openapi.json").json()["paths"]
    assert {"/tiles/{z}/{x}/{y}", "/wms", "/events", "/photos", "/layers"} <= set(paths)


def test_news_can_be_taken_up_where_they_were_lost(site):
    with site.web.stream("GET", "/events", params={"after": 0}) as answer:
        ids = []
        for line in answer.iter_lines():
            if line.startswith("id: "):
                ids.append(int(line[4:]))
            if len(ids) == 5:
                break
    with site.web.stream("GET", "/events", headers={"Last-Event-ID": str(ids[2])}) as answer:
        first = next(line for line in answer.iter_lines() if line.startswith("id: "))
    assert int(first[4:]) == ids[3]


# -- bad input
# ------------------------------------------------------------------------------------------------


def png_that_claims(width, height):
    import struct
    import zlib

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(b"\0" * 100))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize(
    ("name", "data", "word"),
    [
        ("text.jpg", b"hello", "neither"),
        ("page.jpg", b"<html><script>alert(1)</script></html>", "a web page"),
        ("cut.jpg", None, "truncated"),
        ("bomb.png", png_that_claims(60000, 60000), "megapixels"),
        ("tiny.png", png_that_claims(3, 3), "px"),
    ],
)
def test_what_is_no_photo_is_refused_with_the_reason(site, flight, name, data, word):
    data = flight.photos[5].read_bytes()[:20000] if data is None else data
    answer = site.web.post("/photos", params={"name": name}, content=data)
    assert answer.status_code == 422, answer.text
    assert word in answer.json()["reason"]
    assert name in [r["name"] for r in site.web.get("/photos").json()["refused"]]
    known = {row[0] for row in site.live.ledger.rows("select file from photo")}
    assert {p.name for p in (site.folder / "photos").iterdir()} <= known


def test_too_large_is_refused_before_and_while_it_comes(site):
    assert site.web.post("/photos", content=b"\xff\xd8\xff" + b"0" * 3_000_000).status_code == 413
    assert (
        site.web.post(
            "/photos", content=iter([b"\xff\xd8\xff", b"0" * 2_000_000, b"0" * 2_000_000])
        ).status_code
        == 413
    )
    assert not list((site.folder / "uploads").iterdir())


@pytest.mark.parametrize(
    "name",
    ["../../evil.jpg", "/etc/passwd", "..\\..\\evil.jpg", "a\x00b.jpg", "x" * 5000 + ".jpg", ""],
)
def test_names_are_never_paths(site, name, tmp_path):
    before = {
        p
        for p in site.folder.parent.rglob("*")
        if p.suffix not in (".db-wal", ".db-shm", ".npz", ".partial")
    }
    answer = site.web.post("/photos", params={"name": name}, content=b"nothing of the kind")
    assert answer.status_code == 422
    assert not re.search(r"[/\\\x00]", answer.json()["name"])
    assert len(answer.json()["name"]) <= 200
    after = {
        p
        for p in site.folder.parent.rglob("*")
        if p.suffix not in (".db-wal", ".db-shm", ".npz", ".partial")
    }
    assert after <= before


def test_static_files_are_no_directory(site):
    for path in (
        "/static/",
        "/static/leaflet/",
        "/static/../app.py",
        "/static/%2e%2e/app.py",
        "/photos/1/../../live.db",
    ):
        answer = site.web.get(path)
        assert answer.status_code in (404, 405, 422), path
        assert "import" not in answer.text


def test_every_answer_carries_the_headers(site):
    for path in ("/", "/info", "/tiles/0/0/0", "/nothing", "/static/viewer.js"):
        headers = site.web.get(path).headers
        assert "script-src 'self'" in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"


def test_other_sites_may_not_write_nor_point_here(site, flight):
    assert site.send(flight.photos[5], headers={"Origin": "http://evil.example"}).status_code == 403
    assert site.web.get("/info", headers={"Host": "evil.example"}).status_code == 421


@pytest.mark.parametrize(
    ("body", "word"),
    [
        (b"{", "not JSON"),
        (b"[1]", "not a GeoJSON"),
        (b'{"type": "Topology"}', "FeatureCollection"),
        (b'{"type": "Point", "coordinates": [1e9, 0]}', "degrees"),
        (b'{"type": "Point", "coordinates": [NaN, 0]}', "NaN"),
        (b'{"type": "Polygon", "coordinates": ' + b"[" * 50000 + b"]" * 50000 + b"}", ""),
        (
            b'{"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": null}]}',
            "geometry",
        ),
    ],
)
def test_layers_that_are_none(site, body, word):
    answer = site.web.post("/layers", params={"name": "x"}, content=body)
    assert answer.status_code == 422, answer.text
    assert word in answer.json()["detail"]
    assert "x" not in [layer["name"] for layer in site.web.get("/layers").json()["layers"]]


def test_layers_come_and_go(site):
    lon, lat = middle(site)
    layer = {
        "type": "Feature",
        "properties": {"name": "<b>"},
        "geometry": {"type": "Point", "coordinates": [lon, lat]},
    }
    assert site.web.post("/layers", params={"name": "found/it"}, json=layer).status_code == 201
    assert site.web.get("/layers/it").json()["features"][0]["properties"] == {"name": "<b>"}
    assert site.web.delete("/layers/it").status_code == 200
    assert site.web.get("/layers/it").status_code == 404


@pytest.mark.slow
def test_a_flood_of_tiny_requests_is_answered_and_nothing_is_lost(site):
    before = site.states()
    refused = site.web.get("/info").json()["counts"]["refused"]
    bad = [b"", b"\xff\xd8\xff", b"\xff\xd8\xff\xd9", b"II*\x00"]
    codes = {site.web.post("/photos", content=bad[k % 4]).status_code for k in range(200)}
    assert codes == {422}
    after = (
        site.states()
    )  # what was placed may be refined meanwhile, and nothing else may happen to it
    assert all(after[k] == v or (v, after[k]) == ("placed", "refined") for k, v in before.items())
    assert site.web.get("/info").json()["counts"]["refused"] == refused + 200


@pytest.mark.long
@pytest.mark.slow
def test_ten_thousand_tiny_requests(site):
    before = site.states()
    web = http.client.HTTPConnection(
        "127.0.0.1", int(site.url.rsplit(":", 1)[1].strip("/")), timeout=30
    )
    codes = set()
    for k in range(10_000):
        web.request(*(("GET", f"/photos/{k + 100}") if k % 2 else ("POST", "/layers?name=n", b"")))
        with web.getresponse() as answer:
            answer.read()
            codes.add(answer.status)
    web.close()
    assert codes == {404, 422}
    assert site.states().keys() == before.keys()


def test_a_token_guards_writing_and_only_writing(flight, tmp_path):
    with pytest.raises(UsageError, match="--token"):
        Guard(host="0.0.0.0")
    with pytest.raises(UsageError, match="at least 8"):
        Guard(host="0.0.0.0", token="short")
    with served(tmp_path / "out", QUICK, guard=Guard(token="long enough")) as site:
        for headers in (
            {"X-Token": "wrong one"},
            {"X-Token": ""},
            {"Authorization": "Bearer nonsense"},
        ):
            assert site.send(flight.photos[0], headers=headers).status_code == 401
            assert (
                site.web.post(
                    "/layers", params={"name": "x"}, content=b"{}", headers=headers
                ).status_code
                == 401
            )
            assert site.web.post("/finish", headers=headers).status_code == 401
        assert httpx.get(site.url + "info", verify=False).status_code == 200
        assert site.send(flight.photos[0]).status_code == 201
        assert (
            site.send(
                flight.photos[1], headers={"Authorization": "Bearer long enough", "X-Token": ""}
            ).status_code
            == 201
        )


def test_html_in_exif_stays_text(site, flight, tmp_path):
    path = tmp_path / "x.jpg"
    exif = piexif.load(str(flight.photos[5]))
    exif["0th"][piexif.ImageIFD.Model] = b"<img src=x onerror=alert(1)>"
    path.write_bytes(flight.photos[5].read_bytes())
    piexif.insert(piexif.dump(exif), str(path))
    answer = site.send(path, name="<script>alert(1)</script>.jpg")
    assert answer.status_code in (201, 422)
    listed = site.web.get("/photos")
    assert listed.headers["content-type"] == "application/json"
    assert json.loads(listed.text)
