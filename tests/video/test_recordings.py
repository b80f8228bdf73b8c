"""Recordings as cameras make them: several frame rates, files divided into parts, long hovers."""

import time
from itertools import pairwise

import cv2
import numpy as np
import pytest

from skyquilt.engine.clock import result_of
from skyquilt.engine.store import Store
from skyquilt.model.clip import Looks
from skyquilt.settings import InputSettings
from skyquilt.video.choice import FrameChoice
from skyquilt.video.read import read_clip
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.clip_frames import with_frames
from skyquilt.workflows.survey_input import read_input
from tests.video.clips import SIZE, SRT, filmed, flown, write_clip

SPEED = 30.0
"""Motion of the ground in px/s."""


def frames_of(source, store):
    return result_of(with_frames(read_input(source, InputSettings()), InputSettings(), store))


@pytest.mark.slow
@pytest.mark.parametrize("fps", [24.0, 30000 / 1001, 60.0])
def test_the_same_flight_at_any_frame_rate_gives_the_same_frames(tmp_path, fps):
    seconds = 7
    along = np.arange(round(seconds * fps)) / fps * SPEED
    places = np.stack([np.full(len(along), 500.0), 900 - along], axis=1)
    path = write_clip(tmp_path / "A.MP4", flown(places), fps=fps)
    found = frames_of(path, Store(folder=tmp_path / "store", registry=REGISTRY))
    clip = found.clips[0]
    assert clip.fps == pytest.approx(fps, rel=1e-4)
    assert clip.looked == pytest.approx(5 * seconds, rel=0.05)
    at = np.array([p.frame_s for p in found.survey.photos])
    shared = 1 - np.diff(at) * SPEED / SIZE[1]
    assert (shared[:-1] > 0.78 - 0.04).all() and (shared[:-1] < 0.78 + 0.22 * 0.32 + 0.025).all()
    assert len(at) <= 1.2 * (1 + along[-1] / SIZE[1] / 0.22) + 1


@pytest.mark.parametrize("stated", ["its own", "that of the first"])
def test_a_recording_in_parts_is_one_flight(tmp_path, stated):
    """Cameras begin a new file at 4 GB, with telemetry of its own that counts from zero; its start
    is its own, or that of the recording.
    """
    places = np.stack([np.full(80, 500.0), 1100 - 6.0 * np.arange(80)], axis=1)
    frames = list(flown(places))
    for part, name in ((range(40), "DJI_0001"), (range(40, 80), "DJI_0002")):
        write_clip(tmp_path / f"{name}.MP4", [frames[i] for i in part], fps=5.0)
        clock = "10:00:{at:06.3f}\n[" if stated == "its own" else "10:00:{a:06.3f}\n["
        row = SRT.replace("10:00:{a:06.3f}\n[", clock)
        rows = (
            row.format(n=k + 1, a=k / 5, b=(k + 1) / 5, at=i / 5, lat=46.6 + 1e-5 * i)
            for k, i in enumerate(part)
        )
        (tmp_path / f"{name}.SRT").write_text("".join(rows))
    found = frames_of(tmp_path, Store(folder=tmp_path / "store", registry=REGISTRY))
    photos = found.survey.photos
    assert [c.clip for c in found.clips] == ["DJI_0001.MP4", "DJI_0002.MP4"]
    assert [p.name for p in photos] == sorted(p.name for p in photos)
    north = np.array([p.position.latitude_deg for p in photos])
    taken = [round(p.frame_s * 5) + (40 if p.name.startswith("DJI_0002") else 0) for p in photos]
    assert np.abs(north - 46.6 - 1e-5 * np.array(taken)).max() < 2e-6
    gone = np.array([places[a][1] - places[b][1] for a, b in pairwise(taken)])
    assert (gone > 0).all() and gone.max() < 0.3 * SIZE[1]
    assert len({p.camera_key for p in photos}) == 1


@pytest.mark.slow
def test_an_hour_of_hovering_gives_one_frame_and_costs_little(tmp_path):
    """Its wobble comes and goes; nothing new is seen."""
    rng, count = np.random.default_rng(1), 18_000
    wobble = 6 * np.sin(np.arange(count) / 50) + 4 * np.sin(np.arange(count) / 37) * 1j
    wobble = wobble + rng.normal(0, 0.3, count) + 1j * rng.normal(0, 0.3, count)
    away = np.arange(200) * 8.0
    place = np.concatenate([away, away[-1] + wobble, away[-1] + away])
    looks = Looks(
        time_s=np.arange(len(place)) / 5,
        sharp=rng.normal(0, 0.05, len(place)),
        turn=np.ones(len(place), complex),
        shift=np.concatenate([[0], np.diff(place)]),
        linked=np.arange(len(place)) > 0,
    )
    clip = read_clip(filmed(tmp_path, 5), name="A.MP4")
    started = time.process_time()
    chosen = FrameChoice()(clip, looks)
    assert time.process_time() - started < 5
    hovering = [f for f in chosen.chosen if 200 <= f.look < 200 + count]
    assert len(hovering) <= 2
    flown_px = 2 * away[-1]
    assert len(chosen.chosen) <= 1.2 * (1 + flown_px / SIZE[0] / 0.22) + 2


@pytest.mark.parametrize("count", [1, 2, 5])
def test_clips_of_a_moment_have_positions_too(tmp_path, count):
    path = filmed(tmp_path, count)  # a fifth of a second each
    found = frames_of(path, Store(folder=tmp_path / "store", registry=REGISTRY))
    assert len(found.survey.photos) == (2 if count == 5 else 1)
    assert all(p.position is not None for p in found.survey.photos)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ending", "fourcc", "size"),
    [
        ("avi", "XVID", SIZE),
        ("avi", "MJPG", (321, 241)),
        ("mkv", "FFV1", SIZE),
        ("MOV", "mp4v", SIZE),
        ("mts", "mp4v", (322, 242)),
        ("webm", "VP80", SIZE),
    ],
)
def test_containers_codecs_and_odd_sizes_are_chosen_from_alike(tmp_path, ending, fourcc, size):
    """6 px a frame: 78 % of a height of 240 px are reached after eight frames."""
    places = np.stack([np.full(26, 500.0), 900 - 6.0 * np.arange(26)], axis=1)
    path = tmp_path / f"A.{ending}"
    if fourcc == "MJPG":  # FFmpeg's writer makes odd sizes even
        code = cv2.VideoWriter.fourcc(*fourcc)
        writer = cv2.VideoWriter(str(path), cv2.CAP_OPENCV_MJPEG, code, 5.0, size)
        for frame in flown(places, size=size):
            writer.write(frame)
        writer.release()
    else:
        write_clip(path, flown(places, size=size), 5.0, fourcc)
    photos = frames_of(path, Store(folder=tmp_path / "store", registry=REGISTRY)).survey.photos
    taken = [round(5 * p.frame_s) for p in photos]
    assert taken[0] == 0 and taken[-1] >= 24
    assert all(7 <= b - a <= 8 for a, b in pairwise(taken[:-1]))
    assert {(p.width, p.height) for p in photos} == {size}


def test_two_clips_of_a_flight_with_a_gap_lie_where_they_were_filmed(tmp_path):
    places = np.stack([np.full(110, 500.0), 1100 - 6.0 * np.arange(110)], axis=1)
    frames = list(flown(places))
    for part, name in ((range(40), "DJI_0001"), (range(70, 110), "DJI_0002")):
        write_clip(tmp_path / f"{name}.MP4", [frames[i] for i in part], fps=5.0)
        row = SRT.replace("10:00:{a:06.3f}\n[", "10:00:{at:06.3f}\n[")
        rows = (
            row.format(n=k + 1, a=k / 5, b=(k + 1) / 5, at=i / 5, lat=46.6 + 1e-5 * i)
            for k, i in enumerate(part)
        )
        (tmp_path / f"{name}.SRT").write_text("".join(rows))
    photos = frames_of(tmp_path, Store(folder=tmp_path / "store", registry=REGISTRY)).survey.photos
    late = np.array([70 if p.name.startswith("DJI_0002") else 0 for p in photos])
    taken = np.array([round(5 * p.frame_s) for p in photos]) + late
    north = np.array([p.position.latitude_deg for p in photos])
    assert np.abs(north - 46.6 - 1e-5 * taken).max() < 2e-6
    clock = np.array([(p.time - photos[0].time).total_seconds() for p in photos])
    assert np.abs(clock - (taken - taken[0]) / 5).max() < 0.01
