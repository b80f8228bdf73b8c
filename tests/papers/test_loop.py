"""`image --image-search loop`: closing errors are spread, and nothing else changes."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.papers.loop import Tie, _solved
from tests.alignment.flights import fly, lawn, line
from tests.papers.test_chain import chain, ground_error, run


def rectangle():
    """Once around, the last photos over the first ones."""
    sides = [
        line(8, heading=0.0),
        line(4, start=(25.0, 175.0), heading=90.0),
        line(8, start=(100.0, 150.0), heading=180.0),
        line(3, start=(75.0, -25.0), heading=270.0),
        line(3, start=(0.0, -15.0), heading=0.0),
    ]
    return np.concatenate(sides)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "left"), [("similarity", 0.5), ("homography", 0.85)])
def test_a_loop_is_closed(model, left):
    """Similarities on top of a chain of homographies leave their bending as it is."""
    flight = fly(rectangle(), noise_px=0.6, points=8000)
    open_, shut = (run(flight, replace(chain(model), loop=way)) for way in (False, True))
    assert len(shut.joins) > len(open_.joins) == len(flight.photos) - 1
    assert ground_error(flight, shut) < left * ground_error(flight, open_)
    assert any("closings of loops" in n for n in shut.notes)


@pytest.mark.slow
def test_lines_side_by_side_are_loops_too():
    flight = fly(lawn(3, 8), noise_px=0.6, points=8000)
    open_, shut = (run(flight, replace(chain(), loop=way)) for way in (False, True))
    assert ground_error(flight, shut) < 0.7 * ground_error(flight, open_)


def test_a_strip_without_a_loop_stays_as_it_is():
    flight = fly(line(8))
    open_, shut = (run(flight, replace(chain(), loop=way)) for way in (False, True))
    for i in range(8):
        assert np.array_equal(open_.poses[i].map_C, shut.poses[i].map_C)
    assert any("0 closings" in n for n in shut.notes)


def test_known_turns_scales_and_shifts_come_back():
    """Photos on a ring, each with a similarity of its own; ties without error undo them, and one
    wrong tie of 40 does not matter.
    """
    rng = np.random.default_rng(0)
    n = 30
    a = np.exp(1j * rng.normal(0, 0.1, n) + rng.normal(0, 0.05, n))
    t = rng.normal(0, 1, n) + 1j * rng.normal(0, 1, n)
    a[0], t[0] = 1, 0
    ties = []
    for k in range(40):
        i, j = (k % n, (k + 1) % n) if k < n else tuple(rng.choice(n, 2, replace=False))
        place = complex(*rng.normal(0, 5, 2))
        at = [(place - t[m]) / a[m] for m in (i, j)]
        ties.append(Tie(a=int(i), b=int(j), at_a=at[0], at_b=at[1], ratio=a[i] / a[j]))
    ties.append(replace(ties[-1], at_b=ties[-1].at_b + 30, ratio=1.6 + 0j))
    scale, shift = _solved(range(n), ties)
    assert np.abs(scale - a).max() < 0.01 and np.abs(shift - t).max() < 0.2
