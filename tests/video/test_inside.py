"""Telemetry that a clip holds itself: against the simulator, FFmpeg, Google's Protocol Buffers, and
the published description of GPMF.
"""

import struct
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from skyquilt.geometry.geoid import geoid_height
from skyquilt.model.clip import Clip
from skyquilt.simulate.clip_tracks import DataTrack, add_track, track_in_clip
from skyquilt.simulate.settings import InClipLayout
from skyquilt.video.dji_frames import dji_fix
from skyquilt.video.gopro import gopro_fixes
from skyquilt.video.inside import track_inside
from skyquilt.video.read import read_clip
from skyquilt.video.timed_data import data_tracks, read_data
from tests.video.clips import filmed, flown, numbered, write_clip
from tests.video.simulated import distances, prepared, times_of

RECORDED = Path(__file__).parent / "recorded" / "subtitles.mp4"
"""16 frames with subtitles, as FFmpeg puts them together."""


@pytest.fixture(scope="module")
def flight():
    """The settings of a flight with a video, and all that happens in it."""
    return prepared()


@pytest.mark.parametrize("layout", get_args(InClipLayout))
def test_every_layout_in_a_clip_is_read_as_it_was_meant(flight, layout, tmp_path):
    settings, world = flight
    video, film = replace(settings.video, layout=layout), world.video
    times = times_of(world)
    path = write_clip(tmp_path / "A.MP4", numbered(8), fps=5.0)
    before = path.read_bytes()
    add_track(path, track_in_clip(film.reports, times, video, settings.weather.moment))
    clip = read_clip(path, name="A.MP4")
    assert isinstance(clip, Clip) and clip.frames == 8 and path.read_bytes() != before
    track = clip.track
    assert track.on_clip and track.file == "A.MP4 (telemetry)"
    off = distances(track, world)
    # four decimals are 11 m, a third of that on average; the others have seven
    assert np.median(off) < (4.0 if layout == "mini2" else 0.02)
    frame = np.round((track.height_time_s - 2) * 5).astype(int)
    high = track.sea_level_m if layout == "gopro" else track.takeoff_m
    told = [r.sea_level if layout == "gopro" else r.takeoff for r in film.reports]
    assert np.abs(high - np.array(told)[frame]).max() < 0.006
    if layout == "mini4":
        gimbal = np.array([film.reports[i].gimbal for i in frame])
        assert np.abs(track.gimbal_deg - gimbal).max() < 0.051
    if layout == "gopro":
        told = settings.weather.moment.replace(tzinfo=UTC)
        assert abs((clip.start - told).total_seconds() + 2.0) < 0.01


def test_subtitles_that_ffmpeg_put_into_a_clip():
    track = track_inside(RECORDED)
    assert track.source == "srt" and track.rows == 8 and track.start == datetime(2024, 5, 1, 10)
    np.testing.assert_allclose(track.time_s, np.arange(8) / 2, atol=1e-9)
    np.testing.assert_allclose(track.latitude_deg, 46.6 + 1e-5 * np.arange(8), atol=1e-12)
    np.testing.assert_allclose(track.takeoff_m, 50 + np.arange(8) / 10)
    assert track.gimbal_deg.tolist() == [[30.0, -88.0, 0.0]] * 8 and track.focal_35mm == 24.0


def test_a_file_beside_a_clip_counts_before_what_is_in_it(tmp_path):
    path = filmed(tmp_path, frames=2)
    rows = [struct.pack(">H", 60) + b"GPS (14.3, 50.1, 15), D 1.00m, H 9.00m, H.S 6.00m/s,        "]
    add_track(path, DataTrack(form=b"tx3g", handler=b"sbtl", samples=[(1.0, r) for r in rows]))
    assert read_clip(path, name="A.MP4").track.latitude_deg[0] == pytest.approx(46.6)
    path.with_suffix(".SRT").unlink()
    inside = read_clip(path, name="A.MP4")
    assert inside.track.latitude_deg.tolist() == [50.1] and inside.track.takeoff_m.tolist() == [9.0]
    path.with_suffix(".SRT").write_text("1\n00:00:00,000 --> 00:00:01,000\nno place\n")
    both = read_clip(path, name="A.MP4")
    assert both.track.latitude_deg.tolist() == [50.1] and "it was not used" in both.notes[0]


def test_a_clip_without_telemetry_has_none(tmp_path):
    path = write_clip(tmp_path / "A.MP4", flown(np.full((4, 2), 500.0)), fps=5.0)
    clip = read_clip(path, name="A.MP4")
    assert clip.track is None and "No positions are in it or beside it." in clip.notes
    text = struct.pack(">H", 5) + b"Hello"
    add_track(path, DataTrack(form=b"tx3g", handler=b"sbtl", samples=[(1.0, text)] * 3))
    assert len(data_tracks(path)) == 1 and track_inside(path) is None


def test_messages_as_google_writes_them():
    """Serialised by Google's `protobuf`: 46.5 and -14.25 in degrees, -12.345 m, 60.123 m above
    take-off, a heading of -123.4, the gimbal at 150 and -90.
    """
    message = bytes.fromhex(
        "1a5a0a0208071a421a1608fbffffffffffffffff0118aef6ffffffffffffff01"
        "22210a140801110000000000404740190000000000802cc010c79fffffffffff"
        "ffff012a050d00db6a4722101a0e08fcf8ffffffffffffff0118dc0b"
    )
    fix = dji_fix(message, 1.5)
    assert (fix.time_s, fix.latitude_deg, fix.longitude_deg) == (1.5, 46.5, -14.25)
    assert (fix.sea_level_m, fix.flight_yaw_deg) == (-12.345, -123.4)
    assert fix.takeoff_m == pytest.approx(60.123) and fix.gimbal_deg == (150.0, -90.0, 0.0)
    assert all(dji_fix(message[:n], 0.0) is None for n in range(len(message)))


def _klv(key, kind, size, body):
    return struct.pack(">4scBH", key, kind, size, len(body) // size) + body + bytes(-len(body) % 4)


def _device(*entries):
    return _klv(b"DEVC", b"\0", 1, _klv(b"STRM", b"\0", 1, b"".join(entries)))


def test_newer_gopros_tell_date_and_fix_of_each_place():
    row = struct.Struct(">7iHH")
    days, seconds = 8902, 36_000_500  # 2024-05-16, 10 h and half a second
    rows = b"".join(
        row.pack(466_000_000 + k, 143_000_000, 530_000, 0, 0, days, seconds + 100 * k, 120, fix)
        for k, fix in enumerate((0, 3, 3, 2))
    )
    scale = struct.pack(">9i", 10**7, 10**7, 1000, 1000, 100, 1, 1000, 100, 1)
    data = _device(
        _klv(b"TYPE", b"c", 1, b"lllllllSS"),
        _klv(b"SCAL", b"l", 4, scale),
        _klv(b"GPS9", b"?", 32, rows),
    )
    found = gopro_fixes([(4.0, 0.4, data)])
    assert [f.time_s for f in found.fixes] == pytest.approx([4.0, 4.1, 4.2, 4.3])
    assert np.isnan(found.fixes[0].latitude_deg)
    assert found.fixes[3].latitude_deg == pytest.approx(46.6000003, abs=1e-12)
    # heights are ellipsoidal where they do not say that they are above the sea
    assert found.fixes[1].sea_level_m == pytest.approx(530 - float(geoid_height(46.6, 14.3)))
    told = datetime(2024, 5, 16, 10, 0, 0, 600_000, UTC)
    assert (told - found.start).total_seconds() == pytest.approx(4.1)


@pytest.mark.parametrize("fix", [0, 2])
def test_older_gopros_tell_one_fix_for_all_places_of_a_second(fix):
    data = _device(
        _klv(b"GPSF", b"L", 4, struct.pack(">I", fix)),
        _klv(b"GPSU", b"c", 16, b"240516100000.500"),
        _klv(b"GPSA", b"F", 4, b"MSLV"),
        _klv(b"SCAL", b"l", 4, struct.pack(">5i", 10**7, 10**7, 1000, 1000, 100)),
        _klv(b"GPS5", b"l", 20, struct.pack(">5i", 466_000_000, 143_000_000, 480_000, 0, 0) * 2),
    )
    found = gopro_fixes([(0.0, 1.0, data), (1.0, 1.0, data[:-7])])
    assert len(found.fixes) == 2 and found.fixes[1].time_s == 0.5
    if fix:
        assert found.fixes[1].sea_level_m == 480 and found.start.second == 0
        assert found.fixes[1].longitude_deg == pytest.approx(14.3)
    else:
        assert np.isnan(found.fixes[1].latitude_deg) and found.start is None


@pytest.mark.parametrize("chunks", [[5], [2, 3], [1, 1, 3], [2, 2, 1]])
@pytest.mark.parametrize("wide", [False, True])
def test_samples_lie_where_the_tables_say(tmp_path, chunks, wide):
    """Written by hand: chunks of several samples with gaps between them."""
    rng = np.random.default_rng(3)
    bodies = [rng.integers(0, 256, n, np.uint8).tobytes() for n in (5, 1, 9, 4, 30)]
    path = write_clip(tmp_path / "A.MP4", numbered(2), fps=5.0)
    add_track(path, DataTrack(form=b"test", handler=b"meta", samples=[(0.5, b) for b in bodies]))
    whole = path.read_bytes()
    places, at, data = [], len(whole) + 8, b""
    for count in chunks:
        data += bytes(7)
        places.append(at + len(data))
        data += b"".join(bodies[:count])
        bodies = bodies[count:] + bodies[:count]
    offsets = struct.pack(f">II{len(places)}{'Q' if wide else 'I'}", 0, len(places), *places)
    offsets = struct.pack(">I4s", 8 + len(offsets), b"co64" if wide else b"stco") + offsets
    runs = b"".join(struct.pack(">III", k + 1, n, 1) for k, n in enumerate(chunks))
    runs = struct.pack(">I4sII", 16 + len(runs), b"stsc", 0, len(chunks)) + runs
    last = whole.rindex(b"moov") - 4
    index, start = whole[last:], whole[last:].rindex(b"stsc") - 4
    end = index.rindex(b"stco") - 4
    long = end + int.from_bytes(index[end : end + 4], "big")
    sizes = index[start + int.from_bytes(index[start : start + 4], "big") : end]
    changed = bytearray(index[:start] + runs + sizes + offsets + index[long:])
    grown = len(changed) - len(index)
    for name in (b"stbl", b"minf", b"mdia", b"trak"):
        box = changed.rindex(name, 0, start + 4) - 4
        size = int.from_bytes(changed[box : box + 4], "big") + grown
        changed[box : box + 4] = size.to_bytes(4, "big")
    changed[:4] = len(changed).to_bytes(4, "big")
    free = whole[last:].replace(b"moov", b"free", 1)
    moved = (
        whole[:last] + free + struct.pack(">I4s", 8 + len(data), b"mdat") + data + bytes(changed)
    )
    path.write_bytes(moved)
    (track,) = (t for t in data_tracks(path) if t.form == "test")
    assert [b for _, b in read_data(path, track, 10**6)] == bodies
    assert track.start_s.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert [b for _, b in read_data(path, track, 16)] == bodies[:3]


def test_tables_of_a_million_samples_of_the_same_bytes_cost_little(tmp_path):
    path = write_clip(tmp_path / "A.MP4", numbered(2), fps=5.0)
    text = struct.pack(">H", 40) + b"GPS (14.3, 50.1, 15), D 1.00m, H 9.00m, "
    add_track(path, DataTrack(form=b"tx3g", handler=b"sbtl", samples=[(1.0, text)] * 2))
    whole = bytearray(path.read_bytes())
    at = whole.rindex(b"stsz")
    whole[at + 8 : at + 16] = struct.pack(">II", len(text), 2**32 - 1)
    for name, place in ((b"stsc", 16), (b"stts", 12)):
        at = whole.rindex(name)
        whole[at + place - 4 : at + place] = struct.pack(">I", 2**32 - 1)
    path.write_bytes(whole)
    (track,) = data_tracks(path)
    assert len(track.offset) <= 1_000_000
    assert sum(len(b) for _, b in read_data(path, track, 10**9)) <= len(whole)
