"""Heights of growing maps: cells hold medians, and follow later points."""

import numpy as np
import pytest

from skyquilt.surface.cells import WEIGHT, HeightCells


def test_cells_hold_the_medians_of_their_points():
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-9, 9, (700, 2)), rng.normal(size=700)])
    cells = HeightCells(cell=2.0)
    touched = cells.add(xyz)
    assert touched == set(cells.z) == {tuple(p) for p in np.floor(xyz[:, :2] / 2).astype(int).tolist()}
    for column, row in touched:
        inside = (np.floor(xyz[:, :2] / 2) == (column, row)).all(1)
        assert cells.z[column, row] == np.median(xyz[inside, 2])


def test_later_points_move_a_cell_part_of_the_way_or_replace_it():
    cells = HeightCells(cell=1.0)
    cells.add(np.array([(0.5, 0.5, 10.0), (3.5, 0.5, 1.0)]))
    assert cells.add(np.array([(0.2, 0.9, 20.0)])) == {(0, 0)}
    assert cells.z == {(0, 0): pytest.approx(10 + WEIGHT * 10), (3, 0): 1.0}
    cells.add(np.array([(0.2, 0.9, 5.0)]), anew=True)
    assert cells.z[0, 0] == 5.0
    assert cells.add(np.zeros((0, 3))) == set()
