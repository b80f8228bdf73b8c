"""Every place of the area is seen as often as asked for, at few photos: judged by rays."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import box
from shapely.affinity import rotate, translate

from skyquilt.errors import RefusedError
from skyquilt.planning.check import _proof
from skyquilt.planning.coverage import all_seen, counted, make_cells, seen_cells
from skyquilt.planning.lattice import needed, placed, steps_of
from skyquilt.planning.points import place_points
from skyquilt.planning.records import KeepOut
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.site import make_site
from skyquilt.planning.terrain import FLAT, read_terrain
from skyquilt.planning.view import find_view, view_of
from tests.planning.judge import (
    CAMERAS,
    EAST,
    NORTH,
    Hills,
    area_of,
    perfect,
    places_in,
    views_by_rays,
)

ZONE = "EPSG:32633"
VIEW = find_view("FC6310")


@settings(max_examples=60, deadline=None)
@given(st.floats(0, 500), st.integers(1, 7), st.floats(0.3, 1.0))
def test_a_line_sees_its_interval_n_times_with_the_fewest_windows(length, n, share):
    window = 40.0
    step = share * window / n
    at = placed(0.0, length, step, n, window)
    assert len(at) == needed(length, step, n)
    where = np.linspace(0, length, 400)
    seen = (np.abs(where[:, None] - at[None]) <= window / 2 + 1e-9).sum(axis=1)
    assert seen.min() >= n
    assert (np.diff(at) <= step + 1e-9).all()
    if share == 1.0 and length > 0:  # windows of n steps: any cover n times needs as many
        assert len(at) * window >= n * length


def test_more_views_make_the_lattice_closer_and_no_closer_than_needed():
    few = steps_of(100, 150, 60, 60, None)
    assert (few.n, few.m) == (2, 2)
    many = steps_of(100, 150, 60, 60, 9)
    assert many.n * many.m >= 9 and many.n * many.m <= 10
    assert many.step == min(40, 100 / many.n) and many.spacing == min(60, 150 / many.m)


@pytest.mark.parametrize("turn", [0, 33])
@pytest.mark.parametrize(("overlap", "sidelap"), [(80, 70), (60, 50)])
def test_a_rectangle_takes_no_more_photos_than_the_perfect_grid(turn, overlap, sidelap):
    options = PlanSettings(height_m=80, overlap=overlap, sidelap=sidelap)
    area = translate(rotate(box(0, 0, 300, 200), turn), EAST, NORTH)
    points, proof, warnings, _ = place_points(make_site(area, (), ZONE), VIEW, options, FLAT)
    most = perfect(300, 200, options, VIEW.along * 80, VIEW.across * 80)
    assert len(points) <= most
    assert proof.least >= proof.views and proof.missing_m2 == 0 and not warnings
    assert proof.overlap >= overlap / 100 - 0.001
    assert proof.gsd_cm == pytest.approx((80 / 3648 * 100,) * 2, rel=0.002)


@pytest.mark.parametrize("seed", [1, 2, 9, 11])
def test_areas_of_every_kind_are_covered_on_hills_too(seed, tmp_path):
    """Odd seeds on flat ground, the others and 9, 11 on hills of 60 m."""
    _judged(seed, tmp_path, height=110, views=4)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3000, 3024))
def test_many_more_areas_are_covered(seed, tmp_path):
    _judged(seed, tmp_path, height=70, views=None)


def _judged(seed, folder, *, height, views):
    rng = np.random.default_rng(seed)
    area = area_of(("concave", "hole", "several", "sliver", "corridor")[seed % 5], rng)
    name = list(CAMERAS)[seed % 3]
    view = view_of(CAMERAS[name], name)
    options = PlanSettings(height_m=height, overlap=70, sidelap=60, views=views)
    hills = Hills(60.0 if seed % 2 == 0 or seed in (9, 11) else 0.0, seed)
    hills.write(folder / "dem.tif", area)
    terrain = read_terrain(folder / "dem.tif", ZONE, area, 250)
    site = make_site(area, (), ZONE)
    points, proof, _, _ = place_points(site, view, options, terrain)
    seen = views_by_rays(CAMERAS[name], points, hills, places_in(site.observe, rng, 250))
    assert seen.min() >= proof.views == (views or 6)
    assert proof.missing_m2 == 0
    above = np.array([p.z - hills.at(np.array(p.x), np.array(p.y)) for p in points])
    assert np.abs(above - height).max() < 1.0


def test_ground_beside_a_keep_out_is_seen_from_outside_it():
    area = translate(box(0, 0, 260, 200), EAST, NORTH)
    closed = KeepOut(shape=translate(box(110, 80, 150, 120), EAST, NORTH))
    options = PlanSettings(height_m=80, overlap=70, sidelap=60, clearance_m=8)
    points, proof, _, _ = place_points(make_site(area, (closed,), ZONE), VIEW, options, FLAT)
    assert proof.missing_m2 == 0 and proof.closed_m2 == pytest.approx(1600)
    around = closed.shape.buffer(8, join_style="mitre")
    assert not any(around.contains_properly(_dot(p)) for p in points)
    rest = area.difference(closed.shape)
    raised = [replace(p, z=p.z + 200) for p in points]
    places = places_in(rest, np.random.default_rng(1), 300)
    assert views_by_rays(CAMERAS["20 MP"], raised, Hills(0.0, 1), places).min() >= proof.views


def _dot(point):
    from shapely import Point

    return Point(point.x, point.y)


def test_a_ceiling_below_the_photos_closes_nothing():
    area = translate(box(0, 0, 150, 100), EAST, NORTH)
    low = KeepOut(shape=translate(box(50, 30, 90, 60), EAST, NORTH), ceiling_m=40.0)
    options = PlanSettings(height_m=80, overlap=60, sidelap=50, clearance_m=10)
    with_it = place_points(make_site(area, (low,), ZONE), VIEW, options, FLAT)[0]
    assert with_it == place_points(make_site(area, (), ZONE), VIEW, options, FLAT)[0]
    high = replace(low, ceiling_m=75.0)
    assert place_points(make_site(area, (high,), ZONE), VIEW, options, FLAT)[1].closed_m2 > 0


def test_what_would_need_too_many_photos_is_refused():
    area = translate(box(0, 0, 9000, 9000), EAST, NORTH)
    with pytest.raises(RefusedError, match="needs about"):
        place_points(make_site(area, (), ZONE), VIEW, PlanSettings(height_m=30), FLAT)
    closed = KeepOut(shape=area.buffer(5))
    with pytest.raises(RefusedError, match="close the whole area"):
        place_points(make_site(area, (closed,), ZONE), VIEW, PlanSettings(height_m=300), FLAT)


@pytest.mark.slow
def test_thousands_of_photos_of_one_place_cost_little():
    """They share what they see, and the more photos there are the larger the cells become."""
    area = translate(box(0, 0, 400, 300), EAST, NORTH)
    rng = np.random.default_rng(1)
    xyz = np.array([EAST + 200.0, NORTH + 150.0, 80.0]) + rng.integers(0, 2, (20_000, 3)) / 1000
    cells = make_cells(area, 0.0, 2.0, FLAT)
    seen = all_seen(cells, VIEW, xyz, np.zeros(len(xyz)), blocked=False)
    assert len({id(s) for s in seen}) == 8
    alone = [seen_cells(cells, VIEW, p, 0.0, blocked=False) for p in xyz[:50]]
    assert all((a == b).all() for a, b in zip(seen, alone, strict=False))
    assert (counted(cells, seen) == np.bincount(np.concatenate(seen),
                                                minlength=cells.inside.size)).all()  # fmt: skip
    site = make_site(area, (), ZONE)
    few, many = (
        _proof(site, VIEW, places, np.zeros(len(places)), FLAT, 1)
        for places in (xyz[:500] + [0, 0, 20.0], xyz + [0, 0, 20.0])
    )
    assert few.cell_m == pytest.approx(100 * min(VIEW.along, VIEW.across) / 48, rel=1e-3)
    assert many.cell_m > few.cell_m
    assert many.cells < few.cells
