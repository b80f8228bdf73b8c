"""Plans have the overlap asked for; what is reported has the errors asked for."""

import math
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
from pyproj import Transformer

from skyquilt.errors import UsageError
from skyquilt.simulate import prepare, preset
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.flight import fly, plan
from skyquilt.simulate.reported import Start, place_at, report_all
from skyquilt.simulate.settings import FlightSettings, Reporting, Route, Thermal, Video
from skyquilt.simulate.strip import StripSettings

LENS = Lens()
START = Start(base=440.0, takeoff=1.5)


def shots(route: Route):
    return fly(plan(route, LENS), route, START.takeoff, 1, "SIM")


def places(points):
    return np.array([[p.x, p.y] for p in points])


def test_overlaps_of_a_block():
    points = plan(Route(photos=40, overlap=0.75, sidelap=0.60), LENS)
    along = 60 * LENS.height / LENS.focal
    across = 60 * LENS.width / LENS.focal
    first = [p for p in points if p.line == 0]
    step = np.hypot(*np.diff(places(first), axis=0).T)
    assert len(points) == 40
    assert np.allclose(1 - step / along, 0.75)
    normal = np.array([np.cos(np.radians(20)), -np.sin(np.radians(20))])
    offsets = np.unique(np.round(places(points) @ normal, 6))
    assert np.allclose(1 - np.diff(offsets) / across, 0.60)
    assert {round(p.heading) for p in points} == {20, -160}


def test_strip_and_site():
    strip = plan(Route(pattern="strip", photos=20), LENS)
    assert len(strip) == 20
    assert len({p.heading for p in strip}) == 1
    block = plan(Route(site=(100.0, 80.0)), LENS)
    assert np.ptp(places(block) @ [np.sin(np.radians(20)), np.cos(np.radians(20))]) >= 100


def test_round_trip_closes_and_gaps_have_twenty_percent():
    route = Route(pattern="roundtrip", photos=40, overlap=0.60, lost=3, jitter=0.0)
    points = places(plan(route, LENS))
    step = 0.4 * 60 * LENS.height / LENS.focal
    assert np.isclose(np.hypot(*(points[-1] - points[0])), step)
    flown = shots(route)
    numbers = [int(s.name[-4:]) for s in flown]
    assert len(flown) == 37
    assert max(np.diff(numbers)) == 2
    assert {1, 40} <= set(numbers)


def test_drones_fly_at_once():
    points = plan(Route(photos=48, drones=3), LENS)
    assert [p.drone for p in points[:6]] == [0, 1, 2, 0, 1, 2]
    assert np.all(np.diff([p.time for p in points]) >= 0)


@pytest.mark.parametrize("correlation", [60.0, pytest.param(0.0, marks=pytest.mark.slow)])
def test_position_noise(correlation):
    flown = shots(Route(photos=900))
    place = place_at(46.6, 14.3)
    reports = report_all(
        flown, Reporting(gps_noise=2.0, gps_correlation=correlation), place, START, LENS, 7
    )
    to = Transformer.from_crs("EPSG:4326", place.crs, always_xy=True)
    east, north = to.transform([r.longitude for r in reports], [r.latitude for r in reports])
    true = np.array([s.centre for s in flown])
    errors = np.column_stack([east, north]) - [place.easting, place.northing] - true[:, :2]
    assert np.allclose(errors.std(axis=0), 2.0, rtol=0.35 if correlation else 0.1)
    neighbours = np.mean(errors[1:] * errors[:-1]) / 4
    assert (neighbours > 0.7) if correlation else (abs(neighbours) < 0.12)
    heights = np.array([r.sea_level for r in reports]) - 440 - true[:, 2]
    assert abs(heights.std() - 3.0) < (1.2 if correlation else 0.3)
    assert (
        abs(np.std([r.takeoff - z + 1.5 for r, z in zip(reports, true[:, 2], strict=True)]) - 0.3)
        < 0.05
    )


def sight(yaw, pitch):
    """The direction in which a gimbal of these angles in degrees looks."""
    y, p = np.radians([yaw, pitch])
    return np.array([np.cos(p) * np.sin(y), np.cos(p) * np.cos(y), np.sin(p)])


def test_lies():
    flown = shots(Route(photos=40))
    place = place_at(46.6, 14.3)
    noise = Reporting(angle_noise=0.0)
    honest = report_all(flown, noise, place, START, LENS, 7)
    lying = report_all(flown, replace(noise, yaw_lie="tag"), place, START, LENS, 7)
    turned = report_all(flown, replace(noise, yaw_lie="turned"), place, START, LENS, 7)
    liars = [r for r in lying if "yaw" in r.lies]
    assert len(liars) == 10 == sum(r.turned for r in turned)
    for a, b, c in zip(honest, lying, turned, strict=True):
        assert a.flight_yaw == c.flight_yaw
        apart = abs((a.flight_yaw - b.flight_yaw + 180) % 360 - 180)
        assert apart == pytest.approx(180 if b.lies else 0, abs=0.02)
    drift = report_all(flown, replace(noise, altitude_drift=100.0), place, START, LENS, 7)
    assert drift[-1].sea_level - honest[-1].sea_level == pytest.approx(100, abs=0.01)
    assert drift[0].lies == ("altitude",)
    off = report_all(flown, replace(noise, compass_error=-20.0), place, START, LENS, 7)
    tipped = report_all(flown, replace(noise, gimbal_error=2.5), place, START, LENS, 7)
    for a, b, c in zip(honest, off, tipped, strict=True):
        for before, after in ((a.flight_yaw, b.flight_yaw), (a.gimbal[0], b.gimbal[0])):
            assert (after - before + 180) % 360 - 180 == pytest.approx(-20, abs=0.02)
        assert (b.lies, c.lies) == (("yaw",), ())
        looks = [sight(*r.gimbal[:2]) for r in (a, c)]
        assert np.degrees(np.arccos(looks[0] @ looks[1])) == pytest.approx(2.5, abs=0.05)
    silent = report_all(
        flown, replace(noise, gps_missing=4, focal_missing=True), place, START, LENS, 7
    )
    assert sum(r.latitude is None for r in silent) == 4
    assert silent[0].focal is None


def test_settings_that_do_not_fit():
    with pytest.raises(UsageError, match="overlap"):
        prepare(replace(preset("demo"), route=Route(overlap=1.2)))
    with pytest.raises(UsageError, match="no preset 'x'"):
        preset("x")


def numbers(record, way=()):
    """Where a record, or those in it, hold numbers that are not whole."""
    for known in fields(record):
        value = getattr(record, known.name)
        if is_dataclass(value):
            yield from numbers(value, (*way, known.name))
        elif "float" in str(known.type) and "tuple" not in str(known.type):
            yield (*way, known.name)


def changed(record, way, value):
    first, *rest = way
    return replace(
        record, **{first: changed(getattr(record, first), rest, value) if rest else value}
    )


FULL = replace(FlightSettings(), thermal=Thermal(), video=Video())


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("settings", [FULL, StripSettings()], ids=["flight", "strip"])
def test_every_number_must_be_one(settings, value):
    ways = list(numbers(settings))
    assert len(ways) > 5
    for way in ways:
        with pytest.raises(UsageError, match=f"^{way[-1].replace('_', ' ')} must be a number"):
            changed(settings, way, value).checked()


@pytest.mark.parametrize(
    ("part", "values"),
    [
        ("route", {"height": 1e9}),
        ("route", {"heading": 1e9}),
        ("reporting", {"gps_noise": 1e9}),
        ("reporting", {"gps_noise_z": -1.0}),
        ("reporting", {"altitude_drift": -1e9}),
        ("reporting", {"compass_error": 181.0}),
        ("reporting", {"gimbal_error": -31.0}),
        ("reporting", {"focal_error": 1e9}),
        ("pictures", {"exposure_noise": 1e9}),
    ],
)
def test_absurd_numbers_are_refused(part, values):
    """They had taken the machine, ended in words of Python, or gave photos of nothing."""
    settings = replace(
        FlightSettings(), **{part: replace(getattr(FlightSettings(), part), **values)}
    )
    with pytest.raises(UsageError, match=next(iter(values)).split("_")[0].replace("gps", "GPS")):
        settings.checked()


@pytest.mark.parametrize("settings", [FULL, StripSettings()], ids=["flight", "strip"])
def test_a_seed_is_not_negative(settings):
    with pytest.raises(UsageError, match="seed must not be negative"):
        replace(settings, seed=-1).checked()
