"""What the viewer of a finished run says of a place, against the run's own rasters."""

import asyncio
import io
import os
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import httpx
import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from starlette.requests import ClientDisconnect

from skyquilt.errors import OutputError
from skyquilt.raster.map_source import FileSource
from skyquilt.runs.layers import RunLayer
from skyquilt.server import parts
from skyquilt.server.access import Guard
from skyquilt.server.app import make_app
from skyquilt.server.parts import write_part
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import open_survey


@pytest.fixture(scope="module")
def ground(finished):
    with rasterio.open(finished.output / "dsm.tif") as file:
        return file.read(1), file.transform, file.bounds


def lonlat(x, y):
    return Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True).transform(x, y)


def test_every_raster_is_a_layer_and_measured_ones_have_a_legend(web, finished):
    said = web.get("/info").json()
    layers = {n["name"]: n for n in said["layers"]}
    assert list(layers) == ["mosaic", "heights", "hillshade", "views", "provenance"]
    assert "legend" not in layers["mosaic"] and "legend" not in layers["hillshade"]
    told = layers["heights"]["legend"]
    assert told["low"] < told["high"] and told["unit"].startswith("m ")
    with rasterio.open(finished.output / "dsm.tif") as file:
        z = file.read(1)
    assert np.nanmin(z) <= told["low"] < told["high"] <= np.nanmax(z)
    for name in layers:
        west, south, east, north = layers[name]["bounds"]
        box = {"bbox": f"{west},{south},{east},{north}", "layer": name}
        assert web.get("/export", params=box).status_code == 200, name
    assert web.get("/wms", params={"service": "WMS", "request": "GetCapabilities"}).is_success


def test_a_saved_part_is_the_map_s_own_pixels(web, finished):
    with rasterio.open(finished.output / "dsm.tif") as file:
        box = [v + d for v, d in zip(file.bounds, (3.03, 4.04, -5.05, -2.02), strict=True)]
        to = Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True)
        bbox = ",".join(str(v) for v in to.transform_bounds(*box))
        whole, step = file.read(1), file.res[0]
        answer = web.get("/export", params={"bbox": bbox, "layer": "heights"})
        with rasterio.open(io.BytesIO(answer.content)) as part:
            z = part.read(1)
            assert part.res == file.res and part.units == file.units
            c, r = (round(v) for v in ~file.transform @ (part.bounds.left, part.bounds.top))
            assert part.bounds.left == pytest.approx(file.bounds.left + c * step, abs=1e-6)
    expected = whole[r : r + z.shape[0], c : c + z.shape[1]]
    assert z.size > 1000 and np.array_equal(z, expected, equal_nan=True)


@pytest.mark.slow
def test_a_saved_part_leaves_no_file(web, finished, tmp_path, monkeypatch):
    """Neither once it is sent, nor where it cannot be written, nor where its client is gone."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    west, south, east, north = web.get("/info").json()["layers"][0]["bounds"]
    query = f"bbox={west},{south},{east},{north}"
    assert len(web.get(f"/export?{query}").content) > 10_000
    until = time.monotonic() + 10
    while list(tmp_path.iterdir()):  # the answer is here a moment before the server ends with it
        assert time.monotonic() < until
        time.sleep(0.01)

    sent = []

    async def gone(message):
        sent.append(list(tmp_path.iterdir()))
        raise OSError("the client is gone")

    async def waiting():
        await asyncio.sleep(60)

    scope = {
        "type": "http", "method": "GET", "path": "/export", "query_string": query.encode(),
        "headers": [(b"host", b"127.0.0.1")], "asgi": {"spec_version": "2.4"},
    }  # fmt: skip
    app = make_app(open_survey(finished.output), Guard(), None, finished.output)
    with suppress(OSError, ClientDisconnect):
        asyncio.run(app(scope, waiting, gone))
    assert len(sent[0]) == 1 and list(tmp_path.iterdir()) == []

    def full(*_):
        raise OutputError("the disk is full")

    monkeypatch.setattr(parts, "write_part", full)
    assert web.get(f"/export?{query}").status_code == 507
    assert list(tmp_path.iterdir()) == []


def test_a_saved_part_of_an_older_map_in_degrees(finished, tmp_path):
    """Its pixels are small numbers of degrees, not metres."""
    with rasterio.open(
        tmp_path / "old.tif",
        "w",
        driver="GTiff",
        width=300,
        height=200,
        count=1,
        dtype="uint8",
        crs="EPSG:4326",
        transform=rasterio.transform.from_origin(15.0, 50.0, 1e-6, 1e-6),
    ) as file:
        file.write(np.arange(60_000).reshape(1, 200, 300).astype(np.uint8))  # fmt: skip
    source = FileSource(path=tmp_path / "old.tif")
    layer = RunLayer(name="base", title="", file="")
    bounds = (15.00005, 49.99985, 15.00015, 49.99995)
    assert write_part(source, layer, bounds, tmp_path / "part.tif")
    with rasterio.open(tmp_path / "part.tif") as part:
        assert (part.width, part.height) == (100, 100) and part.crs.to_epsg() == 4326


def test_a_place_has_coordinates_height_and_values(web, ground):
    z, to, _ = ground
    r, c = (n // 2 for n in z.shape)
    x, y = to @ (c + 0.5, r + 0.5)
    lon, lat = lonlat(x, y)
    said = web.get("/at", params={"lon": lon, "lat": lat}).json()
    assert said["crs"] == "EPSG:32633" and abs(said["x"] - x) < 2e-3 and abs(said["y"] - y) < 2e-3
    values = {v["layer"]: v for v in said["values"]}
    assert values["heights"]["value"] == pytest.approx(float(z[r, c]), abs=1e-3)
    assert values["views"]["value"] >= 1 and values["views"]["unit"] == "photos"
    far = web.get("/at", params={"lon": lon + 1, "lat": lat}).json()
    assert far["values"] == []


def test_a_profile_follows_the_surface(web, ground):
    z, to, _ = ground
    r = z.shape[0] // 2
    columns = np.array([z.shape[1] // 3, 2 * z.shape[1] // 3])
    ends = [to @ (c + 0.5, r + 0.5) for c in columns]
    line = ";".join("{:.9f},{:.9f}".format(*lonlat(*p)) for p in ends)
    said = web.get("/profile", params={"line": line}).json()
    reach, found = np.array(said["distance_m"]), np.array(said["height_m"], float)
    assert reach[-1] == pytest.approx(ends[1][0] - ends[0][0], abs=0.01)
    true = z[r, np.rint(np.linspace(*columns, len(reach))).astype(int)]
    off = np.abs(found - true)
    assert np.nanmedian(off) < 0.02 and np.nanpercentile(off, 90) < 0.5
    for bad in ("", "1,2", "a,b;c,d", "1,2;1,2", "999,0;0,0"):
        assert web.get("/profile", params={"line": bad}).status_code == 400


def test_a_volume_is_the_sum_over_the_cells(web, ground):
    z, to, _ = ground
    rows, columns = (slice(n // 2 - 30, n // 2 + 30) for n in z.shape)
    west, north = to @ (columns.start, rows.start)
    east, south = to @ (columns.stop, rows.stop)
    corners = [(west, north), (east, north), (east, south), (west, south)]
    ring = ";".join("{:.9f},{:.9f}".format(*lonlat(*p)) for p in corners)
    part = z[rows, columns].astype(float)
    level = float(np.nanmean(part))
    cell = abs(to.a * to.e)
    said = web.get("/volume", params={"ring": ring, "level": level}).json()
    assert said["area_m2"] == pytest.approx(3600 * cell, rel=0.05)
    above = np.nansum(np.clip(part - level, 0, None)) * cell
    assert said["above_m3"] == pytest.approx(above, rel=0.06)
    assert said["below_m3"] == pytest.approx(above, rel=0.1)  # about its own mean, both are alike
    raised = web.get("/volume", params={"ring": ring, "level": level - 10}).json()
    assert raised["above_m3"] == pytest.approx(10 * said["area_m2"], rel=0.05)
    plane = web.get("/volume", params={"ring": ring}).json()
    edge = np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]])
    assert abs(plane["level_m"] - np.nanmean(edge)) < 1.0
    assert web.get("/volume", params={"ring": "0,0;0,1;1,1"}).status_code == 404


def test_photos_are_shown_small_and_in_detail(web):
    from PIL import Image

    place = web.get("/info").json()["layers"][0]["bounds"]
    lon, lat = (place[0] + place[2]) / 2, (place[1] + place[3]) / 2
    listed = web.get("/photos", params={"lon": lon, "lat": lat}).json()["photos"]
    assert len(listed) > 1 and all(p["state"] == "used" for p in listed)
    assert len({p["source"] for p in listed}) == 1 and all(p["time"] > 1e9 for p in listed)
    photo = listed[0]
    small = web.get(f"/photos/{photo['id']}/thumbnail")
    with Image.open(io.BytesIO(small.content)) as image:
        assert max(image.size) == 480
    asked = {"x": 400.0, "y": 300.0, "size": 60, "shown": 60}
    data = web.get(f"/photos/{photo['id']}/detail", params=asked).content
    whole = web.get(f"/photos/{photo['id']}/file").content
    with Image.open(io.BytesIO(data)) as a, Image.open(io.BytesIO(whole)) as b:
        part = np.asarray(b.convert("L"), float)[271:330, 371:430]
        assert np.abs(np.asarray(a.convert("L"), float)[1:, 1:] - part).mean() < 6
    assert web.get("/photos/99/thumbnail").status_code == 404


def test_only_the_files_of_the_run_can_be_downloaded(web, finished):
    listed = {f["name"]: f for f in web.get("/files").json()["files"]}
    assert {"mosaic.tif", "dsm.tif", "report.html", "metrics.json"} <= set(listed)
    data = web.get("/files/mosaic.tif")
    assert data.content == (finished.output / "mosaic.tif").read_bytes()
    report = web.get("/files/report.html")
    assert report.headers["content-security-policy"].startswith("sandbox")
    for name in (
        "%2e%2e%2fphotos",
        ".skyquilt/run.json",
        "errors.log",
        "%2e%2e/x",
        "export/none.png",
    ):
        assert web.get(f"/files/{name}").status_code == 404, name


@pytest.mark.slow
def test_the_viewer_starts_at_once(finished):
    """In CPU seconds: other work of the machine does not count."""
    code = (
        "import resource, subprocess, sys; p = subprocess.Popen(sys.argv[1:], stdout=-1);"
        " p.stdout.readline(); p.kill(); p.wait();"
        " u = resource.getrusage(resource.RUSAGE_CHILDREN); print(u.ru_utime + u.ru_stime)"
    )
    words = [sys.executable, "-m", "skyquilt", "view", str(finished.output), "--port", "0"]
    used = [
        float(subprocess.run([sys.executable, "-c", code, *words], capture_output=True).stdout)
        for _ in range(3)
    ]
    assert 0.2 < min(used) < 1.5


def _piped(path):
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize("spoil", [Path.unlink, _piped, lambda p: p.write_bytes(b"II*\0" * 99)])
def test_rasters_replaced_while_they_are_served(finished, tmp_path, spoil):
    """A layer that cannot be read any more gets a status, the others go on; a pipe is not waited
    for.
    """
    folder = tmp_path / "run"
    shutil.copytree(finished.output, folder, ignore=shutil.ignore_patterns(".skyquilt"))
    survey = open_survey(folder)
    with (
        ServerThread(survey=survey, guard=Guard(), folder=folder) as serving,
        httpx.Client(base_url=serving.url, timeout=20, verify=False) as web,
    ):
        spoil(folder / "hillshade.tif")
        offered = web.get("/wms?SERVICE=WMS&REQUEST=GetCapabilities")
        assert offered.status_code == 200
        assert "<Name>hillshade</Name>" not in offered.text
        assert "<Name>mosaic</Name>" in offered.text
        with rasterio.open(folder / "mosaic.tif") as file:
            box = ",".join(map(str, file.bounds))
        for layer, status in (("hillshade", 503), ("mosaic", 200)):
            request = {
                "service": "WMS", "version": "1.1.1", "request": "GetMap", "layers": layer,
                "styles": "", "srs": "EPSG:32633", "bbox": box, "width": 64, "height": 64,
                "format": "image/png",
            }  # fmt: skip
            answer = web.get("/wms", params=request)
            assert answer.status_code == status, answer.text
