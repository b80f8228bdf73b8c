"""Which photos of two cameras belong together where one is released later, or its clock is off."""

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest

from skyquilt.model.photo import GeoPosition
from skyquilt.thermal.partners import partners
from tests.photos.test_together import NOON
from tests.photos.test_together import photo as taken

SPEED, GAP_S, TURN_S = 6.0, 2.3, 9.0


def track(lines=3, each=9):
    """Times (n,) in s, places (n, 2) and velocities (n, 2) of lines flown there and back."""
    times, places, velocity, now = [], [], [], 0.0
    for line in range(lines):
        way = 1 if line % 2 == 0 else -1
        for k in range(each):
            along = k if way > 0 else each - 1 - k
            times.append(now)
            places.append((30.0 * line, along * SPEED * GAP_S))
            velocity.append((0.0, way * SPEED))
            now += GAP_S
        now += TURN_S
    return np.array(times), np.array(places), np.array(velocity)


def photo(name, seconds, place, camera="a"):
    position = None
    if place is not None:
        north, east = 50 + place[1] / 111194.9, place[0] / (111194.9 * np.cos(np.radians(50)))
        position = GeoPosition(
            latitude_deg=north, longitude_deg=east, altitude_m=60, datum="takeoff"
        )
    return replace(taken(name, float(seconds)), position=position, camera_key=camera)


def flown(delay_s=1.0, clock_s=0.0, scatter_s=0.0, noise_m=1.0, placed=True, lost=(), first=500):
    """The photos of both cameras, and the true pairs; the second one's names tell nothing."""
    times, places, velocity = track()
    rng = np.random.default_rng(3)
    bias = rng.normal(0, 1.0, 2)
    a = [
        photo(f"V{k}.jpg", t, p + rng.normal(0, noise_m, 2))
        for k, (t, p) in enumerate(zip(times, places, strict=True))
    ]
    b, true = [], {}
    for k, (t, p, v) in enumerate(zip(times, places, velocity, strict=True)):
        if k in lost:
            continue
        late = delay_s + scatter_s * rng.normal()
        there = p + late * v + bias + rng.normal(0, noise_m, 2) if placed else None
        true[len(b)] = k
        b.append(photo(f"T{first + len(b)}.tif", t + late + clock_s, there, "b"))
    return a, b, true


@pytest.mark.parametrize(
    ("delay_s", "clock_s", "scatter_s", "noise_m"),
    [(1, 0, 0.1, 1), (2, 0, 0, 0.3), (-1, 0, 0.1, 1), (1, 4000, 0.1, 1), (0, -7200, 0, 1)],
)
def test_a_constant_delay_and_a_clock_that_is_off_tell_the_pairs(
    delay_s, clock_s, scatter_s, noise_m
):
    """Three photos later the intervals are the same: where the drone was tells which is right."""
    a, b, true = flown(delay_s, clock_s, scatter_s, noise_m, lost=(4, 20))
    found = partners(a, b)
    assert found.beside == true and found.by_pattern
    assert found.apart_s == pytest.approx(delay_s + clock_s, abs=0.1)
    assert found.delay_s == pytest.approx(delay_s, abs=0.15)


def test_without_positions_the_turns_between_lines_tell_the_pairs():
    a, b, true = flown(0.5, 3600, placed=False)
    found = partners(a, b)
    assert found.beside == true and found.delay_s == 0


def test_one_line_without_positions_and_a_clock_that_is_off_tells_nothing():
    a, b, _ = flown(0, 3600, placed=False)
    assert partners(a[:9], b[:9]).beside == {}


def test_other_flights_are_no_partners():
    """Elsewhere; on the same lines with another rhythm; and with the same one by chance, as far as
    times tell: by some tenths of a second from photo to photo.
    """
    a, b, _ = flown(0, 3600)
    rng = np.random.default_rng(4)
    moved = GeoPosition(latitude_deg=50.001, longitude_deg=0, altitude_m=60, datum="takeoff")
    assert partners(a, [replace(p, position=moved) for p in b]).beside == {}
    slower = [
        replace(p, time=NOON + timedelta(seconds=3600) + 1.17 * (q.time - NOON))
        for p, q in zip(b, a, strict=True)
    ]
    assert len(partners(a, slower).beside) == 0
    unsteady = [replace(p, time=p.time + timedelta(seconds=rng.normal(0, 0.5))) for p in b]
    assert partners(a, unsteady).beside == {}


def test_photos_that_names_and_times_pair_stay_so():
    a, b, true = flown(0.2, noise_m=0.3, first=0)
    found = partners(a, b)
    assert found.beside == true and not found.by_pattern and found.delay_s == 0
