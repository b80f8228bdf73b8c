"""When the flight has ended: the final map beside the live one, and the viewer on both."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from skyquilt.errors import NoPhotosError, UsageError
from skyquilt.live import workflow
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.live.workflow import iter_live
from skyquilt.model.event import Note, Result
from skyquilt.raster.map_source import mercator
from skyquilt.server.access import Guard
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import open_survey
from tests.interrupts import hears_interrupts
from tests.live.conftest import served
from tests.live.test_http import middle, tile_of

QUICK = LiveSettings(features=600)
ENV = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}


def command(*words):
    return [sys.executable, "-m", "skyquilt", *map(str, words)]


def test_the_final_map_takes_every_photo_that_was_taken(flight, tmp_path, monkeypatch):
    """Larger than `mosaic` takes by default, where --max-mp was raised."""
    from skyquilt.live import final_map

    seen = []
    monkeypatch.setattr(
        final_map, "iter_bands", lambda _, __, asked, **___: seen.append(asked) or ()
    )
    settings = LiveSettings(most_mp=500.0)
    live = LiveMap(tmp_path / "out", settings)
    live.intake.take_file(flight.photos[0], "drone")
    live.close()
    list(final_map.iter_finish(tmp_path / "out", settings))
    assert seen[0].input.max_mp == 500.0


def told_of_finishing(live, stop):
    """What a map says of its final map until `stop`, and the last state of that."""
    for _ in iter_live([], live, stop=stop):
        pass
    told = live.ledger.told(0)
    states = [json.loads(body)["state"] for _, kind, body in told if kind == "finish"]
    state = live.ledger.meta("finish")
    live.close()
    return states, state


def test_a_final_map_that_was_interrupted_can_be_asked_for_again(tmp_path, monkeypatch):
    """The page had said for ever that it is being made, and its button could not be pressed."""
    live, stop = LiveMap(tmp_path, QUICK), threading.Event()
    live.ledger.put_meta("finish", "asked")
    monkeypatch.setattr(workflow, "iter_finish", lambda *_: iter([Note(text="begun")]))
    assert next(iter_live([], live, stop=stop)) == Note(text="begun")
    live.close()  # the process was killed
    monkeypatch.setattr(LiveMap, "work", lambda _: stop.set())
    states, state = told_of_finishing(LiveMap(tmp_path, QUICK), stop)
    assert (states, state) == (["running", "failed"], "failed")


@pytest.mark.parametrize("fails", [False, True])
def test_a_final_map_that_is_asked_for_while_one_is_made_is_made_too(tmp_path, monkeypatch, fails):
    live, stop, made = LiveMap(tmp_path, QUICK), threading.Event(), []

    def finishing(*_):
        made.append(live.ledger.meta("finish"))
        if len(made) == 1:
            live.ledger.put_meta("finish", "asked")
        if fails:
            raise NoPhotosError("none")
        yield Result(output=tmp_path, metrics={})

    rounds = iter([None, None, stop.set])
    monkeypatch.setattr(live, "work", lambda: (next(rounds) or bool)() or None)
    live.ledger.put_meta("finish", "asked")
    monkeypatch.setattr(workflow, "iter_finish", finishing)
    end = "failed" if fails else "done"
    assert told_of_finishing(live, stop) == (["running", end, "running", end], end)
    assert made == ["running", "running"]


@pytest.fixture(scope="module")
def finished(flight, tmp_path_factory):
    """`skyquilt live INBOX -o OUT --finish` on six photos: the events it printed, and OUT."""
    home = tmp_path_factory.mktemp("finish")
    (home / "in").mkdir()
    for path in flight.photos:
        shutil.copyfile(path, home / "in" / path.name)
    base = flight.folder / "truth" / "truth_ortho.tif"
    words = (
        "live",
        home / "in",
        "-o",
        home / "out",
        "--finish",
        "--port",
        0,
        "--json",
        "--features",
        600,
    )
    done = subprocess.run(
        command(*words, "--base", base),
        capture_output=True,
        text=True,
        timeout=300,
        env=ENV,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()], home / "out"


@contextmanager
def looked_at(folder, base=None):
    """The viewer on a folder that nobody writes."""
    with (
        ServerThread(
            survey=open_survey(folder, base=base), guard=Guard(token="looking-only"), folder=folder
        ) as site,
        httpx.Client(base_url=site.url, timeout=60, verify=False) as web,
    ):
        yield web


def shown(web, layer, z, x, y):
    answer = web.get(f"/tiles/{z}/{x}/{y}", params={"layer": layer})
    assert answer.status_code == 200
    with Image.open(io.BytesIO(answer.content)) as image:
        return np.asarray(image.convert("RGBA")).astype(float)


def warped(path, z, x, y):
    """The same tile as GDAL's own warper gives it: RGBA (256, 256, 4)."""
    west, south, east, north = mercator(z, x, y)
    transform = rasterio.transform.from_bounds(west, south, east, north, 256, 256)
    options = {"crs": "EPSG:3857", "transform": transform, "width": 256, "height": 256}
    with (
        rasterio.open(path) as raster,
        WarpedVRT(
            raster, resampling=Resampling.bilinear, add_alpha=raster.count == 3, **options
        ) as vrt,
    ):
        return np.dstack([*vrt.read([1, 2, 3]), vrt.dataset_mask()]).astype(float)


def alike(a, b):
    """Correlation of the greens where both show something."""
    both = (a[..., 3] > 0) & (b[..., 3] > 0)
    assert both.mean() > 0.4
    return np.corrcoef(a[both][:, 1], b[both][:, 1])[0, 1]


class Web:
    """A client as `middle` wants it."""

    def __init__(self, web):
        self.web = web


@pytest.mark.slow
def test_finish_ends_with_both_maps(finished, flight):
    events, out = finished
    assert {e["photo"] for e in events if e.get("what") == "placed"} == set(range(1, 7))
    assert events[-1]["event"] == "Result"
    with rasterio.open(out / "finished" / "mosaic.tif") as mosaic:
        assert mosaic.count >= 3
    names = json.loads((out / "finished" / "metrics.json").read_text())
    assert names["photos_used"] == 6
    with looked_at(out) as web:
        info = web.get("/info").json()
        assert [n["name"] for n in info["layers"]][:3] == ["visible", "visible-newest", "finished"]
        assert "finished-heights" in [n["name"] for n in info["layers"]]
        assert info["finish"] == "done"
        assert not info["growing"]
        x, y = tile_of(*middle(Web(web)), 19)
        live, final = (shown(web, layer, 19, x, y) for layer in ("visible", "finished"))
        # two ways to one map of one ground: they agree best where they lie on each other, to half a
        # metre
        shifts = [(dy, dx) for dy in range(-12, 13, 3) for dx in range(-12, 13, 3)]
        fits = [alike(live, np.roll(final, shift, axis=(0, 1))) for shift in shifts]
        assert np.hypot(*shifts[int(np.argmax(fits))]) < 4
        assert max(fits) > 0.8


@pytest.mark.slow
def test_the_viewer_on_a_finished_run(finished, flight):
    out = finished[1] / "finished"
    with looked_at(out) as web:
        info = web.get("/info").json()
        assert [n["name"] for n in info["layers"]][:2] == ["mosaic", "heights"]
        assert not info["growing"]
        photos = web.get("/photos").json()["photos"]
        assert {p["name"] for p in photos} == {p.name for p in flight.photos}
        lon, lat = middle(Web(web))
        over = web.get("/photos", params={"lon": lon, "lat": lat}).json()["photos"]
        assert 1 < len(over) <= 6
        file = web.get(f"/photos/{over[0]['id']}/file").content
        assert file == (flight.folder / "photos" / over[0]["name"]).read_bytes()
        x, y = tile_of(lon, lat, 20)
        seen, true = shown(web, "mosaic", 20, x, y), warped(out / "mosaic.tif", 20, x, y)
        both = (seen[..., 3] > 0) & (true[..., 3] > 0)
        assert both.mean() > 0.9
        assert np.abs(seen[both] - true[both])[:, :3].mean() < 4  # WebP, and another kernel
        assert np.abs(seen[both] - np.roll(true, 3, axis=1)[both])[:, :3].mean() > 6
        assert web.post("/photos", content=b"x").status_code == 405
        assert web.post("/finish").status_code == 405


@pytest.mark.slow
def test_an_older_orthophoto_lies_below(finished, flight, tmp_path):
    truth = flight.folder / "truth" / "truth_ortho.tif"
    with looked_at(finished[1], base=truth) as web:
        assert "base" in [n["name"] for n in web.get("/info").json()["layers"]]
        x, y = tile_of(*middle(Web(web)), 20)
        seen, true = shown(web, "base", 20, x, y), warped(truth, 20, x, y)
        both = (seen[..., 3] > 0) & (true[..., 3] > 0)
        assert both.mean() > 0.9
        assert np.abs(seen[both] - true[both])[:, :3].mean() < 4
    (tmp_path / "no.tif").write_bytes(b"no map")
    with pytest.raises(UsageError, match="--base"):
        open_survey(finished[1], base=tmp_path / "no.tif")


@pytest.mark.slow
def test_view_is_a_command_that_only_looks(finished):
    before = {p: p.stat().st_mtime_ns for p in finished[1].rglob("*.tif")}
    with subprocess.Popen(
        command("view", finished[1], "--port", 0),
        stdout=subprocess.PIPE,
        text=True,
        env=ENV,
        preexec_fn=hears_interrupts,
    ) as process:
        try:
            url = process.stdout.readline().split()[0]
            assert httpx.get(url + "photos", timeout=30, verify=False).json()["photos"]
            assert (
                httpx.post(url + "photos", content=b"x", timeout=30, verify=False).status_code
                == 405
            )
        finally:
            process.send_signal(signal.SIGINT)
    assert process.returncode == 130
    assert before == {p: p.stat().st_mtime_ns for p in finished[1].rglob("*.tif")}
    nothing = subprocess.run(
        command("view", Path(finished[1]) / "photos"),
        capture_output=True,
        text=True,
        env=ENV,
        check=False,
    )
    assert nothing.returncode not in (0, 1)
    assert "neither a live survey" in nothing.stderr


@pytest.mark.slow
def test_the_button_makes_the_final_map_and_mapping_goes_on(flight, tmp_path):
    with served(tmp_path / "out", QUICK) as site:
        for path in flight.photos[:4]:
            site.send(path)
        site.until(lambda: list(site.states().values()) == ["refined"] * 4)
        assert site.web.post("/finish").json() == {"state": "asked"}
        site.until(lambda: site.web.get("/info").json()["finish"] == "done", 120)
        told = [
            json.loads(b)["state"] for _, k, b in site.live.ledger.told(0, 10000) if k == "finish"
        ]
        assert told == ["asked", "running", "done"]
        assert "finished" in [n["name"] for n in site.web.get("/info").json()["layers"]]
        site.send(flight.photos[4])
        site.until(lambda: list(site.states().values()) == ["refined"] * 5)
        # asked again, the new photo takes part; until then the former map is shown
        site.web.post("/finish")
        shown = set()

        def done():
            info = site.web.get("/info").json()
            shown.add("finished" in [n["name"] for n in info["layers"]])
            return info["finish"] == "done"

        site.until(done, 120)
        assert shown == {True}
        assert (
            json.loads((tmp_path / "out" / "finished" / "metrics.json").read_text())["photos_used"]
            == 5
        )
