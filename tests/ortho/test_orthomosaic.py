"""The small numbers of drawing: cells, previews and round resolutions."""

import numpy as np
import pytest

from skyquilt.model.raster import Grid
from skyquilt.ortho.companions import PROVENANCE, _thinned, preview_factor, reduced
from skyquilt.ortho.ground import round_gsd


def test_provenance_is_taken_from_the_middle_of_its_cell():
    numbers = np.arange(64).reshape(8, 8)
    assert _thinned(numbers).tolist() == [[18, 22], [50, 54]] and PROVENANCE == 4


@pytest.mark.parametrize(("height", "width"), [(8, 9), (9, 8), (5, 6), (2, 2), (1, 7), (4, 3)])
def test_cells_cut_off_by_the_rim_still_count(height, width):
    thin = _thinned(np.full((height, width), 7))
    assert thin.shape == (-(-height // PROVENANCE), -(-width // PROVENANCE)) and (thin == 7).all()


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
