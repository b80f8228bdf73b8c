"""What a large survey needs is told beforehand."""

from types import SimpleNamespace

import pytest

from skyquilt.quality.placement import ACROSS, MOST_PX, _across
from skyquilt.workflows.flow import memory_notes


def test_surveys_that_fit_are_not_told_anything():
    assert memory_notes(4900, None) == []
    assert memory_notes(10_000, 4.0) == []


def test_large_ones_are_told_what_would_do():
    (note,) = memory_notes(10_000, None)
    assert "10,000 photos takes about 1.9 GB, more than --memory 1.2" in note.text


@pytest.mark.parametrize("side_m", [100.0, 1000.0, 10_000.0])
def test_the_map_that_photos_are_compared_with_is_bounded(side_m):
    grid = SimpleNamespace(bounds=(0.0, 0.0, side_m, side_m))
    ground = SimpleNamespace(grid=grid, native_gsd=0.04)
    across = _across(ground, 1600)
    pixels = (side_m / (0.04 * 1600 / across)) ** 2
    assert across == ACROSS if side_m == 100.0 else across < ACROSS
    assert pixels <= 1.02 * MOST_PX
