"""Errors whose value is known by algebra."""

import numpy as np
import pytest

from skyquilt.papers.pair_list import overlap_error


def shifted(x, y=0.0):
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def test_a_shift_is_its_length():
    assert overlap_error(shifted(13, 4), shifted(10), (100, 120), (100, 120)) == pytest.approx(5)
    assert overlap_error(np.eye(3), np.eye(3), (100, 120), (100, 120)) == 0
    assert overlap_error(7 * shifted(13, 4), shifted(10), (100, 120), (100, 120)) == pytest.approx(
        5
    )


def test_only_the_overlap_counts():
    """A scale error about the origin: RMS of 0.1 x over the left half, not over the whole."""
    wrong, truth = np.diag([1.1, 1.0, 1.0]), np.eye(3)
    half = overlap_error(wrong, truth, (100, 200), (100, 100))
    x = np.arange(0, 100, 200 / 64)
    assert half == pytest.approx(np.sqrt(((0.1 * x) ** 2).mean()), rel=0.02)


def test_no_overlap_and_the_horizon_are_infinite():
    assert overlap_error(np.eye(3), shifted(500), (100, 100), (100, 100)) == np.inf
    bent = np.array([[1, 0, 0], [0, 1, 0], [-1 / 50, 0, 1.0]])
    assert overlap_error(bent, np.eye(3), (101, 101), (101, 101)) > 1e3
