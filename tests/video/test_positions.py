"""Timed positions and clocks, against flights whose truth is known."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from skyquilt.errors import SideFileError
from skyquilt.geometry.frames import METRES_PER_DEGREE
from skyquilt.model.clip import Looks
from skyquilt.video.clock import OffsetSearch
from skyquilt.video.fixes import Fix, track_of
from skyquilt.video.positions import places_at, position_at
from skyquilt.video.read import read_clip
from skyquilt.video.tracks import read_track
from skyquilt.workflows.clip_frames import FrameMethods, timed
from tests.video.clips import filmed

LAT, LON = 46.6, 14.3
SHRINK = np.cos(np.radians(LAT))


def flight(t):
    """East for 25 s at 5 m/s, a half circle of 10 s, and back: places (n, 2) in m, headings."""
    t = np.asarray(t, float)
    radius = 50 / np.pi
    a = np.clip((t - 25) / 10, 0, 1) * np.pi
    x = 5 * np.minimum(t, 25) + radius * np.sin(a) - 5 * np.maximum(t - 35, 0)
    y = radius * (1 - np.cos(a))
    return np.stack([x, y], axis=1), np.pi / 2 - a


def looks_of(times, *, drift=0.0):
    """What a camera 50 m above, of 1000 px per 50 m, sees of it; `drift` of the heading, rad/s."""
    at, heading = flight(times)
    z = at @ [1, 1j]
    top = np.exp(1j * (np.pi / 2 - heading + drift * np.asarray(times)))
    rel = (z[1:] - z[:-1]) / (top[:-1] / 1j) * 20
    return Looks(
        time_s=np.asarray(times, float),
        sharp=np.zeros(len(times)),
        turn=np.concatenate([[1], (top[1:] / top[:-1]).conj()]),
        shift=np.concatenate([[0], rel.conj()]),
        linked=np.arange(len(times)) > 0,
    )


def track(t, *, shift=0.0, step=1e-6, noise=0.0, rows=5.0, seed=0, each=0.4):
    """Fixes every `each` s, in `rows` rows a second of which most repeat the fix before."""
    t = np.arange(t[0], t[1], 1 / rows)
    fixed = np.floor(t / each + 1e-6) * each
    at, _ = flight(fixed)
    rng = np.random.default_rng(seed)
    blown = {f: rng.normal(0, noise, 2) for f in np.unique(fixed)}
    at = at + np.array([blown[f] for f in fixed])
    degrees = np.round(np.array([LAT, LON]) + at[:, ::-1] / METRES_PER_DEGREE / [1, SHRINK], 9)
    fixes = [
        Fix(time_s=a + shift, latitude_deg=la, longitude_deg=lo, takeoff_m=50.0)
        for a, (la, lo) in zip(t, np.round(degrees / step) * step, strict=True)
    ]
    return track_of(fixes, file="a.srt", source="srt", on_clip=True, step_deg=step)


def errors(found, times):
    true, _ = flight(times)
    x = (found.longitude_deg - LON) * METRES_PER_DEGREE * SHRINK
    y = (found.latitude_deg - LAT) * METRES_PER_DEGREE
    return np.stack([x, y], axis=1) - true


def test_repeated_fixes_are_not_measurements():
    told, times = track((0, 60)), np.arange(0, 59, 0.1)
    assert (told.rows, len(told.time_s), told.repeats) == (300, 150, 150)
    off = np.linalg.norm(errors(places_at(told, times), times), axis=1)
    # held fixes would be up to 2 m behind
    assert off.max() < 0.2


def test_the_deviation_grows_between_fixes_and_ends_with_the_track():
    told = track((0, 60), each=4.0)
    found = places_at(told, np.array([8.0, 10.0, 62.5]))
    assert found.sigma_m[0] == pytest.approx(1.5, abs=0.1)
    # constant acceleration of 1.5 m/s2 over 4 s: 0.5 a 2 s 2 s in the middle
    assert found.sigma_m[1] == pytest.approx(np.hypot(1.5, 3.0), abs=0.1)
    assert np.isnan(found.latitude_deg[2])
    assert position_at(told, found, 2, 62.5) is None
    place = position_at(told, found, 1, 10.0)
    assert place is not None
    assert (place.datum, place.altitude_m) == ("takeoff", 50.0)


def test_coordinates_rounded_to_metres():
    told, times = track((0, 60), step=1e-4, each=0.2), np.arange(5, 24, 0.1)
    off = errors(places_at(told, times), times)[:, 0]
    step = 1e-4 * METRES_PER_DEGREE * SHRINK
    assert np.abs(off).max() < 0.2 * step
    assert places_at(told, times).sigma_m.min() > 3


@pytest.mark.parametrize("shift", [0.0, 7.0, -7.0, 31.4])
@pytest.mark.parametrize("seed", [1, 2])
def test_an_offset_is_found_where_the_flight_turns(shift, seed):
    times = np.arange(0, 60, 0.2)
    found = OffsetSearch()(
        looks_of(times, drift=1e-4), track((0, 60), shift=shift, noise=0.7, seed=seed), 0.0, 60.0
    )
    assert found is not None
    assert found.clear
    assert found.seconds == pytest.approx(shift, abs=0.2)
    assert abs(found.seconds - shift) < 3 * found.sigma_s


@pytest.mark.slow
def test_a_clip_that_begins_after_its_positions_end_is_found_in_them(tmp_path):
    """Positions two minutes late: further off than clocks usually are."""
    times = np.arange(0, 60, 0.2)
    late = track((0, 60), shift=120.0, noise=0.7)
    clip = replace(read_clip(filmed(tmp_path, 2), name="A.MP4"), track=late)
    seen, methods = looks_of(times, drift=1e-4), FrameMethods()
    chosen, used, said = timed(clip, seen, methods.choose(clip, seen), methods, None)
    assert used
    assert chosen.offset_s == pytest.approx(120.0, abs=0.2)
    assert "+120" in said[0] or "+119" in said[0]


def test_a_straight_flight_does_not_tell_the_offset():
    times = np.arange(0, 24, 0.2)
    found = OffsetSearch()(looks_of(times), track((0, 24), shift=3.0, noise=0.7), 0.0, 60.0)
    assert found is None or not found.clear


def test_positions_of_another_flight_do_not_fit():
    times = np.arange(0, 60, 0.2)
    true, _ = flight(times)
    other = [  # turns the other way, twice
        Fix(
            time_s=t,
            latitude_deg=LAT + 60 * np.cos(t / 7) / METRES_PER_DEGREE,
            longitude_deg=LON - 60 * np.sin(t / 7) / METRES_PER_DEGREE / SHRINK,
        )
        for t in times
    ]
    strange = track_of(other, file="b.srt", source="srt", on_clip=True, step_deg=1e-9)
    found = OffsetSearch()(looks_of(times), strange, 0.0, 60.0)
    assert found is not None
    assert not found.clear
    assert found.misfit > 0.35
    assert found.speed_ms > 3


def test_gpx_and_logs_are_read(tmp_path):
    start = datetime(2024, 5, 1, 8, 0, tzinfo=UTC)
    gpx = tmp_path / "a.gpx"
    points = "".join(
        f'<trkpt lat="46.{6000 + i}" lon="14.3{i:03d}"><ele>{500 + i}</ele>'
        f"<time>2024-05-01T08:00:{i:02d}Z</time></trkpt>"
        for i in range(20)
    )
    head = '<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
    gpx.write_text(head + points + "</trkseg></trk></gpx>")
    told = read_track(gpx)
    assert (told.on_clip, len(told.time_s)) == (False, 20)
    assert told.time_s[3] == start.timestamp() + 3
    assert (told.latitude_deg[3], told.sea_level_m[3]) == (46.6003, 503)
    gpx.write_text(head + points[:-70])  # torn
    assert len(read_track(gpx).time_s) in (18, 19)
    gpx.write_text("<gpx></gpx>")
    with pytest.raises(SideFileError, match="no track points with times"):
        read_track(gpx)
    log = tmp_path / "b.csv"
    log.write_text(
        "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet)\n"
        + "".join(f"{100 * i},2024-05-01 08:00:00,46.{6000 + i},14.3,{100 + i}\n" for i in range(9))
    )
    told = read_track(log)
    assert told.on_clip
    assert told.time_s[2] == pytest.approx(0.2)
    assert told.takeoff_m[0] == pytest.approx(30.48)
    log.write_text("time,latitude\n1,2\n")
    with pytest.raises(SideFileError, match="expected columns time, latitude and longitude"):
        read_track(log)


@pytest.mark.parametrize("between", [";", "\t"])
def test_logs_with_decimal_commas_say_the_same(tmp_path, between):
    rows = [("time", "latitude", "longitude", "altitude", "heading")]
    rows += [
        (f"2024-05-01T08:00:{i:02d}.{i}Z", f"46.6{i}01", f"14.3{i}02", f"50{i}.5", f"{i}.25")
        for i in range(9)
    ]
    log, other = tmp_path / "points.csv", tmp_path / "commas.csv"
    log.write_text("\n".join(",".join(r) for r in rows))
    other.write_text("\n".join(between.join(r).replace(".", ",") for r in rows))
    told, same = read_track(log), read_track(other)
    assert told.latitude_deg[3] == 46.6301 and told.sea_level_m[3] == 503.5
    assert told.digest == same.digest
