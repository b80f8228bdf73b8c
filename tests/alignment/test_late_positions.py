"""Positions of photos before or after are moved to where they belong, and no others are."""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest

from skyquilt.alignment.late_positions import MIRRORED, as_moved, mirrored, on_time, unshifted
from skyquilt.alignment.motion import speeds_of
from tests.alignment.surveys import alignment, photo, prior
from tests.alignment.test_oblique_start import Slanting

LINES = np.array(
    [
        (18.0 * (k if line % 2 == 0 else 5 - k), 25.0 * line, 60.0)
        for line in range(4)
        for k in range(6)
    ]
)
"""Four lines of six photos, there and back."""


def late_by(priors, number):
    """Each photo with the position of that `number` places before it; the rim repeats its own."""
    last = len(priors) - 1
    return [
        replace(p, map_C=priors[min(max(i - number, 0), last)].map_C) for i, p in enumerate(priors)
    ]


def block(centres):
    found = alignment(len(centres))
    return replace(
        found,
        poses={i: replace(found.poses[i], map_C=C) for i, C in enumerate(np.asarray(centres))},
    )


def told_at(places, sigma, seed):
    noise = np.random.default_rng(seed).normal(0, sigma, np.shape(places))
    return [prior(C, sigma=sigma) for C in places + noise]


@pytest.mark.parametrize("late", [1, -1, 3, -5])
@pytest.mark.parametrize("sigma", [1.5, 5.0])
@pytest.mark.parametrize("seed", range(2))
def test_late_positions_are_moved(late, sigma, seed):
    """By however many photos, and whatever is stated of their deviations."""
    true = [replace(p, sigma_C=np.full(3, sigma)) for p in told_at(LINES, 1.5, seed)]
    moved = unshifted(block(LINES), late_by(true, late), ["A"] * len(LINES))
    inside = slice(None, -late) if late > 0 else slice(-late, None)
    for a, b in zip(moved[inside], true[inside], strict=True):
        assert np.array_equal(a.map_C, b.map_C)
    outside = moved[-late:] if late > 0 else moved[:-late]
    assert all(np.isnan(p.map_C).all() for p in outside)


@pytest.mark.parametrize("at", [4, 9, 12])
@pytest.mark.parametrize("seed", range(2))
def test_from_a_missing_line_of_a_list_on_positions_are_moved(at, seed):
    """Up to one photo next to the line belongs to either side."""
    true = told_at(LINES, 1.5, seed)
    right = np.array([p.map_C for p in true])
    lists = ([*true[:at], *true[at + 1 :], true[-1]], [*true[:at], true[at], *true[at:-1]])
    for told in lists:
        moved = unshifted(block(LINES), told, ["A"] * len(LINES))
        off = np.linalg.norm([p.map_C - C for p, C in zip(moved, right, strict=True)], axis=1)
        before = np.linalg.norm([p.map_C - C for p, C in zip(told, right, strict=True)], axis=1)
        assert (before > 10).sum() >= 11
        assert (off > 1e-9).sum() <= 3  # NaN, where none is left, is not


@pytest.mark.parametrize("seed", range(10))
def test_receivers_that_drift_and_flights_displaced_against_each_other_move_nothing(seed):
    rng = np.random.default_rng(seed)
    drift = np.cumsum(rng.normal(0, 1.5, LINES.shape), axis=0)
    parts = np.where(np.arange(len(LINES))[:, None] < 12, [0.0, 0, 0], [18.0, 0, 0])
    last = np.where(np.arange(len(LINES))[:, None] < 18, [0.0, 0, 0], [-18.0, 0, 0])
    for error in (drift, parts, last):
        noise = rng.normal(0, 1.0, LINES.shape)
        priors = [prior(C, sigma=1.5) for C in LINES + error + noise]
        assert unshifted(block(LINES), priors, ["A"] * len(LINES)) is priors


@pytest.mark.parametrize("number", range(1, 14))
def test_few_photos_move_nothing(number):
    """Fewer than the largest shift, and fewer than tell of one."""
    priors = told_at(LINES[:number], 1.5, 1)
    assert unshifted(block(LINES[:number]), priors, ["A"] * number) is priors


@pytest.mark.parametrize("sigma", [0.02, 1.5, 5.0, 15.0])
@pytest.mark.parametrize("seed", range(2))
def test_positions_that_are_right_stay(sigma, seed):
    priors = told_at(LINES, sigma, seed)
    assert unshifted(block(LINES), priors, ["A"] * len(LINES)) is priors
    some = [replace(p, map_C=np.full(3, np.nan)) if i % 3 else p for i, p in enumerate(priors)]
    assert unshifted(block(LINES), some, ["A"] * len(LINES)) is some
    far = [
        replace(p, map_C=p.map_C + (40, 0, 0)) if i % 3 == 0 else p for i, p in enumerate(priors)
    ]
    assert unshifted(block(LINES), far, ["A"] * len(LINES)) is far


@pytest.mark.parametrize("after", [True, False])
@pytest.mark.parametrize("sigma", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(2))
def test_a_hover_beside_a_flight_moves_nothing(after, sigma, seed):
    """Of twelve and thirty photos a map shrunk to nothing explains seven tenths, however moved."""
    flight, rng = LINES[:12], np.random.default_rng(seed)
    hover = flight[6] + rng.normal(0, 0.01, (30, 3))
    placed = np.concatenate([flight, hover] if after else [hover, flight])
    told = flight + rng.normal(0, 1.5, flight.shape)
    still = flight[6] + rng.normal(0, 1.5, 3) + rng.normal(0, sigma, (30, 3))
    told = np.concatenate([told, still] if after else [still, told])
    priors = [prior(C, sigma=1.5) for C in told]
    assert unshifted(block(placed), priors, ["A"] * len(placed)) is priors


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_noise_that_is_not_told_and_positions_in_any_order_move_nothing(seed):
    rng = np.random.default_rng(seed)
    for noise in (3.0, 8.0, 15.0):
        priors = [prior(C, sigma=1.0) for C in LINES + rng.normal(0, noise, LINES.shape)]
        assert unshifted(block(LINES), priors, ["A"] * len(LINES)) is priors
    mixed = [prior(LINES[i], sigma=1.0) for i in rng.permutation(len(LINES))]
    assert unshifted(block(LINES), mixed, ["A"] * len(LINES)) is mixed


def test_a_straight_line_tells_nothing():
    line = np.array([(20.0 * k, 0, 60.0) for k in range(12)])
    priors = late_by(told_at(line, 1.0, 1), 1)
    assert unshifted(block(line), priors, ["A"] * len(line)) is priors


@pytest.mark.parametrize("turn", [0, 18, 90])
def test_a_circle_tells_nothing(turn):
    """Moved by a photo, the positions of an orbit are those of an orbit that is turned."""
    b = np.radians(np.arange(20) * 18.0)
    around = np.column_stack([47 * np.sin(b), 47 * np.cos(b), np.full(20, 40.0)])
    found = np.column_stack(
        [*(47 * f(b + np.radians(turn)) for f in (np.sin, np.cos)), around[:, 2]]
    )
    for seed in range(4):
        priors = told_at(around, 1.5, seed)
        assert unshifted(block(found), priors, ["A"] * 20) is priors


def test_each_camera_has_its_own_order():
    """Two cameras expose together, so the photo before is that of the other one."""
    both = np.repeat(LINES, 2, axis=0)
    true = told_at(both, 1.5, 3)
    told = list(true)
    told[::2] = late_by(true[::2], 1)
    moved = unshifted(block(both), told, ["A", "B"] * len(LINES))
    assert all(np.array_equal(moved[i].map_C, true[i].map_C) for i in range(len(both) - 2))
    assert moved[1::2] == told[1::2]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_flight_with_late_positions_is_placed_as_with_right_ones(seed):
    flight = Slanting([(x - 45, y - 37, z, 90.0, 0.0) for x, y, z in LINES], seed=seed)
    right = flight.aligned()
    flight.priors = late_by(flight.priors, 1)
    late = flight.aligned()
    off = [late.poses[i].map_C - right.poses[i].map_C for i in right.poses]
    assert len(late.poses) == len(LINES)
    # one position of 24 is missing, and GPS errs by 1.5 m
    assert np.linalg.norm(off, axis=1).max() < 1.0
    assert sum("moved to the photos" in note for note in late.notes) == 1
    assert not any("moved to the photos" in note for note in right.notes)


@pytest.mark.parametrize("late", [7, -7])
@pytest.mark.parametrize("seed", range(2))
def test_all_positions_late_by_many_photos_are_moved(late, seed):
    """A clock that is off by half a minute: by more than parts of a survey are moved."""
    true = told_at(LINES, 1.5, seed)
    moved = unshifted(block(LINES), late_by(true, late), ["A"] * len(LINES))
    inside = slice(None, -late) if late > 0 else slice(-late, None)
    for a, b in zip(moved[inside], true[inside], strict=True):
        assert np.array_equal(a.map_C, b.map_C)


@pytest.mark.parametrize("seed", range(4))
def test_positions_in_reversed_order_are_moved_where_the_way_tells(seed):
    """Along a road that bends after two thirds of the way; there and back it is a map turned by 180
    degrees or mirrored, and nothing is moved.
    """
    road = np.array([(15.0 * min(k, 14), 15.0 * max(k - 14, 0), 60.0) for k in range(22)])
    true = told_at(road, 1.5, seed)
    moved = unshifted(block(road), true[::-1], ["A"] * len(road))
    assert all(np.array_equal(a.map_C, b.map_C) for a, b in zip(moved, true, strict=True))
    assert unshifted(block(road), true, ["A"] * len(road)) is true
    for some in (LINES, LINES[:18]):
        told = told_at(some, 1.5, seed)[::-1]
        assert unshifted(block(some), told, ["A"] * len(some)) is told


SPEED_MS, TURN_S = 6.0, 8.0


def timed():
    """The photos of `LINES`, flown at 6 m/s with 8 s from line to line, and times in s."""
    step = np.hypot(*np.diff(LINES[:, :2], axis=0).T)
    gap = np.where(step > 20, TURN_S, step / SPEED_MS)
    time = np.concatenate([[0.0], np.cumsum(gap)])
    began = datetime(2024, 5, 1)
    named = [photo(f"{t:07.2f}.jpg") for t in time]
    after = [began + timedelta(seconds=float(t)) for t in time]
    return [replace(p, time=t) for p, t in zip(named, after, strict=True)], time


def of_another_moment(time, late_s):
    """The way flown, `late_s` before."""
    there = [np.interp(time - late_s, time, LINES[:, axis]) for axis in range(3)]
    return np.column_stack(there)


@pytest.mark.parametrize("late_s", [1.0, 1.6, 4.0, -1.2])
@pytest.mark.parametrize("sigma", [0.05, 1.0])
@pytest.mark.parametrize("seed", range(2))
def test_positions_of_another_moment_are_moved_along_the_flight(late_s, sigma, seed):
    """The block is turned and stretched as such positions would have it: that changes nothing."""
    photos, time = timed()
    told = told_at(of_another_moment(time, late_s), sigma, seed)
    found = block(LINES @ [[1.02, 0.03, 0], [-0.03, 1.02, 0], [0, 0, 1]])
    moved = on_time(found, told, ["cam"] * 24, speeds_of(photos))
    seconds = float(moved.note.split("moment ")[1].split()[0])
    assert seconds == pytest.approx(abs(late_s), abs=0.1 + 0.1 * abs(late_s))
    assert ("behind" in moved.note) == (late_s > 0)
    C = np.array([p.map_C for p in moved.priors])
    known = np.isfinite(C[:, 0])
    off = np.linalg.norm((C - LINES)[known, :2], axis=1)
    before = np.linalg.norm((np.array([p.map_C for p in told]) - LINES)[:, :2], axis=1)
    assert known.sum() >= 16
    assert np.median(off) < 0.25 * np.median(before) + sigma
    assert as_moved(found, told, ["cam"] * 24, speeds_of(photos)) is told
    taken = as_moved(replace(found, notes=(moved.note,)), told, ["cam"] * 24, speeds_of(photos))
    assert all(
        np.array_equal(a.map_C, b.map_C, equal_nan=True)
        for a, b in zip(taken, moved.priors, strict=True)
    )


@pytest.mark.parametrize("seed", range(20))
def test_noise_drift_and_offsets_across_the_flight_belong_to_no_other_moment(seed):
    photos, time = timed()
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, 1.5, LINES.shape)
    drift = np.cumsum(rng.normal(0, 0.5, LINES.shape), axis=0)
    back = np.repeat([1, -1, 1, -1], 6)[:, None]
    antenna = 3.0 * back * [0.0, 1.0, 0.0] + 0.05 * noise  # to the side of a camera that turns
    gross = np.where(rng.uniform(size=(24, 1)) < 0.15, rng.normal(0, 40, LINES.shape), 0)
    for error in (noise, noise + drift, antenna, noise + gross):
        assert (
            on_time(block(LINES), told_at(LINES + error, 0.0, 0), ["cam"] * 24, speeds_of(photos))
            is None
        )
    still = [replace(p, time=None) for p in photos]
    assert (
        on_time(
            block(LINES),
            told_at(of_another_moment(time, 2.0), 0.1, 0),
            ["cam"] * 24,
            speeds_of(still),
        )
        is None
    )


def test_positions_of_hundredths_of_a_second_before_are_none():
    """Times that are a fifth of what passed make such moments of half a metre."""
    photos, time = timed()
    began = photos[0].time
    fast = [replace(p, time=began + (p.time - began) / 5) for p in photos]
    told = told_at(of_another_moment(time, 0.12), 0.02, 0)
    assert on_time(block(LINES), told, ["cam"] * 24, speeds_of(photos)) is not None
    assert on_time(block(LINES), told, ["cam"] * 24, speeds_of(fast)) is None


MIRROR = {
    "east is taken for west": lambda x, y: (-x, y),
    "north is taken for south": lambda x, y: (x, -y),
    # at 50.5 degrees north and 3 west, with both exchanged
    "latitude and longitude are exchanged": lambda x, y: (y * 0.9986, x / 0.636),
}


def as_mirrored(told, how):
    """The priors with positions mirrored about a place that is not their middle."""
    out = []
    for p in told:
        x, y, z = p.map_C
        out.append(replace(p, map_C=np.array([*MIRROR[how](x + 7.0, y - 4.0), z])))
    return out


@pytest.mark.parametrize("how", MIRROR)
@pytest.mark.parametrize("seed", range(3))
def test_mirrored_positions_are_mirrored_back(how, seed):
    """And turned as headings tell; which mirror it is, is told."""
    told = [replace(p, yaw_deg=10.0) for p in told_at(LINES, 1.5, seed)]
    found = block(LINES)
    if how.startswith("latitude"):
        # the frame is that of the place in the file: 3 degrees south, 50.5 east
        found = replace(
            found, frame=replace(found.frame, crs="EPSG:32739", origin=(444500.0, 9668400.0))
        )
    back = mirrored(found, as_mirrored(told, how))
    off = np.array([p.map_C - q.map_C for p, q in zip(back.priors, told, strict=True)])
    assert np.abs(off - off.mean(0)).max() < 0.2  # shifted only
    assert how in back.note and MIRRORED in back.note
    noted = replace(found, notes=(back.note,))
    cameras, taken = ["A"] * len(LINES), as_mirrored(told, how)
    again = as_moved(noted, taken, cameras, lambda own, C: np.zeros((len(own), 3)))
    assert all(np.array_equal(p.map_C, q.map_C) for p, q in zip(again, back.priors, strict=True))


def test_positions_that_headings_say_are_not_mirrored_have_another_reason():
    """As of pictures that a program mirrored: headings lie 50 degrees off in each of three ways."""
    told = as_mirrored(
        [replace(p, yaw_deg=60.0) for p in told_at(LINES, 1.5, 0)], "east is taken for west"
    )
    back = mirrored(block(LINES), told)
    assert "a program has mirrored the pictures. " in back.note and "east" not in back.note
    assert (
        "no photo tells" in mirrored(block(LINES), [replace(p, yaw_deg=np.nan) for p in told]).note
    )


@pytest.mark.parametrize("seed", range(10))
def test_positions_that_are_right_or_in_another_order_are_not_mirrored(seed):
    told = [replace(p, yaw_deg=10.0) for p in told_at(LINES, 8.0, seed)]
    assert mirrored(block(LINES), told) is None
    assert mirrored(block(LINES), late_by(told, 3)) is None
    line = LINES * [1, 0, 1] + [0, 0.3, 0] * (np.arange(len(LINES))[:, None] % 3)
    assert mirrored(block(line), told_at(line, 3.0, seed)) is None
    back = [replace(p, map_C=q.map_C) for p, q in zip(told[:18], told[17::-1], strict=True)]
    assert mirrored(block(LINES[:18]), back) is None


@pytest.mark.slow
def test_a_flight_with_mirrored_positions_has_its_size_and_direction():
    """Such a map had shrunk to less than a fifth."""
    flight = Slanting([(x - 45, y - 37, z, 90.0, 0.0) for x, y, z in LINES], seed=1)
    right = flight.aligned()
    flight.priors = as_mirrored(flight.priors, "east is taken for west")
    found = flight.aligned()
    C, D = (np.array([a.poses[i].map_C for i in sorted(right.poses)]) for a in (right, found))
    off = (D - D.mean(0)) - (C - C.mean(0))
    assert np.linalg.norm(off, axis=1).max() < 1.0
    assert sum(MIRRORED in note for note in found.notes) == 1
    assert not any(MIRRORED in note for note in right.notes)
