"""Points eliminated part by part, against dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag

from skyquilt.alignment import equations
from skyquilt.alignment.adjust import adjust
from skyquilt.alignment.eliminated_points import (
    numbered,
    points_inverse,
    points_step,
    polish_points,
)
from skyquilt.alignment.equations import Equations, NearFactor
from skyquilt.alignment.problem import CAMERA, InCommon, linearise
from skyquilt.alignment.robust import observation_weights, prior_terms, robust_cost
from skyquilt.engine.kept import Keep
from skyquilt.engine.workers import HERE, Threads
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


@given(st.lists(st.integers(0, 19)))
def test_places_among_the_different_ones_are_numpys(values):
    given = np.array(values, np.int64)
    for found, right in zip(
        numbered(given, 20), np.unique(given, return_inverse=True), strict=True
    ):
        assert found.tolist() == right.tolist()


def test_pairs_that_share_a_point_are_found(monkeypatch):
    monkeypatch.setattr(equations, "LEAF", 0)
    problem = make_block(3, points=60).problem
    found = set(zip(*(side.tolist() for side in equations._together(problem)), strict=True))
    shown = [set(problem.photo[problem.point == k].tolist()) for k in range(60)]
    assert found == {(a, b) for s in shown for a in s for b in s if a < b} and len(found) > 50


def test_a_point_that_is_not_determined():
    with pytest.raises(np.linalg.LinAlgError):
        points_inverse(-np.eye(3)[None], 0.0)


@pytest.mark.parametrize(
    ("options", "common"),
    [({}, False), ({"cameras": 2, "lies": 0.05}, False), ({"cameras": 2}, True)],
)
def test_the_step_of_all_unknowns_solves_the_whole_equations(options, common):
    """Those of photos, cameras and points, without elimination; also where cameras have something
    in common."""
    block, damping = make_block(0, points=80, **options), 1e-3
    problem, state = block.problem, block.start
    if common:
        rows = np.random.default_rng(0).normal(0, 30, (4, state.K.size))
        problem = replace(problem, common=InCommon(rows=rows, zero=rows @ state.K.ravel() + 9.0))
    photos, cameras = Equations(problem, state).step(state, damping)
    points = points_step(problem, state, damping, photos, cameras)
    lin = linearise(problem, state)
    weight, _ = observation_weights(problem, lin.residual)
    n, m, P = len(state.C), len(state.K), len(state.X)
    J = np.zeros((len(problem.px), 2, 6 * n + CAMERA * m + 3 * P))
    row = np.arange(len(J))
    for k in range(6):
        J[row, :, 6 * problem.photo + k] = lin.J_photo[:, :, k]
    for k in range(CAMERA):
        J[row, :, 6 * n + CAMERA * problem.camera[problem.photo] + k] = lin.J_camera[:, :, k]
    for k in range(3):
        J[row, :, 6 * n + CAMERA * m + 3 * problem.point + k] = lin.J_point[:, :, k]
    J, w = J.reshape(2 * len(J), -1), np.repeat(weight, 2)
    H, g = (J * w[:, None]).T @ J, J.T @ (w * lin.residual.ravel())
    priors = prior_terms(problem, state)
    fixed = np.where(problem.free, priors.camera, 1.0)
    H[: 6 * n, : 6 * n] += block_diag(*priors.photo[:, :6, :6])
    own = np.arange(6 * n, 6 * n + CAMERA * m)
    H[own, own] += fixed.ravel()
    g[: 6 * n] += priors.photo_gradient[:, :6].ravel()
    g[6 * n : 6 * n + CAMERA * m] += priors.camera_gradient.ravel()
    H[np.diag_indices(len(H))] *= 1 + damping
    if common:
        H[np.ix_(own, own)] += priors.common.reshape(len(own), len(own))
    found = np.concatenate([photos.ravel(), cameras.ravel(), points.ravel()])
    assert np.abs(found).max() > 0.1
    off = np.abs(H @ found + g) / np.sqrt(np.diag(H) * float(g @ np.linalg.solve(H, g)))
    assert off.max() < 1e-5


@pytest.fixture
def factored(monkeypatch):
    """Counts the factors that are made; a handful of photos counts as many."""
    made, factor = [], equations.Factor

    def counted(matrix):
        made.append(matrix)
        return factor(matrix)

    monkeypatch.setattr(equations, "FACTORED", 3)
    monkeypatch.setattr(equations, "Factor", counted)
    return made


@pytest.mark.slow
def test_one_factor_serves_adjustments_of_many_photos(factored, monkeypatch):
    """They end where those with a factor for each step end."""
    block, near = make_block(3, lies=0.02), NearFactor()
    problem = block.problem
    wide = adjust(problem.with_loss(6.0), block.start, iterations=30, tolerance=1e-6, near=near)
    first = len(factored)
    found = adjust(problem, wide.state, iterations=60, tolerance=1e-9, damping=1e-6, near=near)
    again = adjust(problem, found.state, iterations=60, tolerance=1e-12, near=near)
    assert found.iterations + again.iterations > 8 and len(factored) <= first + 2
    monkeypatch.setattr(equations, "FACTORED", 10**6)
    exact = adjust(problem, wide.state, iterations=60, tolerance=1e-9, damping=1e-6)
    assert len(factored) > first + 8
    assert found.cost == pytest.approx(exact.cost, rel=1e-6)
    assert np.abs(found.state.C - exact.state.C).max() < 1e-3


@pytest.mark.slow
def test_an_interrupted_adjustment_of_many_photos_goes_on_with_the_same_figures(factored):
    block = make_block(4, lies=0.02)
    kept = {}

    def held(part, make):
        if part not in kept:
            kept[part] = make()
        return kept[part]

    def found():
        near, keep = NearFactor(), Keep(held=held)
        wide = adjust(block.problem.with_loss(6.0), block.start, keep=keep, near=near)
        return adjust(block.problem, wide.state, keep=keep.within("then"), near=near).state

    whole = found()
    for left in range(1, len(kept)):
        for part in list(kept)[left:]:
            del kept[part]
        again = found()
        assert np.array_equal(again.C, whole.C) and np.array_equal(again.X, whole.X)


def test_steps_that_cannot_be_factored_are_damped(factored, monkeypatch):
    """As before, with one factor for each step."""
    block = make_block(5)
    good = adjust(block.problem, block.start, iterations=40, tolerance=1e-9)
    factor, refused = equations.Factor, []

    def refuses(matrix):
        if len(refused) < 2:
            refused.append(matrix)
            raise np.linalg.LinAlgError
        return factor(matrix)

    monkeypatch.setattr(equations, "Factor", refuses)
    found = adjust(block.problem, block.start, iterations=40, tolerance=1e-9)
    assert len(refused) == 2 and found.cost == pytest.approx(good.cost, rel=1e-6)


@pytest.mark.parametrize("workers", [HERE, Threads(3)], ids=["one", "three"])
def test_a_state_is_moved_in_parts_as_at_once(monkeypatch, workers):
    """Points follow the photos and are refined under them; the cost is that of the new state."""
    block = make_block(6, lies=0.02)
    problem, state = block.problem, block.start
    photos, cameras = Equations(problem, state).step(state, 1e-3)
    stepped = state.moved(photos, cameras, points_step(problem, state, 1e-3, photos, cameras))
    expected = polish_points(problem, stepped)
    monkeypatch.setattr("skyquilt.alignment.problem.PART", 150)
    assert len(problem.pieces()) > 3
    moved, cost = Equations(problem, state, workers).moved(state, 1e-3)
    for name in ("R", "C", "K", "X", "turn"):
        np.testing.assert_allclose(getattr(moved, name), getattr(expected, name), atol=1e-9)
    assert np.abs(moved.X - stepped.X).max() > 1e-6
    assert cost == pytest.approx(robust_cost(problem, expected), rel=1e-12)
