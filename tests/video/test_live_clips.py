"""A clip in a watched folder becomes photos of the live map; its frames keep their metadata."""

import json
import re
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from skyquilt.engine.clock import result_of
from skyquilt.engine.store import Store
from skyquilt.live import clip_intake, folder_watch
from skyquilt.live.folder_watch import Watch
from skyquilt.live.inbox import Inbox
from skyquilt.live.ledger import Ledger
from skyquilt.live.photo_intake import Accepted, Intake
from skyquilt.live.settings import LiveSettings
from skyquilt.photos.frame_files import frame_jpeg
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import read_photo
from skyquilt.settings import InputSettings
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.clip_frames import with_frames
from skyquilt.workflows.survey_input import read_input
from tests.video.clips import filmed, flown, write_clip


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return filmed(tmp_path_factory.mktemp("film"))


def test_a_written_frame_reads_as_the_photo_it_was(film, tmp_path):
    settings = InputSettings()
    given = result_of(
        with_frames(read_input(film, settings), settings, Store(folder=tmp_path, registry=REGISTRY))
    )
    photo = given.survey.photos[2]
    path = tmp_path / "frame.jpg"
    path.write_bytes(frame_jpeg(photo, read_color(photo)))
    read = read_photo(path)
    assert abs(read.position.latitude_deg - photo.position.latitude_deg) < 1e-8
    assert abs(read.position.longitude_deg - photo.position.longitude_deg) < 1e-8
    assert read.position.takeoff_m == 50.0
    assert read.position.sigma_xy_m == pytest.approx(photo.position.sigma_xy_m, abs=0.01)
    assert abs((read.time - photo.time).total_seconds()) < 0.002
    assert read.attitude.yaw_deg == pytest.approx(photo.attitude.yaw_deg, abs=0.02)
    assert read.attitude.pitch_deg == pytest.approx(2.0, abs=0.02)
    assert read.focal.px == pytest.approx(photo.focal.px, rel=0.03)
    assert np.abs(read_color(read).astype(int) - read_color(photo)).mean() < 2


def test_a_watched_folder_takes_the_frames_of_a_finished_clip(film, tmp_path):
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    out.mkdir()
    ledger = Ledger(out, write=True)
    watch = Watch(
        folder=folder, intake=Intake(ledger, Inbox(ledger, out / "photos"), LiveSettings())
    )
    data = film.read_bytes()
    (folder / "A.MP4").write_bytes(data[: len(data) // 2])  # still being copied
    assert list(watch.look()) == []
    (folder / "A.MP4").write_bytes(data)
    shutil.copy(film.with_suffix(".SRT"), folder)
    done, until = [], time.monotonic() + 60
    while (not done or watch.growing) and time.monotonic() < until:
        done += watch.look()
        time.sleep(0.02)
    assert len(done) > 3
    assert all(isinstance(d, Accepted) for d in done)
    assert done[0].name.startswith("A.MP4.0000")
    assert list(watch.look()) == []
    rows = ledger.rows("select name from photo order by id")
    assert len(rows) == len(done)
    if sys.platform == "linux":  # who sent the clip may remove it, on Windows too
        handles = [h for h in Path("/proc/self/fd").iterdir() if h.exists()]
        assert not any(h.samefile(folder / "A.MP4") for h in handles)


def test_what_is_told_of_a_clip_is_told_to_viewers_once(film, tmp_path):
    """Telemetry that begins 60 s after its clip, and lasts as long, begins with it."""
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    out.mkdir()
    clip = Path(shutil.copy(film, folder / "A.MP4"))
    rows = film.with_suffix(".SRT").read_text()
    late = re.sub(r"00:00:(\d\d[,.]\d+)", r"00:01:\1", rows)
    clip.with_suffix(".SRT").write_text(late)
    ledger = Ledger(out, write=True)
    intake = Intake(ledger, Inbox(ledger, out / "photos"), LiveSettings())
    for again in (False, True):  # as after a restart
        done = [d for d in clip_intake.take_clip(intake, clip, "drone") if d is not None]
        assert all(isinstance(d, Accepted) and d.duplicate == again for d in done)
    told = [json.loads(body)["text"] for _, kind, body in ledger.told(0) if kind == "note"]
    assert sum("taken to begin with the clip" in t for t in told) == 1
    assert sum(f"A.MP4: {len(done)} frames of" in t for t in told) == 1
    ledger.close()


@pytest.mark.slow
def test_photos_are_taken_while_a_clip_is_looked_through(film, tmp_path, monkeypatch):
    """However long a clip is, a look at the folder takes a short time only."""
    monkeypatch.setattr(folder_watch, "PATIENCE_S", 0.1)
    monkeypatch.setattr(clip_intake, "SLICE_S", 0.02)
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    out.mkdir()
    places = np.stack([np.full(200, 500.0), 1800 - 2.5 * np.arange(200)], axis=1)
    write_clip(folder / "LONG.MP4", flown(places, size=(480, 360)), fps=5.0)
    ledger = Ledger(out, write=True)
    watch = Watch(
        folder=folder, intake=Intake(ledger, Inbox(ledger, out / "photos"), LiveSettings())
    )
    time.sleep(0.2)  # the patience with its positions is over
    assert list(watch.look()) == []
    frame = result_of(
        with_frames(
            read_input(film, InputSettings()),
            InputSettings(),
            Store(folder=tmp_path / "x", registry=REGISTRY),
        )
    ).survey.photos[0]
    (folder / "photo.jpg").write_bytes(frame_jpeg(frame, read_color(frame)))
    order, began = [], time.monotonic()
    while "LONG.MP4" in "".join(map(str, watch.growing)) and time.monotonic() - began < 60:
        order += [d.name for d in watch.look()]
        time.sleep(0.01)
    assert order[0] == "photo.jpg"
    assert len([n for n in order if n.startswith("LONG.MP4.")]) > 5


def test_a_clip_that_fails_in_an_unforeseen_way_is_refused_alone(film, tmp_path, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("unforeseen")

    out = tmp_path / "out"
    out.mkdir()
    ledger = Ledger(out, write=True)
    intake = Intake(ledger, Inbox(ledger, out / "photos"), LiveSettings())
    monkeypatch.setattr(clip_intake, "with_frames", broken)
    done = [d for d in clip_intake.take_clip(intake, film, "here") if d is not None]
    assert [d.name for d in done] == ["A.MP4"]
    assert "ZeroDivisionError" in done[0].reason
    assert "unforeseen" in (out / "errors.log").read_text()
