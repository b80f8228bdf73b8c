"""Figures of the finished map."""

import numpy as np
from scipy import ndimage

from skyquilt.pipelines.judging import _holes


def test_holes_are_what_the_map_encloses():
    seen = np.zeros((20, 30), bool)
    seen[2:18, 3:27] = True
    seen[5:7, 5:8] = False  # six cells
    seen[10, 10] = seen[11, 11] = False  # two, that touch at a corner only
    seen[2:5, 20] = False  # open to the outside: a bay, not a hole
    assert _holes(seen, 4.0) == {"holes": 3, "holes_m2": 32.0}


def test_holes_against_scipy():
    rng = np.random.default_rng(0)
    for _ in range(20):
        seen = rng.random((40, 50)) > 0.4
        enclosed = ndimage.binary_fill_holes(seen) & ~seen
        assert _holes(seen, 1.0) == {"holes": ndimage.label(enclosed)[1], "holes_m2": float(enclosed.sum())}


def test_no_holes():
    assert _holes(np.ones((4, 4), bool), 1.0) == {"holes": 0, "holes_m2": 0.0}
    assert _holes(np.zeros((4, 4), bool), 1.0) == {"holes": 0, "holes_m2": 0.0}
