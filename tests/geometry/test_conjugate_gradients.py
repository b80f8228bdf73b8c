"""Conjugate gradients against NumPy's solver."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyquilt.geometry.conjugate_gradients import conjugate_gradients


def system(seed, size=30):
    """A positive definite matrix, one near to it, and a right-hand side, in odd units."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(2 * size, size))
    units = 10.0 ** rng.uniform(-3, 3, size)
    A = rows.T @ rows
    near = A + 0.1 * np.diag(rng.uniform(0, 1, size) * np.diag(A))
    return A * units[:, None] * units, near * units[:, None] * units, rng.normal(size=size) * units


@given(st.integers(0, 2**32 - 1))
def test_it_solves_to_the_error_asked_for(seed):
    A, near, b = system(seed)
    wanted = np.linalg.solve(A, b)

    def error(x):
        """In the norm of A, in which units do not matter."""
        return np.sqrt((x - wanted) @ A @ (x - wanted) / (wanted @ A @ wanted))

    def solved(tolerance):
        return conjugate_gradients(
            lambda x: A @ x, lambda r: np.linalg.solve(near, r), b, tolerance=tolerance, most=60
        )

    assert error(solved(1e-2)) < 2e-2
    assert error(solved(1e-6)) < 2e-6
    assert error(solved(1e-2)) > error(solved(1e-6))


def test_one_step_where_the_inverse_is_known():
    A, _, b = system(1)
    asked = []

    def times(x):
        asked.append(x)
        return A @ x

    x = conjugate_gradients(times, lambda r: np.linalg.solve(A, r), b, tolerance=1e-6, most=1)
    assert x == pytest.approx(np.linalg.solve(A, b), rel=1e-6) and len(asked) == 1


def test_too_few_steps_are_told():
    A, near, b = system(2)
    assert (
        conjugate_gradients(
            lambda x: A @ x, lambda r: np.linalg.solve(near, r), b, tolerance=1e-8, most=2
        )
        is None
    )
