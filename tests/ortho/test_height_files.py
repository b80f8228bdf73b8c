"""Files of heights."""

import numpy as np
import pytest

from skyquilt.model.surface import STRIP
from skyquilt.ortho.height_files import hillshade


def test_a_plane_is_as_bright_as_lambert_says():
    """Light from the north-west, 45 degrees high, on a plane that falls towards it by 30 degrees:
    cos(15 degrees); one that falls away by 30 degrees: cos(75 degrees).
    """
    rows, columns = np.mgrid[: 2 * STRIP + 7, :60].astype(np.float32)
    towards_east_and_south = (columns + rows) * np.float32(np.tan(np.radians(30)) / np.sqrt(2) * 2)
    for sign, angle in ((1, 15), (-1, 75), (0, 45)):
        found = hillshade(sign * towards_east_and_south, 2.0)
        inner = found[2:-2, 2:-2]
        assert np.ptp(inner) <= 1
        assert inner.mean() == pytest.approx(1 + 254 * np.cos(np.radians(angle)), abs=1.0)


def test_strips_do_not_show(monkeypatch):
    z = np.random.default_rng(1).normal(0, 1, (130, 40)).astype(np.float32)
    whole = hillshade(z, 0.5)
    for strip in (1, 7, 64):
        monkeypatch.setattr("skyquilt.ortho.height_files.STRIP", strip)
        assert np.array_equal(hillshade(z, 0.5), whole)
