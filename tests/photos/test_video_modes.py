"""Lens and shutter of clips: what the tables say, and what gives way to what."""

import csv
import math
import struct
from dataclasses import replace
from importlib.resources import files

import pytest

from skyquilt.model.clip import Clip
from skyquilt.photos.clips import read_clips
from skyquilt.photos.video_modes import find_mode, with_mode
from skyquilt.video.read import read_clip
from tests.video.clips import numbered, write_clip


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = write_clip(tmp_path_factory.mktemp("mode") / "a.mp4", numbered(5), fps=30.0)
    read = read_clip(path, name="a.mp4")
    assert isinstance(read, Clip)
    return read


def of(clip, model, width, height, **more):
    return with_mode(replace(clip, model=model, width=width, height=height, **more))


def test_a_published_mode_wins_and_is_named(clip):
    found = of(clip, "FC7303", 3840, 2160)
    assert found.focal.source == "mode"
    # both calibrations lie within the stated deviation, and the 83 degrees of its photos do not
    assert abs(found.focal.px - 3135) < found.focal.sigma_px
    assert abs(found.focal.px - 3266) < found.focal.sigma_px
    photo = 3840 / 2 / math.tan(math.radians(83 / 2)) * 1.25  # of the diagonal of 3:4
    assert abs(found.focal.px - photo) > 2 * found.focal.sigma_px
    assert any("Gyroflow" in n and "FC7303" in n for n in found.notes)
    assert of(clip, "DJI Mini 2", 3840, 2160).focal.px == found.focal.px
    assert find_mode("FC7303", 1920, 1080) is None


def test_without_a_mode_the_sensor_or_the_telemetry_tells(clip):
    air = of(clip, "FC3411", 1920, 1080)
    assert air.focal.source == "sensor"
    assert air.focal.px == pytest.approx(1920 * 8.38 / 13.2)
    unknown = of(clip, "FC9999", 3840, 2160)
    assert unknown.focal is clip.focal
    assert unknown.shutter is clip.shutter
    assert unknown.notes == clip.notes


def test_a_zoom_lens_scales_its_mode(clip, tmp_path):
    side = tmp_path / "a.srt"
    block = "{0}\n00:00:0{0},000 --> 00:00:0{1},000\n[focal_len: 48.00] [latitude: 4{0}.5]"
    block += " [longitude: 8.123456]\n\n"
    side.write_text("".join(block.format(i, i + 1) for i in range(1, 4)))
    (read,), bad = read_clips([("a.mp4", clip.path)], side)
    assert not bad
    wide, far = (of(c, "FC7303", 3840, 2160).focal for c in (clip, read))
    assert far.px == pytest.approx(2 * wide.px)
    assert far.sigma_px == pytest.approx(2 * wide.sigma_px)


def test_the_readout_of_a_frame_is_that_of_its_rows(clip):
    """27 ms of a photo of 3:4 are 20 ms of a frame of 9:16, and a frame takes no longer than its
    time.
    """
    found = of(clip, "FC3170", 3840, 2160)
    assert found.shutter.source == "table"
    assert found.shutter.readout_s == pytest.approx(0.027 * (9 / 16) / (3 / 4))
    slow = of(clip, "FC200", 1920, 1080, fps=60.0)
    assert slow.shutter.readout_s == pytest.approx(0.9 / 60)


def test_the_container_names_the_model(clip, tmp_path):
    path = tmp_path / "FLIGHT.MP4"
    text = b"\xa9mdl\x00\x06\x15\xc7FC3170\x00"
    path.write_bytes(clip.path.read_bytes() + struct.pack(">I4s", 8 + len(text), b"udta") + text)
    (read,), bad = read_clips([("FLIGHT.MP4", path)], None)
    assert not bad
    assert read.model == "FC3170"
    assert read.focal.source == "sensor"
    assert read.camera_key.startswith("video fc3170")


def test_every_row_has_a_source_and_is_plausible():
    text = files("skyquilt.photos").joinpath("video_modes.csv").read_text("utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    assert len(rows) >= 7
    for row in rows:
        assert len(row["source"]) > 20
        assert 0.4 < float(row["focal_per_width"]) < 1.5
        assert 0.03 < float(row["sigma_per_width"]) / float(row["focal_per_width"]) < 0.25
        # a mode cuts off the photo's view, up to what a calibration of little depth is off
        photo = float(row["equivalent_mm"]) / math.hypot(36, 24) * 1.25
        assert float(row["focal_per_width"]) > 0.85 * photo - float(row["sigma_per_width"])
