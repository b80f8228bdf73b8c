"""Frames of videos that are written as photos (`--write-frames`)."""

from dataclasses import replace

import pytest

from skyquilt.workflows import clip_frames
from skyquilt.workflows.clip_frames import frame_file, write_frames
from tests.engine.test_constants import photo


@pytest.fixture
def written(tmp_path, monkeypatch):
    monkeypatch.setattr(clip_frames, "frame_jpeg", lambda photo, pixels: photo.name.encode())

    def written(*names):
        frames = [replace(photo(), name=name, frame_s=1.0) for name in names]
        list(write_frames(tmp_path, [photo(), *frames], lambda index: None))
        found = (tmp_path / "frames").rglob("*.jpg")
        return {str(p.relative_to(tmp_path / "frames")): p.read_text() for p in found}

    return written


def test_names_of_clips_may_be_as_long_as_a_file_system_takes(written):
    """The run ended after its map: "File name too long"."""
    clips = [f"{'é' * 120}{letter}.MP4" for letter in "ab"]
    names = [f"day 1/{c}.{k:06}" for c in clips for k in (7, 19)]
    found = written(*names)
    assert sorted(found.values()) == sorted(names)
    assert all(name.endswith((".MP4.000007.jpg", ".MP4.000019.jpg")) for name in found)


def test_usual_names_stay():
    assert frame_file(replace(photo(), name="a/FLIGHT.MP4.000123")) == "a/FLIGHT.MP4.000123.jpg"


def test_frames_of_an_earlier_run_do_not_stay_among_those_of_this_one(written, tmp_path):
    written("F.MP4.000001", "F.MP4.000005")
    (tmp_path / "frames" / "mine.jpg").write_text("mine")
    found = written("F.MP4.000001", "F.MP4.000009")
    assert sorted(found) == ["F.MP4.000001.jpg", "F.MP4.000009.jpg", "mine.jpg"]
