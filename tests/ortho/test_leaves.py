"""Crowns are drawn as a whole: lumps and slopes in leaves become level crowns with clean rims."""

import numpy as np
import pytest

from skyquilt.ortho import leaves
from skyquilt.ortho.leaves import calmed

CELL, TOP, RADIUS = 0.2, 8.0, 22
"""Side of a cell and height of crowns in m, and their radius in cells."""


def crowns(size=128, slope=6):
    """Heights of discs on level ground, one in each square of 64 cells, whose sides fall over
    `slope` cells; and how far each cell lies inside the middle of these sides.
    """
    r, c = np.mgrid[:size, :size]
    inside = RADIUS - np.hypot(r % 64 - 31.5, c % 64 - 31.5)
    return (TOP * np.clip(inside / slope + 0.5, 0, 1)).astype(np.float32), inside


def few(shape):
    """A ninth of the cells."""
    known = np.zeros(shape, bool)
    known[::3, ::3] = True
    return known


def test_slopes_of_crowns_become_steps_where_they_were():
    z, inside = crowns()
    before = z.copy()
    found = calmed(z, few(z.shape), CELL, 9)
    between = (found > 0.1 * TOP) & (found < 0.9 * TOP)
    assert ((before > 0.1 * TOP) & (before < 0.9 * TOP)).mean() > 0.1
    assert between.mean() < 0.005
    assert ((found > TOP / 2) == (inside > 0))[np.abs(inside) > 1.5].all()


def test_lumps_in_a_crown_become_level():
    z, inside = crowns(slope=1)
    random = np.random.default_rng(4)
    for r, c in random.integers(2, 126, (600, 2)):
        z[r - 1 : r + 1, c - 1 : c + 2] += random.choice([-3, 3])
    z[inside < 2] = crowns(slope=1)[0][inside < 2]
    whole = inside > 6
    before = np.abs(z - TOP)[whole]
    found = np.abs(calmed(z, few(z.shape), CELL, 13) - TOP)[whole]
    assert (before > 0.5).mean() > 0.15
    assert (found > 0.5).mean() < 0.02


def test_cells_far_finer_than_crowns():
    z, inside = crowns(slope=30)
    found = calmed(z, few(z.shape), CELL, 1001)
    assert np.isfinite(found).all() and found.max() <= TOP


def test_what_many_places_agree_on_stays():
    z, inside = crowns()
    known = few(z.shape) | (inside > -20)
    before = z.copy()
    assert (calmed(z, known, CELL, 9) == before).all()


def test_hillsides_stay():
    z = np.fromfunction(lambda r, c: (0.6 * r + 0.5 * c) * CELL, (90, 90)).astype(np.float32)
    before = z.copy()
    assert (calmed(z, few(z.shape), CELL, 9) == before).all()


@pytest.mark.parametrize("tile", [64, 40])
def test_tiles_do_not_show(monkeypatch, tile):
    z, _ = crowns(size=256)  # every surrounding of a tile holds the same range of heights
    z += np.float32(0.7) * (few(z.shape) & (z == TOP))
    known = few(z.shape)
    at_once = calmed(z.copy(), known, CELL, 9)
    monkeypatch.setattr(leaves, "TILE", tile)
    assert (calmed(z.copy(), known, CELL, 9) == at_once).all()
