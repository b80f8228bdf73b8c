"""Planned flights in the wind: tilts, ground speeds and headings by hand."""

import json

import numpy as np
import pytest

from skyquilt.errors import UsageError
from skyquilt.simulate.flight import fly
from skyquilt.simulate.planned import planned_flight
from skyquilt.simulate.run import EXPOSURE_S
from skyquilt.simulate.settings import FlightSettings, Route

EAST = 1 / 111_320.0 / np.cos(np.radians(52.0))
NORTH = 1 / 111_320.0
VIEW = {"name": "c", "width": 640, "height": 480, "focal": 600.0, "left": 0.53, "right": 0.53,
        "up": 0.4, "down": 0.4}  # fmt: skip


def plan(tmp_path, count=40, **drone):
    """One line to the north on the meridian of a zone, 20 m from photo to photo."""
    places = [(15.0, 52.0 + 20 * k * NORTH) for k in range(count)]
    start = [15.0, 52.0 - 30 * NORTH]
    record = {
        "skyquilt_plan": 1, "crs": "EPSG:32633", "origin": [500_000, 5_761_000], "heights": "flat",
        "points": [{"id": k + 1, "longitude": x, "latitude": y, "z": 60.0, "ground": 0.0,
                    "yaw_deg": 0.0} for k, (x, y) in enumerate(places)],
        "drones": [{"start": start, "landing": start, "speed_ms": 15.0, "photo_s": 1.5,
                    "turn_radius_m": 0.0, "view": VIEW, **drone}],
        "sorties": [{"drone": 0, "number": 1, "way": [
            [*start, 0, 0, None], *([x, y, 60, 9.0 + 3 * k, k + 1]
                                    for k, (x, y) in enumerate(places)), [*start, 0, 500, None]]}],
    }  # fmt: skip
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(record))
    return path


def shots(path, wind, wind_from):
    settings = FlightSettings(route=Route(wind=wind, wind_from=wind_from, jitter=0.0))
    flight = planned_flight(path, settings, lost=0.0)
    return fly(flight.waypoints, flight.settings.route, 0.0, 1, "SIM")


@pytest.mark.parametrize(
    ("wind_from", "pitch", "roll"), [(270.0, 0.0, -1.0), (90.0, 0.0, 1.0), (0.0, -1.0, 0.0)]
)
def test_a_hovering_drone_leans_into_the_wind(tmp_path, wind_from, pitch, roll):
    """A tenth of the lean that 8 m/s need where 16 need 35 degrees; gusts of 30 % make the mean of
    the square larger by 9 %.
    """
    found = shots(plan(tmp_path), 8.0, wind_from)
    lean = 0.1 * np.degrees(np.arctan(np.tan(np.radians(35)) / 4 * 1.09))
    assert all(s.velocity == (0.0, 0.0, 0.0) for s in found)
    assert np.mean([s.waypoint.pitch for s in found]) == pytest.approx(pitch * lean, abs=0.15)
    assert np.mean([s.waypoint.roll for s in found]) == pytest.approx(roll * lean, abs=0.15)
    assert np.std([np.hypot(s.waypoint.pitch, s.waypoint.roll) for s in found]) > 0.2
    still = shots(plan(tmp_path), 0.0, wind_from)
    assert all(s.waypoint.pitch == s.waypoint.roll == 0 for s in still)


@pytest.mark.parametrize(
    ("wind_from", "pace"), [(0.0, 11.0), (180.0, 19.0), (90.0, np.sqrt(225 - 16))]
)
def test_a_drone_that_flies_on_is_faster_with_the_wind(tmp_path, wind_from, pace):
    found = shots(plan(tmp_path, photo_s=0.0), 4.0, wind_from)
    assert np.allclose([s.velocity for s in found], [0, pace, 0], atol=0.02)
    # nose down at 15 m/s through the air, so that the camera looks behind
    lean = 0.1 * np.degrees(np.arctan(np.tan(np.radians(35)) * 225 / 256))
    assert np.mean([s.waypoint.pitch for s in found]) == pytest.approx(-lean, abs=0.35)
    blur = pace * EXPOSURE_S * 600 / 60
    assert blur == pytest.approx(0.11 * pace / 11, rel=1e-6)


def test_a_fixed_wing_points_into_the_wind(tmp_path):
    found = shots(plan(tmp_path, turn_radius_m=60.0), 4.0, 90.0)
    headings = np.array([s.waypoint.heading for s in found])
    assert np.allclose(headings, np.degrees(np.arcsin(4 / 15)), atol=0.05)
    assert np.allclose([s.velocity[:2] for s in found], [0, np.sqrt(225 - 16)], atol=0.02)


def test_wind_that_the_drone_cannot_fly_in_is_refused(tmp_path):
    with pytest.raises(UsageError, match="makes no way against 16 m/s"):
        shots(plan(tmp_path, photo_s=0.0), 16.0, 0.0)
    with pytest.raises(UsageError, match="cannot fly straight in 16 m/s"):
        shots(plan(tmp_path, photo_s=0.0), 16.0, 90.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda q: q["drones"][0]["view"].update(width=90_000, height=90_000), "90000x90000 px"),
        (lambda q: q["drones"][0]["view"].update(width=10**9), "number from 64 to"),
        (lambda q: q["drones"][0]["view"].update(focal=float("nan")), "it has nan where"),
        (lambda q: q["drones"][0]["view"].update(left=1e308), "number from 0.001 to 10"),
        (lambda q: q["drones"][0].update(speed_ms=-5), "it has -5 where"),
        (lambda q: q["drones"][0].update(turn_radius_m="x"), "could not convert"),
        (lambda q: q["points"][3].update(z=1e7), "it has 1e"),
        (lambda q: q["points"][3].update(ground=float("inf")), "it has inf where"),
        (lambda q: q["sorties"][0]["way"][3].__setitem__(0, 15.9), "pixels; at most"),
        (lambda q: q["sorties"][0]["way"][3].__setitem__(3, -1), "it has -1 where"),
    ],
)
def test_plans_that_would_take_the_machine_are_refused(tmp_path, change, words):
    path = plan(tmp_path)
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))
    with pytest.raises(UsageError, match=words):
        shots(path, 0.0, 0.0)
