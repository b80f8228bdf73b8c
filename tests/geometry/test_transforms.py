"""Transformations are found exactly where data are exact, and the batched code equals OpenCV and
slow loops.
"""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from skyquilt.geometry.refine import refine
from skyquilt.geometry.transforms import (
    MINIMAL,
    MODELS,
    fit,
    fit_many,
    inverse,
    symmetric_transfer_errors,
    transfer,
)

FRAME = (1500, 1000)


def drawn(model, rng):
    """A plausible b_H_a between two photos of 1500 x 1000 px."""
    H = np.eye(3)
    H[:2, 2] = rng.uniform(-500, 500, 2)
    if model != "translation":
        angle, scale = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 2)
        H[:2, :2] = scale * np.array(
            [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        )
    if model in ("affine", "homography"):
        H[:2, :2] += rng.uniform(-0.2, 0.2, (2, 2))
    if model == "homography":
        H[2, :2] = rng.uniform(-1e-4, 1e-4, 2)
    return H


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(MODELS), st.integers(0, 10**6), st.integers(0, 40))
def test_exact_points_give_the_exact_model(model, seed, more):
    rng = np.random.default_rng(seed)
    H, a = drawn(model, rng), rng.uniform(0, FRAME, (MINIMAL[model] + more, 2))
    if (
        MINIMAL[model] > 2
        and min(
            abs(np.linalg.det([q - p, r - p]))
            for p in a[:4]
            for q in a[:4]
            for r in a[:4]
            if (p != q).any() and (q != r).any() and (p != r).any()
        )
        < 2e4
    ):
        return  # nearly on one line
    found = fit(model, a, transfer(H, a))
    corners = np.array([[0, 0], [1500, 0], [0, 1000], [1500, 1000.0]])
    assert found is not None and found[2, 2] == 1
    assert transfer(found, corners) == pytest.approx(transfer(H, corners), abs=1e-4)


@pytest.mark.parametrize("model", MODELS)
def test_many_at_once_equal_one_by_one(model):
    rng = np.random.default_rng(1)
    a, b = rng.uniform(0, FRAME, (2, 20, 9, 2))
    w = rng.uniform(0.1, 3, (20, 9))
    together = fit_many(model, a, b, w)
    for k in range(20):
        assert together[k] == pytest.approx(fit(model, a[k], b[k], w[k]), rel=1e-9, abs=1e-12)
    many = symmetric_transfer_errors(together, a[0], b[0])
    for k in range(20):
        there = cv2.perspectiveTransform(a[:1], together[k])[0] - b[0]
        back = cv2.perspectiveTransform(b[:1], np.linalg.inv(together[k]))[0] - a[0]
        assert many[k] == pytest.approx((there**2).sum(1) + (back**2).sum(1), rel=1e-6)


def test_linear_models_are_least_squares():
    """Against scipy's lstsq on the design matrix, weights included."""
    rng = np.random.default_rng(2)
    a, b, w = rng.uniform(0, FRAME, (30, 2)), rng.uniform(0, FRAME, (30, 2)), rng.uniform(0, 2, 30)
    one, zero, (x, y) = np.ones(30), np.zeros(30), a.T
    designs = {
        "translation": ([one, zero], [zero, one]),
        "similarity": ([x, -y, one, zero], [y, x, zero, one]),
        "affine": ([x, y, one, zero, zero, zero], [zero, zero, zero, x, y, one]),
    }
    for model, (first, second) in designs.items():
        D = np.concatenate([np.column_stack(first), np.column_stack(second)])
        target = np.r_[b[:, 0], b[:, 1]] - (np.r_[x, y] if model == "translation" else 0)
        root = np.sqrt(np.r_[w, w])
        expected = D @ np.linalg.lstsq(D * root[:, None], target * root, rcond=None)[0]
        expected = expected + (np.r_[x, y] if model == "translation" else 0)
        assert np.concatenate(transfer(fit(model, a, b, w), a).T) == pytest.approx(
            expected, abs=1e-8
        )


def test_homography_as_opencv():
    rng = np.random.default_rng(3)
    H, a = drawn("homography", rng), rng.uniform(0, FRAME, (60, 2))
    b = transfer(H, a) + rng.normal(0, 1, (60, 2))
    ours, theirs = (
        fit("homography", a, b),
        cv2.findHomography(a, b, 0)[0],
    )  # theirs ends with a refinement
    assert np.abs(transfer(ours, a) - transfer(theirs, a)).max() < 0.5
    four = cv2.getPerspectiveTransform(a[:4].astype(np.float32), b[:4].astype(np.float32))
    assert transfer(fit("homography", a[:4], b[:4]), a) == pytest.approx(
        transfer(four, a), rel=1e-3
    )


line = np.column_stack([np.linspace(0, 1000, 12), np.linspace(5, 800, 12)])


@pytest.mark.parametrize(
    ("model", "a"),
    [
        ("homography", line),
        ("affine", line),
        ("homography", line[:4]),
        ("affine", line[:3]),
        ("homography", np.r_[line[:3], [[700, 3.0]]]),
        ("similarity", np.ones((5, 2))),
        ("affine", np.ones((5, 2))),
        ("homography", np.ones((5, 2))),
        ("homography", np.full((5, 2), np.nan)),
        ("affine", np.full((5, 2), np.inf)),
        ("similarity", np.zeros((1, 2))),
        ("translation", np.zeros((0, 2))),
    ],
)
def test_what_points_do_not_determine_is_none(model, a):
    assert fit(model, a, a) is None
    other = np.random.default_rng(0).uniform(0, 1000, a.shape)
    assert fit(model, a, other) is None


def test_a_point_without_weight_does_not_count():
    rng = np.random.default_rng(4)
    a = rng.uniform(0, FRAME, (9, 2))
    for model in MODELS:
        H = drawn(model, rng)
        b = transfer(H, a)
        b[0] = 7e4
        assert transfer(fit(model, a, b, np.r_[0, np.ones(8)]), a[1:]) == pytest.approx(
            b[1:], abs=1e-6
        )


def test_inverse_and_horizon():
    rng = np.random.default_rng(5)
    H = np.stack([drawn("homography", rng) for _ in range(7)])
    assert inverse(H) @ H == pytest.approx(np.broadcast_to(np.eye(3), (7, 3, 3)), abs=1e-9)
    assert (symmetric_transfer_errors(np.zeros((3, 3)), line, line) == np.inf).all()
    assert (symmetric_transfer_errors(np.full((2, 3, 3), np.nan), line, line) == np.inf).all()
    with pytest.raises(ValueError, match="one of translation"):
        fit_many("sheared", np.zeros((1, 4, 2)), np.zeros((1, 4, 2)))


@pytest.mark.parametrize("model", MODELS)
def test_refinement_reaches_scipys_minimum(model):
    """Against scipy's least squares with numerical derivatives over the same residuals."""
    rng = np.random.default_rng(6)
    H, a = drawn(model, rng), rng.uniform(0, FRAME, (50, 2))
    b = transfer(H, a) + rng.normal(0, 3, (50, 2))
    start = fit(model, a, b)
    ours = refine(model, start, a, b)

    def matrix(p):
        M = np.eye(3)
        M[:2, 2] = p[:2]
        if model == "similarity":
            M[:2, :2] = [[p[2], -p[3]], [p[3], p[2]]]
        if model in ("affine", "homography"):
            M[:2, :2] = p[2:6].reshape(2, 2)
        if model == "homography":
            M[2, :2] = p[6:] * 1e-3
        return M

    first = {
        "translation": start[:2, 2],
        "similarity": np.r_[start[:2, 2], start[0, 0], start[1, 0]],
        "affine": np.r_[start[:2, 2], start[:2, :2].ravel()],
        "homography": np.r_[start[:2, 2], start[:2, :2].ravel(), start[2, :2] * 1e3],
    }[model]

    def residuals(p):
        M = matrix(p)
        return np.r_[(transfer(M, a) - b).ravel(), (transfer(np.linalg.inv(M), b) - a).ravel()]

    best = least_squares(residuals, first, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    reached = symmetric_transfer_errors(ours, a, b).sum()
    assert reached == pytest.approx(2 * best.cost, rel=1e-5)
    assert reached <= symmetric_transfer_errors(start, a, b).sum()
    assert fit(model, a, transfer(ours, a)) == pytest.approx(
        ours, rel=1e-5, abs=1e-8
    )  # still of the model
