"""Photos without positions get them from the track of a receiver that flew along."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest

from skyquilt.errors import SideFileError
from skyquilt.geometry.frames import METRES_PER_DEGREE
from skyquilt.photos.side_files import apply_positions
from tests.alignment.surveys import photo

BEGIN = datetime(2024, 7, 15, 8, 30, tzinfo=UTC)
"""Of the flight; 10:30 by a clock of Central Europe's summer."""
LAT, LON, SPEED = 46.6, 14.3, 6.0
GPX = '<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{}</trkseg></trk></gpx>'


def place(seconds):
    """Where the drone is: lines of 60 s to the north and back, 30 m apart; it waits before and
    after the flight of 300 s.
    """
    t = np.clip(seconds, 0, 300)
    line, along = divmod(t, 60)
    north = SPEED * (along if line % 2 == 0 else 60 - along)
    east = 30 * min(line, 4)
    shrunk = METRES_PER_DEGREE * np.cos(np.radians(LAT))
    return LAT + north / METRES_PER_DEGREE, LON + east / shrunk, 500 + t / 100


def track(path, first=-60, last=360, step=1.0):
    """A GPX of the drone, from and to seconds after the flight's begin."""
    points = []
    for seconds in np.arange(first, last + step / 2, step):
        lat, lon, ele = place(seconds)
        moment = (BEGIN + timedelta(seconds=float(seconds))).strftime("%Y-%m-%dT%H:%M:%S.%f")
        points.append(
            f'<trkpt lat="{lat:.8f}" lon="{lon:.8f}"><ele>{ele:.2f}</ele>'
            f"<time>{moment}Z</time></trkpt>"
        )
    path.write_text(GPX.format("".join(points)))
    return path


def photos(zone_h=2.0, error_s=0.0, aware=False, number=20):
    """Photos every 14.3 s, by a clock of a time zone that is fast by some seconds."""
    taken = []
    for k in range(number):
        time = BEGIN + timedelta(seconds=10 + 14.3 * k + error_s)
        local = time.astimezone(timezone(timedelta(hours=zone_h)))
        time = local if aware else local.replace(tzinfo=None)
        taken.append(replace(photo(f"p{k:02d}.jpg"), position=None, time=time))
    return taken


def off_m(placed, error_s=0.0):
    """Distances in m of the photos' positions from the truth."""
    out = []
    for k, one in enumerate(placed):
        lat, lon, _ = place(10 + 14.3 * k + error_s)
        north = (one.position.latitude_deg - lat) * METRES_PER_DEGREE
        shrunk = METRES_PER_DEGREE * np.cos(np.radians(LAT))
        out.append(np.hypot(north, (one.position.longitude_deg - lon) * shrunk))
    return np.array(out)


@pytest.mark.parametrize("zone_h", [-8.0, 0.0, 2.0, 5.75])
def test_the_time_zone_is_found(tmp_path, zone_h):
    placed, notes = apply_positions(photos(zone_h), track(tmp_path / "a.gpx"))
    assert off_m(placed).max() < 3.5  # in its turns the drone is between two fixes
    assert np.median(off_m(placed)) < 0.05
    first = placed[0].position
    assert first.datum == "sea_level" and first.altitude_m == pytest.approx(500.1, abs=0.02)
    assert first.source == "gpx" and 5 < first.sigma_xy_m < 8  # a second of the clock, at 6 m/s
    hours = f"UTC{int(zone_h):+d}" + (":45" if zone_h == 5.75 else "")
    assert f"The camera's clock is taken for {hours}, as a.gpx has it." in notes


def test_a_zone_that_photos_tell_is_believed(tmp_path):
    placed, notes = apply_positions(photos(aware=True), track(tmp_path / "a.gpx"))
    assert np.median(off_m(placed)) < 0.05
    assert not any("clock" in note for note in notes)


def test_an_offset_that_is_told_is_used(tmp_path):
    taken = photos(error_s=95.0)
    placed, notes = apply_positions(taken, track(tmp_path / "a.gpx"), -2 * 3600 - 95.0)
    assert np.median(off_m(placed)) < 0.05
    assert placed[0].position.sigma_xy_m < 2
    assert not any("clock" in note for note in notes)


def test_of_a_long_track_the_zone_of_the_place_is_taken_and_others_are_named(tmp_path):
    """A receiver that was on for the whole day, and was carried about for two hours more."""
    path = track(tmp_path / "a.gpx")
    text = path.read_text()
    walk = []
    for minute in np.arange(-120, 121, 0.1):
        if -2 < minute < 7:
            continue
        moment = (BEGIN + timedelta(minutes=float(minute))).strftime("%Y-%m-%dT%H:%M:%S.%f")
        lat = LAT + 0.01 + 1.5 * 60 * minute / METRES_PER_DEGREE
        walk.append(
            f'<trkpt lat="{lat:.8f}" lon="{LON}"><ele>500</ele><time>{moment}Z</time></trkpt>'
        )
    path.write_text(text.replace("</trkseg>", "".join(walk) + "</trkseg>"))
    placed, notes = apply_positions(photos(2.0), path)
    assert "The camera's clock is taken for UTC+2, as a.gpx has it." == notes[1]
    assert "Photos lie on a.gpx as well with" in notes[2] and "--clock-offset" in notes[2]
    assert np.median(off_m(placed)) < 0.05


def test_photos_beyond_the_track_and_in_its_gaps_keep_none(tmp_path):
    placed, notes = apply_positions(photos(), track(tmp_path / "a.gpx", last=200))
    known = [p.position is not None for p in placed]
    assert known == [10 + 14.3 * k <= 201 for k in range(20)]
    assert any(note.startswith("a.gpx tells no place at the times of p14.jpg") for note in notes)


@pytest.mark.parametrize("offset", [None, 0.0])
def test_another_day_is_refused_with_both_times(tmp_path, offset):
    taken = [replace(p, time=p.time + timedelta(days=3)) for p in photos()]
    with pytest.raises(
        SideFileError, match="2024-07-15 08:29:00 to .* 2024-07-18 10:30:10"
    ) as told:
        apply_positions(taken, track(tmp_path / "a.gpx"), offset)
    assert ("with 0 s added" in str(told.value)) == (offset is not None)


def test_photos_without_times_are_told(tmp_path):
    taken = [replace(p, time=None) for p in photos()]
    with pytest.raises(SideFileError, match="no photo tells when it was taken"):
        apply_positions(taken, track(tmp_path / "a.gpx"))


def test_a_table_with_times_is_a_track_too(tmp_path):
    rows = ["time,latitude,longitude,altitude"]
    for seconds in range(-10, 320):
        lat, lon, ele = place(seconds)
        moment = (BEGIN + timedelta(seconds=seconds)).isoformat()
        rows.append(f"{moment},{lat:.8f},{lon:.8f},{ele:.2f}")
    path = tmp_path / "log.csv"
    path.write_text("\n".join(rows))
    placed, _ = apply_positions(photos(), path)
    assert np.median(off_m(placed)) < 0.05


def test_a_table_with_names_stays_one(tmp_path):
    path = tmp_path / "named.csv"
    path.write_text("name,time,latitude,longitude\np00.jpg,2024-07-15T08:30:10Z,46.7,14.4\n")
    placed, _ = apply_positions(photos(), path)
    assert [p.position is not None for p in placed] == [True] + [False] * 19
