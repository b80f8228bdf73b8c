"""Ways around keep-outs, the lower bound, endurance, separation, clearance."""

import itertools
import signal
import sys
import threading
import time

import numpy as np
import pytest
from shapely import LineString, Point, box
from shapely.affinity import rotate

from skyquilt.errors import RefusedError, UsageError
from skyquilt.planning.airspace import make_airspace, ways_between
from skyquilt.planning.bound import Work, lower_bound
from skyquilt.planning.flights import Surface, lifted, nearest
from skyquilt.planning.records import Drone, KeepOut, PicturePoint
from skyquilt.planning.routes import plan_routes
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.site import make_site
from skyquilt.planning.terrain import FLAT, Terrain
from skyquilt.planning.times import ground_speed
from skyquilt.planning.tours import Vehicle, tours
from skyquilt.planning.turns import STEP_RAD, curves, drawn
from skyquilt.planning.view import find_view

VIEW = find_view("FC6310")
ZONE = "EPSG:32633"
QUICK = PlanSettings(height_m=60, seconds=0.4)


def grid(columns, rows, step=30.0):
    return [
        PicturePoint(id=k + 1, x=step * (k % columns), y=step * (k // columns), z=60.0, ground=0.0,
                     yaw=0.0)
        for k in range(columns * rows)
    ]  # fmt: skip


def fleet(number, start=(0.0, -60.0), **more):
    places = [(start[0] + 30.0 * k, start[1]) for k in range(number)]
    return [
        Drone(name=f"d{k}", start=p, landing=p, view=VIEW, **more) for k, p in enumerate(places)
    ]


def test_the_way_around_a_square_is_the_taut_rope():
    space = make_airspace([box(-10, -10, 10, 10)], 5.0)
    ways = ways_between(space, np.array([[-40.0, 0.0], [40.0, 0.0], [-40.0, 30.0]]))
    assert ways.length[0, 1] == pytest.approx(2 * np.hypot(25, 15) + 30, rel=1e-9)
    assert len(ways.way(0, 1)) == 4 and len(ways.way(0, 2)) == 2
    assert ways.length[0, 2] == pytest.approx(30)


def test_ways_meet_no_keep_out_and_are_as_short_as_any_way_over_corners():
    rng = np.random.default_rng(4)
    shapes = [rotate(box(x, y, x + 25, y + 12), a) for x, y, a in rng.uniform(0, 180, (5, 3))]
    shapes.append(Point(90, 90).buffer(15))
    space = make_airspace(shapes, 4.0)
    places = rng.uniform(-30, 220, (30, 2))
    places = places[~space.inside(places)]
    ways = ways_between(space, places)
    for i, j in itertools.combinations(range(len(places)), 2):
        line = LineString(ways.way(i, j))
        assert line.length == pytest.approx(ways.length[i, j], rel=1e-9)
        assert not any(line.intersects(s) for s in shapes)
    # the triangle inequality holds for shortest ways
    via = (ways.length[:, :, None] + ways.length[None, :, :]).min(axis=1)
    assert (ways.length <= via + 1e-6).all()


@pytest.mark.parametrize(
    "seed", [0, 1, 2, *(pytest.param(s, marks=pytest.mark.slow) for s in range(3, 8))]
)
def test_the_bound_is_below_the_best_plan(seed):
    """All orders and divisions of six points among two drones are tried, from one place or two,
    points in clusters or not.
    """
    rng = np.random.default_rng(seed)
    xy, starts = rng.uniform(0, 500, (6, 2)), rng.uniform(-200, 700, (2, 2))
    if seed % 2:
        starts[1] = starts[0]
    if seed % 4 > 1:
        xy = rng.uniform(0, 500, (2, 2))[rng.integers(0, 2, 6)] + rng.normal(0, 15, (6, 2))
    times = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) / 8
    legs = np.array([np.hypot(*(xy - start).T) / 8 + 20 for start in starts])
    work = Work(times=times, out=legs, home=legs, places=xy, photo=2.0, usable=1e6, swap=60.0)
    best = np.inf
    for order in itertools.permutations(range(6)):
        for cut in range(7):
            parts = [order[:cut], order[cut:]]
            ends = [
                ground[p[0]] + ground[p[-1]] + 2 * len(p)
                + sum(times[a, b] for a, b in itertools.pairwise(p))
                for ground, p in zip(legs, parts, strict=True) if p
            ]  # fmt: skip
            best = min(best, max(ends))
    bound = lower_bound(work, 2)
    assert 0.6 * best < bound <= best + 1e-9


@pytest.mark.slow
def test_what_several_drones_must_visit_they_fly_to():
    """A far cluster that takes one drone longer than both: both fly there, whereas the shortest
    forest is one flight there and a short one.
    """
    rng = np.random.default_rng(1)
    far = np.array([[1000.0, 0.0]]) + rng.uniform(0, 100, (60, 2))
    xy = np.concatenate([[[10.0, 0.0], [0.0, 10.0]], far])
    times = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) / 8
    legs = np.stack([np.hypot(*xy.T) / 8] * 2)
    work = Work(times=times, out=legs, home=legs, places=xy, photo=10.0, usable=1e6, swap=60.0)
    there = np.hypot(*far.T).min() / 8
    bound = lower_bound(work, 2)
    assert 60 * 10 / 2 + 1.2 * there < bound  # without sets, there and back once: 0.6
    assert bound <= 62 * 10 / 2 + 2 * there + 30 * 40 / 8


@pytest.mark.slow
def test_routes_visit_every_point_once_clear_of_keep_outs_and_near_the_bound():
    points = [p for p in grid(10, 6) if not box(95, 35, 145, 105).intersects(Point(p.x, p.y))]
    closed = KeepOut(shape=box(105, 45, 135, 95))
    site = make_site(box(0, 0, 270, 150), (closed,), ZONE)
    drones = fleet(2)
    routes = plan_routes(site, points, drones, QUICK, FLAT, 60.0)
    visited = sorted(w.point for s in routes.sorties for w in s.way if w.point is not None)
    assert visited == [p.id for p in points]
    for s in routes.sorties:
        assert not LineString([(w.x, w.y) for w in s.way]).intersects(closed.shape.buffer(9.9))
        assert (np.diff([w.time_s for w in s.way]) >= 0).all()
    assert routes.bound_s <= max(s.seconds for s in routes.sorties) <= 1.3 * routes.bound_s
    a, b = ([s for s in routes.sorties if s.drone == k] for k in (0, 1))
    assert nearest(a, b) >= QUICK.separation_m


@pytest.mark.slow
def test_where_one_charge_does_not_suffice_there_are_more_sorties():
    drones = fleet(1, endurance_s=260.0, reserve=0.25, swap_s=100.0)
    site = make_site(box(0, 0, 270, 150), (), ZONE)
    routes = plan_routes(site, grid(8, 4), drones, QUICK, FLAT, 60.0)
    assert len(routes.sorties) > 1
    assert max(s.seconds for s in routes.sorties) <= 195.0
    gaps = [b.way[0].time_s - a.way[-1].time_s for a, b in itertools.pairwise(routes.sorties)]
    assert min(gaps) == pytest.approx(100.0)
    assert routes.bound_s <= routes.sorties[-1].way[-1].time_s


def test_endurance_too_short_for_the_nearest_point_is_refused():
    site = make_site(box(0, 0, 270, 150), (), ZONE)
    with pytest.raises(RefusedError, match="nearest point there and back takes"):
        plan_routes(site, grid(3, 3), fleet(1, endurance_s=50.0), QUICK, FLAT, 60.0)
    far = [*grid(3, 3), PicturePoint(id=10, x=9000, y=0, z=60, ground=0, yaw=0)]
    with pytest.raises(RefusedError, match="1 of 10 picture-points lie too far"):
        plan_routes(site, far, fleet(1), QUICK, FLAT, 60.0)


def test_a_start_inside_a_keep_out_is_refused():
    site = make_site(box(0, 0, 90, 90), (KeepOut(shape=box(-20, -80, 20, -40), name="barn"),), ZONE)
    with pytest.raises(RefusedError, match="d0 starts inside the keep-out area 'barn'"):
        plan_routes(site, grid(3, 3), fleet(1), QUICK, FLAT, 60.0)


def test_points_that_keep_outs_surround_are_refused():
    ring = box(-50, -50, 150, 150).difference(box(-30, -30, 130, 130))
    site = make_site(box(0, 0, 90, 90), (KeepOut(shape=ring),), ZONE)
    with pytest.raises(RefusedError, match="9 picture-points cannot be reached"):
        plan_routes(site, grid(3, 3), [fleet(5)[4]], QUICK, FLAT, 60.0)


@pytest.mark.parametrize("radius", [12.0, 60.0])
def test_curves_end_where_they_should_and_the_straight_way_is_one(radius):
    rng = np.random.default_rng(3)
    for _ in range(150):
        a, b, (before, after) = (
            rng.uniform(-99, 99, 2),
            rng.uniform(-99, 99, 2),
            rng.uniform(0, 7, 2),
        )
        found = curves(a, before, b, after, radius)
        assert found[0].length * radius >= np.hypot(*(b - a)) - 1e-9
        for curve in found:
            way = drawn(curve, a, before, radius)
            assert np.allclose(way[-1], b, atol=1e-6)
            assert np.hypot(*np.diff(way, axis=0).T).sum() == pytest.approx(
                radius * curve.length, rel=5e-3
            )
            d = np.diff(way, axis=0)
            if len(d) and max(curve.parts[0], curve.parts[2]) > 0.3:  # it arrives as asked
                ends = [np.arctan2(*d[0]) - before, np.arctan2(*d[-1]) - after]
                assert np.abs(np.angle(np.exp(1j * np.array(ends)))).max() <= STEP_RAD / 2 + 1e-6
    ahead = curves(np.zeros(2), 0.0, np.array([0.0, 50.0]), 0.0, radius)[0]
    assert ahead.length * radius == pytest.approx(50)


def test_half_a_turn_to_the_next_line_is_a_half_circle_or_a_bulb():
    """Dubins: two radii apart a half circle; closer, arcs of the shape of a light bulb."""
    wide = curves(np.zeros(2), 0.0, np.array([40.0, 0.0]), np.pi, 20.0)[0]
    assert wide.length == pytest.approx(np.pi)
    bulb = curves(np.zeros(2), 0.0, np.array([20.0, 0.0]), np.pi, 20.0)[0]
    assert bulb.word in ("LRL", "RLR")
    outer = np.arccos(3 / 4)  # triangle of the middles: sides 2, 2 and 3 radii
    assert bulb.length == pytest.approx(np.pi + 4 * outer)


@pytest.mark.slow
def test_a_fixed_wing_turns_within_its_radius_and_keeps_clear():
    radius = 25.0
    closed = KeepOut(shape=box(-60, 40, -45, 80))
    site = make_site(box(0, 0, 270, 90), (closed,), ZONE)
    drones = fleet(1, turn_radius_m=radius, photo_s=0.0, speed_ms=15.0)
    points = grid(10, 4)
    routes = plan_routes(site, points, drones, QUICK, FLAT, 60.0)
    (sortie,) = routes.sorties
    assert not routes.warnings
    assert sorted(w.point for w in sortie.way if w.point) == [p.id for p in points]
    xy = np.array([(w.x, w.y) for w in sortie.way])
    xy = xy[np.concatenate([[True], np.hypot(*np.diff(xy, axis=0).T) > 1e-6])]
    assert not LineString(xy).intersects(closed.shape.buffer(9.5))
    d = np.diff(xy, axis=0)
    turn = np.abs(np.angle(np.exp(1j * np.diff(np.arctan2(d[:, 0], d[:, 1])))))
    assert turn.max() <= STEP_RAD + 1e-6
    # the circle through three places in a row is no smaller than the radius, but for the chords
    long_, short = np.hypot(*d[1:].T), np.hypot(*d[:-1].T)
    bent = turn > 1e-3
    assert ((long_ + short)[bent] / 2 / turn[bent] > 0.5 * radius).all()
    both = bent & (np.abs(long_ - short) < 1e-3)
    assert both.sum() > 20
    assert (long_[both] / 2 / np.sin(turn[both] / 2)).min() == pytest.approx(radius, rel=1e-3)
    straight = plan_routes(site, points, fleet(1, photo_s=0.0, speed_ms=15.0), QUICK, FLAT, 60.0)
    assert sortie.seconds > straight.sorties[0].seconds + 10


@pytest.mark.slow
def test_a_turn_that_does_not_fit_between_keep_outs_is_told():
    walls = box(-300, -50, 570, 400).difference(box(-15, -50, 285, 105))
    site = make_site(box(0, 0, 270, 90), (KeepOut(shape=walls),), ZONE)
    drones = fleet(1, turn_radius_m=200.0, photo_s=0.0, start=(135.0, -300.0))
    routes = plan_routes(site, grid(4, 2), drones, QUICK, FLAT, 60.0)
    assert "d0 turns within 200 m and cannot keep its distance" in " ".join(routes.warnings)


def test_wind_is_a_triangle_of_velocities():
    drone, windy = fleet(1)[0], PlanSettings(height_m=60, wind_ms=3.0, wind_from_deg=0.0)
    north, east, south = ground_speed(drone, windy, np.radians([0.0, 90.0, 180.0]))
    assert (north, east, south) == pytest.approx((5.0, np.sqrt(64 - 9), 11.0))
    with pytest.raises(UsageError, match="cannot make way"):
        ground_speed(drone, PlanSettings(height_m=60, wind_ms=9.0), np.zeros(1))


def test_ways_rise_over_obstacles_by_the_upper_hull():
    z = np.zeros((60, 60), np.float32)
    z[:, 30:32] = 80.0
    wall = Terrain(heights=z, west=0.0, north=60.0, cell=1.0, known=True)
    surface = Surface(terrain=wall, low=(), clearance=10.0)
    way = lifted(surface, np.array([[2.0, 30.0, 50.0], [58.0, 30.0, 50.0]]))
    s = np.linspace(2, 58, 500)
    height = np.interp(s, way[:, 0], way[:, 2])
    assert (height >= wall.at(s, np.full(500, 30.0)) + 10 - 1e-6)[np.abs(s - 31) < 5].all()
    assert height.max() < 91 and 3 <= len(way) <= 6


@pytest.mark.slow
def test_drones_from_one_place_take_off_one_after_the_other():
    drones = [Drone(name=n, start=(0, -40), landing=(0, -40), view=VIEW) for n in "ab"]
    site = make_site(box(0, 0, 270, 150), (), ZONE)
    routes = plan_routes(site, grid(8, 4), drones, QUICK, FLAT, 60.0)
    a, b = ([s for s in routes.sorties if s.drone == k] for k in (0, 1))
    assert nearest(a, b) >= QUICK.separation_m or routes.warnings


def test_without_or_tools_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ortools", None)
    monkeypatch.setitem(sys.modules, "ortools.constraint_solver", None)
    site = make_site(box(0, 0, 90, 90), (), ZONE)
    with pytest.raises(UsageError, match=r'pip install .*"\.\[plan\]"'):
        plan_routes(site, grid(3, 3), fleet(1), QUICK, FLAT, 60.0)


@pytest.mark.slow
def test_an_interrupt_ends_the_search():
    """OR-tools loses what is raised in functions that it calls: Ctrl-C did nothing."""
    places = np.random.default_rng(3).uniform(0, 1000, (60, 2))
    apart = np.hypot(*(places[:, None] - places).T)
    far = np.hypot(*places.T)
    vehicle = Vehicle(times=apart, out=far, home=far, usable=1e9)
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    pressed = threading.Timer(0.7, signal.raise_signal, [signal.SIGINT])
    began = time.process_time()
    try:
        pressed.start()
        with pytest.raises(KeyboardInterrupt):
            tours([vehicle, vehicle], 20.0)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        pressed.join()
        signal.signal(signal.SIGINT, former)
    assert time.process_time() - began < 4  # 20 without an interrupt
