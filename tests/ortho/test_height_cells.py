"""Heights of growing maps: cells hold medians, and follow later points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyquilt.ortho.height_cells import WEIGHT, HeightCells


def test_cells_hold_the_medians_of_their_points():
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-90, 90, (3000, 2)), rng.normal(size=3000)])
    cells = HeightCells(cell=2.0)
    touched, z = cells.add(xyz)
    place = np.floor(xyz[:, :2] / 2)
    assert {tuple(p) for p in touched.tolist()} == {tuple(p) for p in place.astype(int).tolist()}
    for cell, height in zip(touched, z, strict=True):
        assert height == np.median(xyz[(place == cell).all(1), 2])


def test_later_points_move_a_cell_part_of_the_way_or_replace_it():
    cells = HeightCells(cell=1.0)
    cells.add(np.array([(0.5, 0.5, 10.0), (3.5, 0.5, 1.0)]))
    touched, z = cells.add(np.array([(0.2, 0.9, 20.0)]))
    assert touched.tolist() == [[0, 0]]
    assert z == pytest.approx(10 + WEIGHT * 10)
    assert cells.at(np.array([(0, 0), (3, 0)])).tolist() == [*z, 1.0]
    cells.add(np.array([(0.2, 0.9, 5.0)]), anew=True)
    assert cells.at(np.array([(0, 0)])) == 5.0
    assert len(cells.add(np.zeros((0, 3)))[0]) == 0


@pytest.mark.slow
@given(
    st.lists(st.tuples(st.integers(-70, 70), st.integers(-70, 70), st.floats(-9, 9)), max_size=60),
    st.tuples(*[st.integers(-80, 80)] * 2),
    st.tuples(*[st.integers(0, 90)] * 2),
)
def test_any_part_of_the_cells_is_what_was_put_there(entries, corner, size):
    known = {(c, r): z for c, r, z in entries}
    cells = HeightCells(cell=1.0)
    cells.put(np.array(list(known), int).reshape(-1, 2), np.array(list(known.values())))
    c0, r0, c1, r1 = *corner, corner[0] + size[0], corner[1] + size[1]
    asked = [(c, r) for c in range(c0, c1 + 1) for r in range(r0, r1 + 1)]
    expected = np.array([known.get(cell, np.nan) for cell in asked])
    assert np.array_equal(cells.at(np.array(asked)), expected, equal_nan=True)
    inside = expected[np.isfinite(expected)]
    middle = cells.median((c0 + 0.5, r0 + 0.5, c1 + 0.5, r1 + 0.5))
    assert middle == (pytest.approx(np.median(inside)) if len(inside) else None)


def test_what_is_known_within_absurd_bounds_is_found_at_once():
    """Positions across the globe, in photos of one place, make one map of their size."""
    cells = HeightCells(cell=1.0)
    places = np.array([(0, 0), (-5, 3), (31, 32), (10**8, -(10**8))])
    cells.put(places, np.array([1.0, 2.0, 3.0, 4.0]))
    everywhere = (-2e9, -2e9, 2e9, 2e9)
    assert cells.median(everywhere) == 2.5
    order = np.lexsort(places.T)
    assert cells.places(everywhere).tolist() == (places[order] + 0.5).tolist()
    assert cells.places((-5.0, 0.0, 31.0, 31.9)).tolist() == [[0.5, 0.5], [-4.5, 3.5]]


def block(rng, cells, z):
    """Points about the middles of cells (k, 2), of these heights (k,)."""
    return np.column_stack([cells + rng.uniform(0.3, 0.7, cells.shape), z])


def test_cells_without_points_follow_those_around_them():
    """What is known of the ground between tie points rises with it, and cells of others stay."""
    rng = np.random.default_rng(1)
    own = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2)
    other = own + (40, 0)
    relief = 3 * np.sin(own[:, 0] / 3)
    cells = HeightCells(cell=1.0)
    cells.put(own, relief)
    cells.put(other, relief)
    met = rng.random(len(own)) < 0.3
    lift = 0.5 + 0.02 * own[:, 1]
    touched, z = cells.renew(
        block(rng, own[met], relief[met] + lift[met]), own, np.zeros(400, bool)
    )
    assert {*map(tuple, touched.tolist())} == {*map(tuple, own.tolist())}
    assert np.array_equal(cells.at(touched), z)
    assert np.abs(cells.at(own) - relief - lift).max() < 0.1
    assert np.array_equal(cells.at(other), relief)


@pytest.mark.parametrize("how", ["far up", "aside", "nothing in common"])
def test_cells_whose_ground_lies_elsewhere_now_are_removed(how):
    """By 70 m of height, or below photos that moved away: former heights would stand out."""
    rng = np.random.default_rng(2)
    own = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2)
    cells = HeightCells(cell=1.0)
    cells.put(own, np.full(400, 270.0))
    met = own[rng.random(len(own)) < 0.3]
    now = met + (100, 0) if how == "nothing in common" else met
    height = 340.0 if how == "far up" else 270.0
    xyz = block(rng, now, np.full(len(met), height))
    gone = np.full(400, how == "aside")
    touched, z = cells.renew(xyz, own, gone)
    left = cells.at(own)
    assert set(left[np.isfinite(left)]) <= {height}
    assert np.isfinite(left).sum() == (0 if how == "nothing in common" else len(met))
    assert np.isnan(z).sum() == 400 - np.isfinite(left).sum()


def hills(seed):
    """Cells of hills, of which a third of those below a flight is known, and three far away."""
    rng = np.random.default_rng(seed)
    cells = HeightCells(cell=2.0)
    own = rng.integers(0, 60, (1200, 2)) * (1, 2) + rng.integers(-40, 40, 2)
    z = 300 + 12 * np.sin(own[:, 0] / 15) + 0.2 * own[:, 1] + rng.normal(0, 0.3, len(own))
    cells.put(own, z)
    cells.put(own.max(0) + np.array([(70, 3), (71, 3), (90, -20)]), np.array([340.0, 341.0, 280.0]))
    return cells, own


@pytest.mark.parametrize("seed", range(4))
def test_heights_of_a_place_do_not_depend_on_the_part_that_is_asked_for(seed):
    """Or neighbouring tiles would show their common edge in two places: a straight seam."""
    cells, own = hills(seed)
    low, high = 2.0 * own.min(0) - 620, 2.0 * own.max(0) + 680
    whole = cells.surface((*low, *high), 290.0)
    side = 61.4
    for west in np.arange(low[0], high[0] - side, 2 * side):
        for south in np.arange(low[1], high[1] - side, 2 * side):
            tile = cells.surface((west, south, west + side, south + side), 290.0)
            x, y = np.meshgrid(*(np.linspace(0, side, 9) + edge for edge in (west, south)))
            assert tile.at(x, y) == pytest.approx(whole.at(x, y), abs=0.01)


def test_ground_far_from_known_heights_goes_on_without_a_step_from_that_nearest_to_it():
    """To what is taken for the ground where nothing is known, far away."""
    cells = HeightCells(cell=2.0)
    places = np.stack(np.meshgrid(np.arange(40), np.arange(40)), -1).reshape(-1, 2)
    cells.put(places, 100 + 0.5 * places[:, 0])  # rises to the east by a quarter of a metre per m
    x = np.arange(0.0, 4000.0, 2.0)
    z = cells.surface((0.0, 20.0, 4000.0, 60.0), 150.0).at(x, np.full(len(x), 40.0))
    assert np.abs(np.diff(z)).max() < 2 * 0.5
    assert z[x < 70] == pytest.approx(100 + 0.25 * (x[x < 70] - 1), abs=0.5)
    assert z[x == 110] == pytest.approx(120, abs=3)
    assert z[-1] == pytest.approx(150, abs=1)
    assert np.diff(z).min() > -0.5


def test_a_map_of_which_nothing_is_known_is_level():
    cells = HeightCells(cell=2.0)
    assert np.all(cells.surface((0.0, 0.0, 90.0, 90.0), 12.5).z == 12.5)
    cells.put(np.array([(3, 3)]), np.array([20.0]))
    assert cells.surface((0.0, 0.0, 14.0, 14.0), 12.5).z == pytest.approx(20, abs=1)
    cells.put(np.array([(3, 3)]), np.array([np.nan]))
    assert np.all(cells.surface((0.0, 0.0, 90.0, 90.0), 12.5).z == 12.5)
