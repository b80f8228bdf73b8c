"""Requests that were made to keep others out, to take all memory, or to read what is not shown."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import httpx
import numpy as np
import pytest

from skyquilt.errors import OutputError, SideFileError, UsageError
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.raster import RasterSpec, write_array
from skyquilt.raster.map_source import FileSource
from skyquilt.server import connections
from skyquilt.server.access import Guard
from skyquilt.server.server_process import ServerConfig, ServerProcess
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import open_survey
from skyquilt.server.wms import MOST_PIXELS
from tests.attacks import jpeg, resident_mb

from .conftest import served

QUICK = LiveSettings(features=600)
MAP = "/wms?VERSION=1.3.0&REQUEST=GetMap&CRS=EPSG:3857&FORMAT=image/png"

SPEC = RasterSpec(
    width=2000,
    height=2000,
    bands=3,
    dtype="uint8",
    transform=(0.1, 0, 400_000, 0, -0.1, 5_800_000),
    crs="EPSG:32633",
    mask=True,
)
WHOLE = np.ones((2000, 2000), bool)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run of 2000 x 2000 px with one photo."""
    folder = tmp_path_factory.mktemp("run")
    return made_run(folder, folder / "photos")


def made_run(folder, photos):
    out = folder / "out"
    out.mkdir()
    photos.mkdir(exist_ok=True)
    (photos / "a.jpg").write_bytes(jpeg())
    pixels = np.random.default_rng(0).integers(0, 255, (2000, 2000, 3), dtype=np.uint8)
    write_array(out / "mosaic.tif", pixels, SPEC, WHOLE)
    from skyquilt.photos.headers import content_digest

    about = {
        "filename": "a.jpg",
        "digest": content_digest(photos / "a.jpg"),
        "camera": "c",
        "translation": [400_010.0, 5_799_990.0, 50.0],
    }
    shot = {"type": "Feature", "properties": about, "geometry": None}
    ring = [[13.5, 52.3], [13.6, 52.3], [13.6, 52.4], [13.5, 52.3]]
    area = {
        "type": "Feature",
        "properties": {"filename": "a.jpg"},
        "geometry": {"type": "Polygon", "coordinates": [ring]},
    }
    (out / "shots.geojson").write_text(json.dumps({"features": [shot]}))
    (out / "footprints.geojson").write_text(json.dumps({"features": [area]}))
    (out / "run.toml").write_text(f"photos = {json.dumps(str(photos))}\n")
    return out


@pytest.fixture(scope="module")
def site(run):
    survey = open_survey(run)
    with (
        ServerThread(survey=survey, guard=Guard(token="looking-only"), folder=run) as serving,
        httpx.Client(base_url=serving.url, timeout=60, verify=False) as web,
    ):
        yield web


def box(web):
    west, south, east, north = web.get("/info").json()["layers"][0]["bounds"]
    from skyquilt.raster.map_source import between

    return ",".join(
        f"{v:.3f}"
        for v in between("EPSG:4326", "EPSG:3857").transform_bounds(west, south, east, north)
    )


@pytest.mark.parametrize(
    "query",
    [
        "LAYERS=mosaic&WIDTH=000000012000&HEIGHT=64",
        "LAYERS=mosaic&WIDTH=40000&HEIGHT=64",
        "LAYERS=mosaic&WIDTH=4096&HEIGHT=4096",
        "LAYERS=mosaic&WIDTH=²&HEIGHT=64",
        "LAYERS=mosaic&WIDTH=-1&HEIGHT=64",
        "LAYERS=mosaic&WIDTH=64&HEIGHT=1e3",
        "LAYERS=" + "mosaic," * 400 + "&WIDTH=64&HEIGHT=64",
        "LAYERS=mosaic&WIDTH=64&HEIGHT=64&BBOX=1,2,nan,4",
        "LAYERS=mosaic&WIDTH=64&HEIGHT=64&BBOX=" + "1" * 400 + ",2,3,4",
    ],
)
def test_images_that_are_refused(site, query):
    bounds = "" if "BBOX" in query else f"&BBOX={box(site)}"
    began = time.process_time()
    answer = site.get(f"{MAP}&{query}{bounds}")
    assert answer.status_code == 400, answer.text
    assert time.process_time() - began < 0.5


@pytest.mark.slow
def test_the_largest_image_costs_little(site):
    side = int(MOST_PIXELS**0.5)
    query = f"{MAP}&BBOX={box(site)}&LAYERS=mosaic&WIDTH={side}&HEIGHT={side}&TRANSPARENT=TRUE"
    assert site.get(query).status_code == 200
    before, began = resident_mb(), time.process_time()
    assert site.get(query).status_code == 200
    # of the client in this process too, which holds the answer
    assert resident_mb() - before < 200 and time.process_time() - began < 2


def test_images_are_the_same_whether_drawn_at_once_or_in_strips(run):
    from skyquilt.raster import map_source

    source = map_source.FileSource(path=run / "mosaic.tif")
    bounds = (400_000.0, 5_799_800.0, 400_200.0, 5_800_000.0)
    strips = map_source.picture(source, "EPSG:32633", bounds, 700, 600)
    rows, map_source.ROWS = map_source.ROWS, 10_000
    try:
        whole = map_source.picture(source, "EPSG:32633", bounds, 700, 600)
    finally:
        map_source.ROWS = rows
    assert np.array_equal(strips, whole)


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/photos/1" + "0" * 24, 422),
        ("/photos/" + "9" * 5000, 422),
        ("/photos/-1", 422),
        ("/photos?lon=nan&lat=1", 422),
        ("/events?after=" + "9" * 30, 422),
        ("/export?bbox=nan,1,2,3", 400),
        ("/export?bbox=1,2,3", 400),
        ("/tiles/" + "9" * 30 + "/0/0", 404),
        (
            "/wms?REQUEST=GetFeatureInfo&LAYERS=mosaic&CRS=EPSG:3857&WIDTH=9&HEIGHT=9&BBOX=1,2,3,4&J=1"
            "&I=" + "9" * 400,
            400,
        ),
    ],
)
def test_numbers_that_are_refused(site, path, status):
    assert site.get(path).status_code == status


def test_odd_numbers_of_events_are_ignored(site):
    with site.stream("GET", "/events", headers={"Last-Event-ID": "²".encode()}) as answer:
        assert answer.status_code == 200


@pytest.mark.slow
def test_photos_are_shown_only_with_the_content_of_the_run(tmp_path):
    photos = tmp_path / "photos"
    run = made_run(tmp_path, photos)

    def shown(**more):
        survey = open_survey(run, **more)
        with ServerThread(survey=survey, guard=Guard(token="looking-only"), folder=run) as serving:
            return httpx.get(serving.url + "photos/1/file", verify=False)

    assert shown().content == jpeg()
    moved = tmp_path / "moved"
    photos.rename(moved)
    assert shown().status_code == 404
    assert shown(photos=moved).content == jpeg()
    (moved / "a.jpg").write_bytes(jpeg(96, 80))  # another photo
    assert shown(photos=moved).status_code == 404
    # a run of unknown origin that names a file of this machine
    secret = tmp_path / "secret"
    secret.mkdir()
    (secret / "hostname").write_text("my machine")
    from skyquilt.photos.headers import content_digest

    shots = json.loads((run / "shots.geojson").read_text())
    shots["features"][0]["properties"] |= {
        "filename": "hostname",
        "digest": content_digest(secret / "hostname"),
    }
    (run / "shots.geojson").write_text(json.dumps(shots))
    assert shown(photos=secret).status_code == 404
    with pytest.raises(UsageError):
        open_survey(run, photos=tmp_path / "nowhere")


@pytest.mark.parametrize("text", ["{", "[]", '{"features": 3}', "[" * 10_000, '{"features": [{}]}'])
def test_a_damaged_run_ends_in_a_sentence(run, tmp_path, text):
    run = shutil.copytree(run, tmp_path / "out")
    (run / "shots.geojson").write_text(text)
    with pytest.raises(SideFileError, match="damaged"):
        open_survey(run)


def test_a_final_map_that_is_being_replaced_is_not_shown_for_that_time(run, tmp_path, monkeypatch):
    live = LiveMap(tmp_path / "out", QUICK)
    home = tmp_path / "out" / "finished"
    home.mkdir()
    final = home / "mosaic.tif"
    with ServerThread(
        survey=open_survey(tmp_path / "out"), guard=Guard(), folder=tmp_path / "out"
    ) as serving:

        def layers():
            answer = httpx.get(serving.url + "info", verify=False)
            assert answer.status_code == 200
            return [layer["name"] for layer in answer.json()["layers"]]

        for begun in (b"", b"II*\0", (run / "mosaic.tif").read_bytes()[:40]):
            final.write_bytes(begun)
            assert layers() == []
            capabilities = httpx.get(serving.url + "wms?REQUEST=GetCapabilities", verify=False)
            assert capabilities.status_code == 200
            assert b"finished" not in capabilities.content
            assert httpx.get(serving.url + "at?lon=15&lat=52", verify=False).status_code == 200
        shutil.copy(run / "mosaic.tif", final)
        assert layers() == ["finished"]
        final.unlink()
        assert layers() == []
        for lost in ("tiles/5/17/10?", "tiles.json?", "export?bbox=14,51,16,53&"):
            assert httpx.get(f"{serving.url}{lost}layer=finished", verify=False).status_code == 404
        shutil.copy(run / "mosaic.tif", final)

        # after it was found, before it is read
        def gone(source):
            raise SideFileError("mosaic.tif cannot be read as a map")

        monkeypatch.setattr(FileSource, "bounds", gone)
        assert layers() == []
    live.close()


def test_tiles_of_a_final_map_that_was_made_again_are_the_new_ones(run, tmp_path):
    live = LiveMap(tmp_path / "out", QUICK)
    home = tmp_path / "out" / "finished"
    home.mkdir()
    shutil.copy(run / "mosaic.tif", home)
    with ServerThread(
        survey=open_survey(tmp_path / "out"), guard=Guard(), folder=tmp_path / "out"
    ) as serving:
        west, south, east, north = httpx.get(serving.url + "info", verify=False).json()["layers"][
            0
        ]["bounds"]
        zoom = 2**16
        x = int(((west + east) / 2 + 180) / 360 * zoom)
        phi = np.radians((south + north) / 2)
        y = int((1 - np.log(np.tan(phi) + 1 / np.cos(phi)) / np.pi) / 2 * zoom)

        def tile():
            answer = httpx.get(f"{serving.url}tiles/16/{x}/{y}?layer=finished", verify=False)
            assert answer.status_code == 200
            return answer.content

        before = tile()
        write_array(home / "mosaic.tif", np.full((2000, 2000, 3), 9, np.uint8), SPEC, WHOLE)
        live.ledger.tell("finish", {"state": "done"})
        assert tile() != before
    live.close()


def test_a_map_that_names_other_files_is_not_opened(tmp_path):
    run = made_run(tmp_path, tmp_path / "photos")
    (run / "mosaic.tif").write_text('<VRTDataset rasterXSize="1" rasterYSize="1"></VRTDataset>')
    with pytest.raises(UsageError):
        open_survey(run)


@pytest.mark.parametrize(
    ("guard", "host", "known"),
    [
        (Guard(token="long enough"), "127.0.0.1:8080", True),
        (Guard(token="long enough"), "evil.example", False),
        (Guard(token="looking-only"), "localhost", True),
        (Guard(host="192.0.2.7", token="long enough"), "192.0.2.7:80", True),
        (Guard(host="192.0.2.7", token="long enough"), "evil.example", False),
        (Guard(host="192.0.2.7", token="long enough"), socket.gethostname(), True),
        (
            Guard(host="192.0.2.7", token="long enough", allow_hosts=("map.example",)),
            "map.example:443",
            True,
        ),
        (Guard(host="0.0.0.0", token="long enough"), "192.0.2.9:8080", True),
        (Guard(host="0.0.0.0", token="long enough"), "evil.example", False),
    ],
)
def test_names_of_the_server(guard, host, known):
    assert guard.knows(host) == known


def test_the_check_of_names_stays_on_with_a_token_and_for_view(site):
    assert site.get("/info", headers={"Host": "evil.example"}).status_code == 421


def opened(port, data=b"GET /info HTTP/1.1\r\nHost: 127.0.0.1\r\n"):
    one = socket.create_connection(("127.0.0.1", port))
    one.sendall(data)
    return one


@pytest.mark.slow
def test_half_sent_headers_keep_nobody_out(run, monkeypatch):
    monkeypatch.setattr(connections, "HEADER_S", 1.0)
    guard = Guard(token="looking-only", most_connections=40)
    with ServerThread(survey=open_survey(run), guard=guard, folder=run) as serving:
        half = [opened(serving.port) for _ in range(120)]
        assert httpx.get(serving.url + "info", verify=False).status_code == 200
        ended = 0
        for one in half:
            one.settimeout(3)
            try:
                ended += one.recv(10) == b""
            except ConnectionResetError:
                ended += 1
            one.close()
        assert ended == 120


@pytest.mark.slow
def test_a_client_that_takes_no_answer_is_disconnected(run, monkeypatch):
    monkeypatch.setattr(connections, "SENDING_S", 1.0)
    with ServerThread(survey=open_survey(run), guard=Guard(token="looking-only"), folder=run) as s:
        with httpx.Client(base_url=s.url, verify=False) as web:
            query = f"{MAP}&BBOX={box(web)}&LAYERS=mosaic&WIDTH=2000&HEIGHT=2000"
        one = socket.socket()
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        one.connect(("127.0.0.1", s.port))
        one.sendall(f"GET {query} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        table = s._parts["server"].config.http_protocol_class.table
        for _ in range(200):
            time.sleep(0.1)
            if not table.by_address:
                break
        assert not table.by_address
        one.close()


@pytest.mark.slow
def test_announced_uploads_expire_and_are_counted_per_client(tmp_path):
    guard = Guard(most_uploads=6, most_uploads_each=3, upload_idle_s=1.0, upload_empty_s=2.0)
    tus = {"Tus-Resumable": "1.0.0", "Upload-Length": "1000"}
    with served(tmp_path / "out", QUICK, guard=guard) as site:
        answers = [site.web.post("/photos/uploads", headers=tus) for _ in range(4)]
        assert [a.status_code for a in answers] == [201, 201, 201, 429]
        time.sleep(1.3)
        assert site.web.post("/photos", content=jpeg()).status_code == 201
        site.until(lambda: not list((tmp_path / "out" / "uploads").glob("*.part")), 10)
    with served(tmp_path / "out", QUICK, guard=guard) as site:  # after a restart too
        assert site.web.post("/photos", content=jpeg(96, 80)).status_code == 201


def test_a_part_that_is_too_long_moves_nothing(tmp_path):
    tus = {"Tus-Resumable": "1.0.0"}
    part = tus | {"Content-Type": "application/offset+octet-stream"}
    with served(tmp_path / "out", QUICK) as site:
        begun = site.web.post("/photos/uploads", headers=tus | {"Upload-Length": "1000"})
        place = begun.headers["location"]
        long = site.web.patch(place, headers=part | {"Upload-Offset": "0"}, content=bytes(2000))
        assert long.status_code == 413
        assert site.web.head(place, headers=tus).headers["upload-offset"] == "0"
        wrong = site.web.patch(place, headers=part | {"Upload-Offset": "7"}, content=bytes(10))
        assert wrong.status_code == 409
        # bytes beyond the size, as an earlier version could leave them
        next((tmp_path / "out" / "uploads").glob("*.part")).write_bytes(bytes(1500))
        assert site.web.head(place, headers=tus).status_code == 404
        begun = site.web.post("/photos/uploads", headers=tus | {"Upload-Length": "1000"})
        assert site.web.delete(begun.headers["location"], headers=tus).status_code == 204


@pytest.mark.parametrize(
    "body",
    [
        b'{"type":"Point","coordinates":[1,2,1e999]}',
        b'{"type":"Point","coordinates":[1,2,' + b"9" * 400 + b"]}",
        b'{"type":"Point","coordinates":[1,NaN]}',
        b'{"type":"Feature","geometry":{"type":"Point","coordinates":[1,2]},"properties":'
        + b'{"a":' * 900
        + b"1"
        + b"}" * 901,
        b"[" * 100_000,
    ],
)
def test_layers_that_are_refused(tmp_path, body):
    with served(tmp_path / "out", QUICK) as site:
        answer = site.web.post("/layers", params={"name": "a"}, content=body)
        assert answer.status_code in (201, 422)
        if answer.status_code == 201:
            assert "Infinity" not in site.web.get("/layers/a").text
        else:
            assert site.web.get("/layers").json() == {"layers": []}


def test_a_layer_is_made_into_text_before_the_mapping_must_wait_for_it(tmp_path, monkeypatch):
    """A large one takes a second, in which no photo could be stored."""
    from types import SimpleNamespace

    from skyquilt.live.ledger import Ledger
    from skyquilt.server import layer_endpoints

    ledger, locked = Ledger(tmp_path, write=True), []

    def dumps(value):
        locked.append(ledger.db.in_transaction)
        return json.dumps(value)

    monkeypatch.setattr(layer_endpoints, "json", SimpleNamespace(dumps=dumps))
    layer = {"type": "FeatureCollection", "features": []}
    assert layer_endpoints.put_layer(ledger, "a", layer, 9)
    assert locked == [False]
    assert [n for (n,) in ledger.rows("select name from layer")] == ["a"]
    ledger.close()


def test_a_full_disk_is_507_for_every_request_that_writes(tmp_path, monkeypatch):
    from skyquilt.live.ledger import Ledger

    with served(tmp_path / "out", QUICK) as site:

        def full(*_, **__):
            raise OutputError("the disk is full")

        monkeypatch.setattr(Ledger, "put_meta", full)
        monkeypatch.setattr(Ledger, "tell", full)
        assert site.web.post("/finish").status_code == 507
        monkeypatch.undo()
        assert site.web.post("/finish").status_code == 200


@pytest.mark.slow
def test_the_viewer_ends_with_its_parent_and_the_port_is_free_at_once(tmp_path):
    (tmp_path / "in").mkdir()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "skyquilt", "live", str(tmp_path / "in"), "-o"]
    command += [str(tmp_path / "out"), "--port", str(port)]
    root = Path(__file__).resolve().parents[2]
    env = {**os.environ, "PYTHONPATH": str(root / "src")}
    for _ in range(3):
        with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) as running:
            assert running.stdout.readline().startswith("http://127.0.0.1")
            assert httpx.get(f"http://127.0.0.1:{port}/info", verify=False).status_code == 200
            running.send_signal(signal.SIGKILL)
            running.wait()
    for _ in range(50):
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
        except ConnectionRefusedError:
            break
        time.sleep(0.1)
    else:
        raise AssertionError("the viewer lives on")


@pytest.mark.slow
def test_absurd_heights_cost_little(tmp_path):
    """A photo of 1 MP from 3 km above a map that began at 5 m."""
    from tests.attacks import xmp

    live = LiveMap(tmp_path / "out", QUICK)
    before = resident_mb()
    for k, height in enumerate((5, 3000, 9500, 2900, 2500)):
        about = {"GpsLatitude": "52.1", "GpsLongitude": f"13.{k}", "RelativeAltitude": str(height)}
        path = tmp_path / f"{k}.jpg"
        path.write_bytes(jpeg(1000, 1000, xmp(**about)) + bytes([k]))
        live.add(path)
    assert resident_mb() - before < 400
    assert live.ledger.counts().get("refused", 0) == 0
    live.close()
    shutil.rmtree(tmp_path / "out")


@pytest.mark.slow
def test_many_of_the_largest_images_at_once(site):
    """Two are drawn at a time, and their memory is given back; too large ones cost nothing."""
    many = 16
    side = int(MOST_PIXELS**0.5)
    query = f"{MAP}&BBOX={box(site)}&LAYERS=mosaic&WIDTH={side}&HEIGHT={side}&TRANSPARENT=TRUE"
    began = time.process_time()
    assert site.get(query).status_code == 200
    alone = time.process_time() - began
    before, most, said, done = resident_mb(), [0.0], [], threading.Event()

    def watch():
        while not done.wait(0.02):
            most[0] = max(most[0], resident_mb())

    def ask():
        with httpx.stream(
            "GET", f"{site.base_url}{query[1:]}", timeout=300, verify=False
        ) as answer:
            said.append(answer.status_code)
            for _ in answer.iter_raw(65536):  # not kept by the client
                pass

    watching = threading.Thread(target=watch)
    watching.start()
    threads, began = [threading.Thread(target=ask) for _ in range(many)], time.process_time()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    spent = time.process_time() - began
    done.set()
    watching.join()
    assert said == [200] * many
    # of the clients here too; noise is the worst that PNG can meet, a map takes two thirds of it
    assert spent / many < 1.5 * alone
    assert most[0] - before < 2 * 200 + many * 13
    time.sleep(1.0)
    assert resident_mb() - before < 150
    began = time.process_time()
    large = query.replace(f"={side}", "=4096")
    assert [site.get(large).status_code for _ in range(40)] == [400] * 40
    assert time.process_time() - began < 2


@pytest.mark.slow
@pytest.mark.parametrize("what", ["mosaic", pytest.param("live", marks=pytest.mark.long)])
def test_a_run_that_takes_too_much_memory_ends_with_a_sentence(flight, tmp_path, what):
    """And the same command with more memory goes on."""
    words = [sys.executable, "-m", "skyquilt", what, str(flight.folder / "photos"), "-o"]
    words += [str(tmp_path / "out"), *(["--port", "0", "--finish"] if what == "live" else [])]
    ended = subprocess.run([*words, "--max-memory", "0.1"], capture_output=True, text=True)
    assert ended.returncode == 1
    assert re.search(
        r"^skyquilt: it needs more memory than it may take \(0\.\d of 0\.1 GB\) and was ended; ",
        ended.stderr,
        re.MULTILINE,
    )
    assert "Traceback" not in ended.stderr
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_viewer_that_takes_too_much_memory_is_started_anew(tmp_path):
    live = LiveMap(tmp_path / "out", QUICK)
    asked = ServerConfig(
        folder=tmp_path / "out", settings=QUICK, guard=Guard(), most_memory=50_000_000
    )
    with ServerProcess(asked=asked) as serving:
        first, until = serving._parts["process"].pid, time.monotonic() + 60
        pids = {first}
        while len(pids) < 3 and time.monotonic() < until:
            pids.add(serving._parts["process"].pid)
            time.sleep(0.02)
        assert len(pids) == 3
        assert live.work() is None  # the mapping goes on
    live.close()
    told = (tmp_path / "out" / "errors.log").read_text()
    assert re.search(r"the viewer took 0\.\d of 0\.1 GB and is restarted", told)
