"""Points eliminated part by part, against dense algebra."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyquilt.alignment.equations import Equations, points_inverse
from tests.alignment.blocks import make_block


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-4, 10.0]))
def test_the_inverse_of_each_factor(seed, damping):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(5, 7, 3)) * 10.0 ** rng.uniform(-3, 3, (5, 1, 3))
    blocks = np.swapaxes(rows, 1, 2) @ rows
    asked = blocks.copy()
    k = np.arange(3)
    asked[:, k, k] = asked[:, k, k] * (1 + damping) + 1e-12
    expected = np.linalg.inv(np.linalg.cholesky(asked))
    scale = np.abs(expected).max((1, 2), keepdims=True)
    assert (np.abs(points_inverse(blocks, damping) - expected) < 1e-7 * scale).all()


def test_a_point_that_is_not_determined():
    with pytest.raises(np.linalg.LinAlgError):
        points_inverse(-np.eye(3)[None], 0.0)


def test_what_is_not_kept_is_computed_again(monkeypatch):
    """The step of a problem too large to keep the ties of its points is the same."""
    block = make_block(0)
    kept = Equations(block.problem, block.truth).step(block.truth, 1e-4)
    monkeypatch.setattr("skyquilt.alignment.equations.KEPT", 0)
    again = Equations(block.problem, block.truth).step(block.truth, 1e-4)
    assert all(np.array_equal(a, b) for a, b in zip(kept, again, strict=True))
    assert all(np.abs(a).max() > 0 for a in kept[::2])
