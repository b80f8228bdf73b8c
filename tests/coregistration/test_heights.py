"""Fields of heights of one invented ground, moved by a known similarity, leaning, with gaps and
things of one season.
"""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from skyquilt.coregistration.heights import AlignHeights
from skyquilt.model.registration import RefusedRegistration
from skyquilt.model.surface import HeightField

CELL, SIZE = 0.1, 400
TRUTH = np.array([[1.006, -0.009, 1.3], [0.009, 1.006, -0.7], [0, 0, 1.0]])
"""Takes ground coordinates of a to those of b."""


def ground(seed=0, things=25):
    """(SIZE, SIZE) heights in m: gentle relief and domes up to 6 m."""
    rng = np.random.default_rng(seed)
    z = 40 * gaussian_filter(rng.standard_normal((SIZE, SIZE)), 60)
    y, x = np.mgrid[0:SIZE, 0:SIZE] * CELL
    for _ in range(things):
        cx, cy = rng.uniform(3, SIZE * CELL - 3, 2)
        radius, tall = rng.uniform(1.5, 4), rng.uniform(1, 6)
        z += tall * np.clip(1 - ((x - cx) ** 2 + (y - cy) ** 2) / radius**2, 0, None)
    return z


def field(z, known=None):
    known = np.ones(z.shape, bool) if known is None else known
    return HeightField(z=z.astype(np.float32), known=known, x0=0.0, y0=0.0, cell=CELL)


def moved(z, scale=1.006, plane=(0.0, 0.0), lean=(0.0, 0.0)):
    """What b's block makes of the ground: moved by TRUTH, its heights scaled and tilted, what
    stands up leaning.
    """
    back = np.linalg.inv(TRUTH)
    y, x = np.mgrid[0:SIZE, 0:SIZE] * CELL
    px = back[0, 0] * x + back[0, 1] * y + back[0, 2]
    py = back[1, 0] * x + back[1, 1] * y + back[1, 2]
    lifted = z - np.median(z)
    for _ in range(5):  # the place in a whose things lean to here
        up = map_coordinates(lifted, [py / CELL, px / CELL], order=1, mode="nearest")
        px = back[0, 0] * (x - lean[0] * up) + back[0, 1] * (y - lean[1] * up) + back[0, 2]
        py = back[1, 0] * (x - lean[0] * up) + back[1, 1] * (y - lean[1] * up) + back[1, 2]
    there = map_coordinates(z, [py / CELL, px / CELL], order=1, mode="nearest")
    return scale * there - plane[0] * x - plane[1] * y + 12.0


def off(fit):
    """Largest error in m over the ground."""
    at = np.array([[3, 3, 1], [37, 3, 1], [3, 37, 1], [37, 37, 1], [20, 20, 1]])
    return np.linalg.norm((at @ (fit.b_H_a - TRUTH).T)[:, :2], axis=1).max()


def start(dx=0.8, dy=-0.6):
    return np.array([[1, 0, 1.3 - 0.3 + dx], [0, 1, -0.7 + 0.5 + dy], [0, 0, 1.0]])


def test_the_place_is_found_to_a_fraction_of_a_cell():
    z, rng = ground(), np.random.default_rng(1)
    a, b = (field(v + rng.normal(0, 0.05, v.shape)) for v in (z, moved(z, plane=(0.004, -0.002))))
    found = AlignHeights()(a, b, start())
    assert not isinstance(found, RefusedRegistration)
    assert off(found) < 0.03  # a third of a cell
    assert found.apart_m < 0.08 and found.cells > 20_000


def test_gaps_and_what_only_one_season_has_draw_it_nowhere():
    """A fifth unknown in each, and a quarter of the domes gone in b."""
    rng = np.random.default_rng(2)
    summer, winter = ground(3, things=32), ground(3, things=24)
    gaps = [gaussian_filter(rng.standard_normal((SIZE, SIZE)), 6) > -0.035 for _ in "ab"]
    assert all(0.6 < g.mean() < 0.95 for g in gaps)
    found = AlignHeights()(field(summer, gaps[0]), field(moved(winter), gaps[1]), start())
    assert off(found) < 0.06


def test_a_block_that_leans_moves_what_stands_up():
    """By three degrees: the top of a dome of 6 m lies 0.3 m aside; the ground must be hit
    nevertheless.
    """
    z, slope = ground(4), 0.05
    leaning = field(moved(z, plane=(slope, 0.0), lean=(slope, 0.0)))
    found = AlignHeights()(field(z), leaning, start())
    assert off(found) < 0.06


def test_level_ground_tells_no_place():
    rng = np.random.default_rng(5)
    a, b = (field(rng.normal(0, 0.05, (240, 240))) for _ in "ab")
    found = AlignHeights()(a, b, start())
    assert isinstance(found, RefusedRegistration) and "unrelated" in found.reason


def test_other_ground_tells_no_place():
    found = AlignHeights()(
        field(ground(6)[:240, :240]), field(moved(ground(7))[:240, :240]), start()
    )
    assert isinstance(found, RefusedRegistration)


def test_fields_that_hardly_meet_are_refused():
    z = ground(8)
    away = start() + np.array([[0, 0, 500.0], [0, 0, 0], [0, 0, 0]])
    found = AlignHeights()(field(z), field(moved(z)), away)
    assert isinstance(found, RefusedRegistration) and "too few cells" in found.reason


@pytest.mark.parametrize("cell", [0.2, 0.37])
def test_coarser_cells_keep_their_place(cell):
    """Of a plane, the mean over a cell is the value at its middle, wherever it lies."""
    y, x = np.mgrid[0:300, 0:414] * CELL  # no whole number of cells along either axis
    known = np.ones(x.shape, bool)
    known[:50] = False
    plane = HeightField(
        z=(2 * x - 3 * y + 1).astype(np.float32), known=known, x0=0.0, y0=0.0, cell=CELL
    ).coarser(cell)
    row, column = np.nonzero(plane.known[:-1, :-1])
    wanted = 2 * (plane.x0 + plane.cell * column) - 3 * (plane.y0 + plane.cell * row) + 1
    whole = row > row.min() + 1
    assert (
        np.abs(plane.z[row, column] - wanted)[whole].max() < 0.02
    )  # to the far corner: cells are square
    assert plane.cell == pytest.approx(cell, rel=1e-6)
    assert not plane.known[: int(4.5 / cell)].any()
