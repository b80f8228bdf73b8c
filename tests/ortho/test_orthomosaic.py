"""The small numbers of drawing: cells, previews and round resolutions."""

from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.errors import OutputError
from skyquilt.imaging.nodes import STEP
from skyquilt.model.raster import Grid
from skyquilt.ortho import companions, orthomosaic
from skyquilt.ortho.companions import (
    MOST_NUMBERS,
    PROVENANCE,
    _thinned,
    preview_factor,
    provenance_step,
    reduced,
)
from skyquilt.ortho.compose import Composed
from skyquilt.ortho.ground import round_gsd


def test_provenance_is_taken_from_the_middle_of_its_cell():
    numbers = np.arange(64).reshape(8, 8)
    assert _thinned(numbers, PROVENANCE).tolist() == [[18, 22], [50, 54]] and PROVENANCE == 4


@pytest.mark.parametrize(("height", "width"), [(8, 9), (9, 8), (5, 6), (2, 2), (1, 7), (4, 3)])
def test_cells_cut_off_by_the_rim_still_count(height, width):
    thin = _thinned(np.full((height, width), 7), PROVENANCE)
    assert thin.shape == (-(-height // PROVENANCE), -(-width // PROVENANCE)) and (thin == 7).all()


@pytest.mark.parametrize(("side", "step"), [(1000, 4), (30_000, 4), (56_067, 8), (300_000, 64)])
def test_the_provenance_of_large_maps_is_coarser(side, step):
    grid = Grid(west=0, north=0, gsd=0.05, width=side, height=side)
    cells = grid.coarser(provenance_step(grid))
    assert provenance_step(grid) == step and cells.width * cells.height <= 1.01 * MOST_NUMBERS


def test_blocks_of_a_coarser_provenance_fit_together(monkeypatch):
    grid = Grid(west=0, north=0, gsd=1, width=4 * STEP, height=3 * STEP)
    numbers = np.arange(grid.height * grid.width).reshape(grid.height, grid.width) % 5 + 1
    monkeypatch.setattr(companions, "MOST_NUMBERS", numbers.size / 64)
    whole = companions.Companions(grid, 1, np.dtype(np.uint8), 5)
    table, valid = np.arange(1, 7, dtype=np.uint32), np.ones((STEP, 2 * STEP), bool)
    for row in range(0, grid.height, STEP):
        for column in range(0, grid.width, 2 * STEP):
            composed = Composed(
                pixels=np.zeros((*valid.shape, 1), np.uint8),
                photo=numbers[row : row + STEP, column : column + 2 * STEP].astype(np.int32) - 1,
                views=np.ones((1, 2), np.uint16),
            )
            whole.add(row, column, companions.extras_of(composed, valid, table, grid))
    assert np.array_equal(whole.provenance, numbers[4::8, 4::8])
    assert whole.fine.gsd == 8 and (whole.views == 1).all()


def test_previews_average_what_is_valid():
    pixels = np.zeros((4, 4, 1), np.uint8)
    pixels[:, :, 0] = [[100, 0, 10, 30], [0, 0, 50, 70], [0, 0, 0, 0], [0, 0, 0, 0]]
    valid = np.array([[1, 0, 1, 1], [0, 0, 1, 1], [0, 0, 0, 0], [0, 0, 0, 0]], bool)
    mean, share = reduced(pixels, valid, 2)
    assert share.tolist() == [[64, 255], [0, 0]]
    assert mean[0, 1, 0] == 40 and mean[0, 0, 0] == pytest.approx(100, abs=2) and not mean[1].any()


@pytest.mark.parametrize(
    ("gsd", "rounded"), [(0.01647, 0.016), (0.0949, 0.095), (1.26, 1.3), (0.1, 0.1), (12.4, 12.0)]
)
def test_resolutions_have_two_digits(gsd, rounded):
    assert round_gsd(gsd) == pytest.approx(rounded, rel=1e-12)


def test_previews_stay_small():
    for size, factor in ((1600, 1), (1601, 2), (3200, 2), (100000, 64)):
        assert preview_factor(Grid(west=0, north=0, gsd=1, width=size, height=10)) == factor


@pytest.mark.parametrize("opens", [True, False])
def test_blocks_of_an_earlier_map_that_are_damaged_are_drawn_again(monkeypatch, opens):
    """They ended the run in a traceback."""

    class Files:
        def __init__(self, folder):
            if not opens:
                raise OutputError("damaged")

        def __enter__(self):
            return self

        def __exit__(self, *why):
            return None

        def block(self, block, *given):
            if block == 2:
                raise OutputError("damaged")
            return block

    monkeypatch.setattr(orthomosaic, "FormerFiles", Files)
    monkeypatch.setattr(orthomosaic, "shot_numbers", lambda compose: {})
    drawing = SimpleNamespace(
        growth=SimpleNamespace(earlier=SimpleNamespace(shown=())),
        compose=SimpleNamespace(grid=None),
        output=None,
    )
    found = list(orthomosaic.Drawing._former(drawing, dict.fromkeys([1, 2, 3]), None))
    assert found == ([1, None, 3] if opens else [None] * 3)
