"""Follow-ups on hills: the ground between a plan's points, and flights judged by rays."""

import numpy as np
import pytest
from benchmarks.plan_follow_up import CRS, one
from shapely import box
from shapely.affinity import translate

from skyquilt.planning.fill import terrain_below
from skyquilt.planning.points import place_points
from skyquilt.planning.records import Plan
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.site import make_site
from skyquilt.planning.terrain import read_terrain
from skyquilt.planning.view import view_of
from tests.planning.judge import CAMERAS, EAST, NORTH, Hills, places_in


def test_the_ground_between_the_points_of_a_plan_is_that_of_the_hills(tmp_path):
    area, hills = translate(box(0, 0, 150, 120), EAST, NORTH), Hills(60.0, 5)
    hills.write(tmp_path / "dem.tif", area)
    site = make_site(area, (), CRS)
    terrain = read_terrain(tmp_path / "dem.tif", CRS, area, 200)
    settings = PlanSettings(height_m=80, overlap=60, sidelap=50)
    points, proof, _, _ = place_points(site, view_of(CAMERAS["20 MP"], "a"), settings, terrain)
    plan = Plan(site=site, drones=(), points=points, sorties=(), options={}, terrain=True,
                proof=proof)  # fmt: skip
    found = terrain_below(plan)
    x, y = places_in(area, np.random.default_rng(1)).T
    true = hills.at(x, y)
    assert np.ptp(true) > 8
    assert np.abs(found.at(x, y) - true).max() < 1.0
    assert np.abs(found.at(x + 40, y) - hills.at(x + 40, y)).max() < 6.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 4])
def test_a_follow_up_closes_what_a_flight_over_hills_left_open(seed, tmp_path):
    _, points, before, after, more, _ = one(seed, tmp_path)
    assert before < 0.95
    assert after == 1.0
    assert more < 0.3 * points
