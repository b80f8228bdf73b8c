"""A clip in a watched folder becomes photos of the live map; its frames keep their metadata."""

import shutil
import time

import numpy as np
import pytest

from skyquilt.engine.clock import result_of
from skyquilt.engine.store import Store
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
from tests.video.clips import flown, write_clip

SRT = (
    "{n}\n00:00:{a:06.3f} --> 00:00:{b:06.3f}\n2024-05-01 10:00:{a:06.3f}\n[focal_len: 24.00]"
    " [latitude: {lat:.6f}] [longitude: 14.300000] [rel_alt: 50.000 abs_alt: 480.000]"
    " [gb_yaw: 30.0 gb_pitch: -88.0 gb_roll: 0.0]\n\n"
)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    folder = tmp_path_factory.mktemp("film")
    places = np.stack([np.full(40, 500.0), 900 - 6.0 * np.arange(40)], axis=1)
    path = write_clip(folder / "A.MP4", flown(places), fps=5.0)
    rows = (SRT.format(n=i + 1, a=i / 5, b=(i + 1) / 5, lat=46.6 + 1e-5 * i) for i in range(40))
    path.with_suffix(".SRT").write_text("".join(rows))
    return path


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
    done, until = [], time.monotonic() + 10
    while not done and time.monotonic() < until:
        done = list(watch.look())
        time.sleep(0.02)
    assert len(done) > 3
    assert all(isinstance(d, Accepted) for d in done)
    assert done[0].name.startswith("A.MP4.0000")
    assert list(watch.look()) == []
    rows = ledger.rows("select name from photo order by id")
    assert len(rows) == len(done)
