"""Heights that fall away from a photo's centre so gently that all of them are seen."""

import numpy as np
import pytest

from skyquilt.model.surface import Surface
from skyquilt.ortho.occlusion import MOST_STRETCHED, gentle

CENTRE = np.array([[0.0, 10.0, 40.0]])


def _block(high: float) -> Surface:
    """Level ground of 60 x 20 m with a block at 20 to 30 m east of the photo."""
    z = np.zeros((21, 61), np.float32)
    z[:, 20:31] = high
    return Surface(z=z, x0=0.0, y0=0.0, cell=1.0, source="tie points")


@pytest.mark.parametrize("high", [3.0, 12.0, 25.0])
def test_no_line_of_sight_is_stretched_by_more_than_told(high: float) -> None:
    """Where lines of sight meet heights z at x, they would meet level ground at x H / (H - z): from
    one cell to the next that grows by at least 1 / MOST_STRETCHED of a cell.
    """
    before = _block(high)
    found = gentle(before, CENTRE).z[10]
    x = np.arange(61.0)
    level = x * 40 / (40 - found)
    assert np.diff(level).min() > 1 / MOST_STRETCHED - 0.05
    sharp = x * 40 / (40 - before.z[10])
    assert np.diff(sharp).min() < 0  # the block hides ground


def test_ground_and_near_sides_stay() -> None:
    before = _block(12.0)
    after = gentle(before, CENTRE)
    outside = np.r_[0:20, 31:61]
    np.testing.assert_array_equal(after.z[:, outside], before.z[:, outside])
    assert (after.z <= before.z).all()
    assert (after.z[:, 30] < 3).all()


def test_level_ground_and_slopes_that_are_seen_stay() -> None:
    columns = np.tile(np.arange(61, dtype=np.float32), (21, 1))
    for fall in (0.0, 0.2, -0.2):
        z = 5 + fall * columns
        surface = Surface(z=z, x0=0.0, y0=0.0, cell=1.0, source="tie points")
        inner = np.s_[:, 1:-1]
        np.testing.assert_allclose(gentle(surface, CENTRE).z[inner], z[inner], atol=0.02)
