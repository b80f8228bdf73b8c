"""`hybrid` and its optimisers, on textured ground of known truth."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.pose import ByPose
from skyquilt.geometry.frames import angles_from_cam_R_map
from skyquilt.imaging.plane import Overview, Patch
from skyquilt.papers.hybrid import Hybrid, turned
from skyquilt.papers.hybrid_objective import Distances, Level, Objective, pyramid
from skyquilt.papers.hybrid_search import Anneal, Surfaces, masked_correlation
from tests.alignment.flights import FRAME, fly, lawn, line
from tests.papers.test_chain import ground_error
from tests.texture import texture

OPTIMISERS = (Anneal(), Surfaces())


def objective(shift=(3.0, -2.0), alpha=0.0, gsd=0.5, neighbours=None):
    """A patch cut from a texture and put `shift` m (east, north) away from where it belongs."""
    ground = texture(200, 260, seed=4, roughness=1.3)
    overview = Overview()
    whole = np.ones(ground.shape, bool)
    overview.merge(Patch(column=0, row=0, pixels=ground, shown=whole, central=whole))
    cut = ground[60:130, 90:190]
    column, row = round(90 + shift[0] / gsd), round(60 - shift[1] / gsd)
    patch = Patch(
        column=column,
        row=row,
        pixels=cut,
        shown=np.ones(cut.shape, bool),
        central=np.ones(cut.shape, bool),
    )
    nadir_px = np.array([column + 49.5, row + 34.5])
    levels = pyramid(patch, overview, gsd, 8.0, nadir_px)
    none = Distances(reported=np.zeros(0), placed=np.zeros((0, 2)), weight=np.zeros(0))
    nadir = nadir_px * (gsd, -gsd)
    return Objective(levels=levels, distances=neighbours or none, nadir=nadir, alpha=alpha)


@pytest.mark.parametrize("optimise", OPTIMISERS, ids=("anneal", "surfaces"))
@pytest.mark.parametrize("shift", [(3.0, -2.0), (-4.0, 4.5), (0.0, 0.0)])
def test_the_place_is_found(optimise, shift):
    best = optimise(objective(shift), 8.0, 5.0, 0)
    assert np.allclose(best.move[:2], (-shift[0], -shift[1]), atol=0.3) and abs(best.move[2]) < 0.5
    assert best.quality > 0.97 and best.evaluations > 10


@pytest.mark.parametrize("optimise", OPTIMISERS, ids=("anneal", "surfaces"))
def test_equal_seeds_give_equal_moves_and_the_range_is_kept(optimise):
    a, b = (optimise(objective((6.0, 0.0)), 3.0, 2.0, 7) for _ in range(2))
    assert np.array_equal(a.move, b.move) and a.quality == b.quality
    assert np.hypot(*a.move[:2]) <= 3.0 and abs(a.move[2]) <= 2.0


def test_annealing_with_other_seeds_goes_other_ways():
    a, b = (Anneal()(objective(), 8.0, 5.0, seed) for seed in (1, 2))
    assert not np.array_equal(a.move, b.move) and np.allclose(a.move, b.move, atol=0.5)


def test_all_shifts_at_once_are_the_shifts_one_by_one():
    level = objective((1.0, 2.0)).levels[1]
    rng = np.random.default_rng(0)
    seen = (rng.random(level.shown.shape) > 0.3).astype(np.float32)
    level = replace(level, shown=seen)
    for turn in (0.0,):
        cc, columns, rows = masked_correlation(level, turn, 5.0)
        for i, row in enumerate(rows):
            for j, column in enumerate(columns):
                move = np.array([column * level.gsd, -row * level.gsd, turn])
                assert cc[i, j] == pytest.approx(level.correlation(move), abs=1e-4)


def test_the_correlation_is_that_of_numpy():
    level = objective((0.0, 0.0)).levels[0]
    row, column = level.offset[1].astype(int), level.offset[0].astype(int)
    h, w = level.patch.shape
    under = level.window[row : row + h, column : column + w]
    assert level.correlation(np.zeros(3)) == pytest.approx(
        np.corrcoef(level.patch.ravel(), under.ravel())[0, 1]
    )
    assert level.correlation(np.zeros(3)) == pytest.approx(1.0)
    assert np.isnan(replace(level, filled=np.zeros_like(level.filled)).correlation(np.zeros(3)))


def test_a_turn_is_about_the_nadir_and_clockwise():
    gsd, ground = 0.5, texture(160, 160, seed=9, roughness=1.4)
    level = Level(
        gsd=gsd,
        patch=ground[40:120, 40:120],
        shown=np.ones((80, 80), np.float32),
        pivot=np.array([39.5, 39.5]),
        window=np.rot90(ground, -1).copy(),
        filled=np.ones((160, 160), np.float32),
        offset=np.array([40.0, 40.0]),
    )
    assert (
        level.correlation(np.array([0, 0, 90.0]))
        > 0.99
        > level.correlation(np.array([0, 0, -90.0])) + 0.3
    )


def test_distances_pull_back_what_looks_do_not_hold():
    told = Distances(
        reported=np.array([20.0, 20.0]),
        placed=np.array([[0.0, 0.0], [40.0, 0.0]]),
        weight=np.ones(2),
    )
    assert told.quality(np.array([20.0, 0.0])) == pytest.approx(1.0)
    # 22 m and 18 m for 20 m: 1 / 1.1 both
    assert told.quality(np.array([22.0, 0.0])) == pytest.approx(1 / 1.1)
    assert told.quality(np.array([[20.0, 0.0], [22.0, 0.0]])).shape == (2,)


def placed(flight):
    return ByPose()(flight.photos, FRAME, flight.priors)


def run(flight, **more):
    method = Hybrid(**{"optimise": Surfaces(), "across": 200} | more)
    return method(
        placed(flight), flight.photos, flight.priors, range(len(flight.photos)), flight.grey
    )


@pytest.mark.slow
@pytest.mark.parametrize("optimise", [OPTIMISERS[0], OPTIMISERS[1]], ids=("anneal", "surfaces"))
def test_a_noisy_strip_becomes_a_strip(optimise):
    flight = fly(line(8, step=20.0, heading=60.0), yaw=60.0, gps=1.5, yaw_error=2.0, seed=3)
    found = run(flight, optimise=optimise)
    before, after = ground_error(flight, placed(flight)), ground_error(flight, found)
    assert 0.02 < after < 0.5 * before
    assert found.blocks == (tuple(range(8)),) and len(found.joins) == 7
    assert all(0.7 < j.score <= 1 for j in found.joins)


@pytest.mark.slow
def test_earlier_photos_stay():
    flight = fly(line(6, step=20.0), gps=1.5, seed=3)
    some = Hybrid(optimise=Surfaces(), across=200)(
        placed(flight), flight.photos, flight.priors, range(4), flight.grey
    )
    more = run(flight)
    for i in range(4):
        assert np.array_equal(some.poses[i].map_C, more.poses[i].map_C)
    assert np.array_equal(more.poses[0].map_C, placed(flight).poses[0].map_C)


@pytest.mark.slow
def test_the_loop_closes_without_any_global_optimisation():
    around = np.concatenate(
        [
            line(6, 20.0),
            line(5, 20.0, start=(20.0, 100.0), heading=90.0),
            line(6, 20.0, start=(100.0, 80.0), heading=180.0)[:5],
            line(4, 20.0, start=(80.0, 0.0), heading=270.0),
        ]
    )
    flight = fly(around, gps=1.5, seed=5)
    found = run(flight)
    last = len(around) - 1
    error = (found.poses[last].map_C - found.poses[0].map_C)[:2] - (around[last] - around[0])
    assert np.hypot(*error) < 0.5


@pytest.mark.slow
def test_a_survey_of_lines_keeps_its_distances():
    flight = fly(lawn(3, 4, step=20.0, apart=30.0), gps=1.0, seed=8)
    found = run(flight)
    xy = np.array([found.poses[i].map_C[:2] for i in range(12)])
    i, j = np.triu_indices(12, 1)
    off = np.linalg.norm(xy[i] - xy[j], axis=1) - np.linalg.norm(
        flight.C[i, :2] - flight.C[j, :2], axis=1
    )
    assert np.sqrt((off**2).mean()) < 0.3  # the thesis's claim


def test_the_range_is_that_of_the_photos_own_errors():
    method = Hybrid(optimise=Surfaces())
    good, poor = (fly(line(2), gps=g, yaw_error=y).priors[0] for g, y in ((0.6, 1.0), (3.0, 5.0)))
    tilt = np.tan(np.radians(2.0)) * 60.0  # priors state one degree
    assert method.reach(good, 60.0) == (pytest.approx(1.2 + tilt, rel=1e-6), pytest.approx(2.0))
    assert method.reach(poor, 60.0) == (pytest.approx(6.0 + tilt, rel=1e-6), pytest.approx(10.0))
    assert method.reach(good, 120.0)[0] == pytest.approx(1.2 + 2 * tilt, rel=1e-6)


def test_photos_apart_stay_where_metadata_put_them():
    flight = fly(np.concatenate([line(2), line(1, start=(500.0, 0.0))]), gps=1.0)
    found = run(flight)
    assert np.array_equal(found.poses[2].map_C, placed(flight).poses[2].map_C)
    assert [j.photo for j in found.joins] == [1]


def test_turned_turns_clockwise_about_the_vertical():
    pose = placed(fly(line(1), yaw=30.0)).poses[0]
    moved = turned(pose, np.array([1.0, 2.0, 10.0]))
    assert np.allclose(moved.map_C - pose.map_C, [1, 2, 0])
    assert angles_from_cam_R_map(moved.cam_R_map)[0] == pytest.approx(40.0)
