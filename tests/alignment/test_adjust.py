"""The adjustment: its algebra, what it finds on simulated blocks, and whether its deviations are
honest.
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment import equations
from skyquilt.alignment.adjust import adjust, covariance, with_common_tilts
from skyquilt.alignment.eliminated_points import observation_equations, points_step, polish_points
from skyquilt.alignment.equations import Equations
from skyquilt.alignment.outcome import leave_one_out
from skyquilt.alignment.problem import CAMERA, attitude_error, linearise, residuals_px
from skyquilt.alignment.robust import prior_terms, robust_cost
from skyquilt.alignment.stages import prune
from skyquilt.geometry import block_cholesky
from skyquilt.geometry.block_cholesky import Factor
from skyquilt.geometry.frames import rotation_from_vector
from tests.alignment.blocks import (
    FREE,
    dense_covariance,
    dense_matrix,
    least_squares_only,
    make_block,
)


def unknowns_error(block, state):
    """(6n + 10m) errors in the order of the reduced system."""
    turned = attitude_error(state.R, block.truth.R)
    rotation = np.einsum("nij,nj->ni", block.truth.R, turned)  # about the camera's axes
    photos = np.concatenate([rotation, state.C - block.truth.C], 1)
    return np.concatenate([photos.ravel(), (state.K - block.truth.K).ravel()])


def free_mask(block):
    return np.concatenate([np.ones(6 * len(block.truth.C), bool), block.problem.free.ravel()])


# algebra


def dense_system(problem, state):
    """The normal matrix and gradient of plain weighted squares over all unknowns, by stacking every
    row.
    """
    n, m, P = len(state.C), len(state.K), len(state.X)
    lin = linearise(problem, state)
    N = len(lin.residual)
    A = np.zeros((2 * N, 6 * n + CAMERA * m + 3 * P))
    for k in range(N):
        i, c, p = problem.photo[k], problem.camera[problem.photo[k]], problem.point[k]
        rows = slice(2 * k, 2 * k + 2)
        A[rows, 6 * i : 6 * i + 6] = lin.J_photo[k]
        if lin.J_camera.shape[2]:
            A[rows, 6 * n + CAMERA * c : 6 * n + CAMERA * c + CAMERA] = lin.J_camera[k]
        A[rows, 6 * n + CAMERA * m + 3 * p : 6 * n + CAMERA * m + 3 * p + 3] = lin.J_point[k]
    e = lin.residual.ravel()
    prior_e = np.concatenate(
        [
            np.concatenate([attitude_error(state.R, problem.R0), state.C - problem.C0], 1).ravel(),
            (state.K - problem.K0).ravel(),
            np.nan_to_num(state.X - problem.X0).ravel(),
        ]
    )
    prior_w = np.concatenate(
        [
            np.concatenate(
                [1 / problem.sigma_R**2, np.where(np.isnan(problem.C0), 0, 1 / problem.sigma_C**2)],
                1,
            ).ravel(),
            (problem.free / problem.sigma_K**2).ravel(),
            np.where(np.isnan(problem.X0), 0, 1 / problem.sigma_X**2).ravel(),
        ]
    )
    about = np.eye(len(prior_w))  # priors on attitudes count about the map's axes
    for i in range(n):
        about[6 * i : 6 * i + 3, 6 * i : 6 * i + 3] = problem.R0[i].T
    prior_g = about.T @ (prior_w * np.nan_to_num(prior_e))
    return A.T @ A + about.T @ np.diag(prior_w) @ about, A.T @ e + prior_g


@pytest.fixture(scope="module", params=["free", "fixed"])
def small(request):
    """Two cameras whose intrinsics are free, or all fixed."""
    block = make_block(3, lines=2, per_line=3, points=60, cameras=2, overlap=0.6)
    X0 = block.problem.X0.copy()
    X0[:3] = block.truth.X[:3]
    X0[2, 2] = np.nan
    C0 = block.problem.C0.copy()
    C0[1] = np.nan
    free = block.problem.free & (request.param == "free")
    block = replace(block, problem=replace(block.problem, free=free))
    problem = least_squares_only(
        replace(block.problem, X0=X0, sigma_X=np.full(X0.shape, 0.05), C0=C0)
    )
    start = replace(block.start, C=np.where(np.isnan(C0), block.truth.C + 1, C0))
    return problem, start


def test_a_step_is_that_of_the_dense_normal_equations(small):
    problem, state = small
    H, g = dense_system(problem, state)
    n, m = len(state.C), len(state.K)
    used = np.concatenate(
        [np.ones(6 * n, bool), problem.free.ravel(), np.ones(3 * len(state.X), bool)]
    )
    expected = np.zeros(len(g))
    expected[used] = -np.linalg.solve(H[np.ix_(used, used)], g[used])
    photos, cameras = Equations(problem, state).step(state, 0.0)
    points = points_step(problem, state, 0.0, photos, cameras)
    assert photos.ravel() == pytest.approx(expected[: 6 * n], abs=1e-6)
    assert cameras.ravel() == pytest.approx(expected[6 * n : 6 * n + CAMERA * m], abs=1e-6)
    assert points.ravel() == pytest.approx(expected[6 * n + CAMERA * m :], abs=1e-5)


def test_the_covariance_is_the_dense_inverse_s(small):
    problem, state = small
    H, _ = dense_system(problem, state)
    n, m = len(state.C), len(state.K)
    used = np.concatenate(
        [np.ones(6 * n, bool), problem.free.ravel(), np.ones(3 * len(state.X), bool)]
    )
    whole = np.linalg.inv(H[np.ix_(used, used)])
    u = int(used[: 6 * n + CAMERA * m].sum())
    mine = dense_covariance(covariance(problem, state))
    keep = np.flatnonzero(used[: 6 * n + CAMERA * m])
    scale = np.sqrt(np.outer(np.diag(whole)[:u], np.diag(whole)[:u]))
    assert np.abs((mine[np.ix_(keep, keep)] - whole[:u, :u]) / scale).max() < 1e-5


def test_the_gradient_is_the_slope_of_the_robust_cost():
    """Cauchy on observations, pseudo-Huber on priors: g = half the derivative of the cost, so
    weights fit losses.
    """
    block = make_block(4, lines=1, per_line=3, points=30, lies=0.1, loss_px=2.0, loss_prior=1.5)
    problem = replace(
        block.problem, trust=0.4, X0=block.truth.X.copy(), sigma_X=np.ones_like(block.truth.X)
    )
    far = np.random.default_rng(1).normal(0, 4, block.start.C.shape)  # so far that losses matter
    state = replace(block.start, C=block.start.C + far)
    rng = np.random.default_rng(0)
    for part, gradient in enumerate(gradients(problem, state)):
        step = [np.zeros(gradients(problem, state)[k].shape) for k in range(3)]
        step[part] = rng.normal(0, 1, gradient.shape) * (1e-2 if part == 1 else 1.0)
        if part == 0:
            step[0][:, :3] = (
                0  # attitudes: the prior's Jacobian is the identity only near R0; see below
            )
        if part == 1:
            step[1] *= problem.free
        h = 1e-5
        up, down = (robust_cost(problem, state.moved(*(s * h * d for d in step))) for s in (1, -1))
        assert (step[part] * gradient).sum() == pytest.approx((up - down) / (4 * h), rel=2e-4)
    start = replace(state, R=problem.R0)
    photos = np.zeros((len(state.C), 6))
    photos[:, :3] = rng.normal(0, 1, (len(state.C), 3))
    rest = np.zeros(state.K.shape), np.zeros(state.X.shape)
    up, down = (robust_cost(problem, start.moved(s * 1e-6 * photos, *rest)) for s in (1, -1))
    gradient = gradients(problem, start)[0]
    assert (photos * gradient).sum() == pytest.approx((up - down) / 4e-6, rel=2e-4)


def gradients(problem, state):
    """Of photos (n, 6), cameras (m, 11) and points (P, 3), with the priors."""
    normal, priors = observation_equations(problem, state), prior_terms(problem, state)
    photos = priors.photo_gradient[:, :6].copy()
    photos[normal.seen] += normal.gp
    return photos, normal.gc + priors.camera_gradient, normal.gv


@pytest.mark.slow
@pytest.mark.parametrize(("points", "offset"), [(60, False), (3000, True)])
def test_the_divided_system_is_the_dense_one(monkeypatch, points, offset):
    """Nested dissection gives the step and the covariance of one dense matrix; 3000 points: several
    parts.
    """
    block = make_block(5, lines=2, per_line=18, points=points, cameras=2, overlap=0.5)
    X0 = block.problem.X0.copy()
    X0[::10] = block.truth.X[::10]
    surveyed = replace(block.problem, X0=X0, sigma_X=np.full(X0.shape, 0.02))
    problem = replace(surveyed, offset=True) if offset else block.problem
    whole = Equations(problem, block.start)
    assert len(whole.pattern.fronts) == 1
    monkeypatch.setattr(block_cholesky, "LEAF", 6)
    monkeypatch.setattr(equations, "LEAF", 6)
    divided = Equations(problem, block.start)
    assert len(divided.pattern.fronts) >= 5
    matrix, gradient = divided.reduced(block.start, 1e-3)
    expected, same = whole.reduced(block.start, 1e-3)
    assert dense_matrix(matrix) == pytest.approx(dense_matrix(expected), rel=1e-9, abs=1e-6)
    assert gradient == pytest.approx(same)
    solved = np.linalg.solve(dense_matrix(expected), gradient)
    assert Factor(matrix).solve(gradient) == pytest.approx(solved, rel=1e-6, abs=1e-9)
    for a, b in zip(whole.step(block.start, 1e-3), divided.step(block.start, 1e-3), strict=True):
        assert b == pytest.approx(a, rel=1e-6, abs=1e-8)
    found = covariance(problem, block.start)
    inverse = np.linalg.inv(dense_matrix(divided.reduced(block.start, 0.0)[0]))
    scale = np.sqrt(np.diag(inverse))
    for photos in ([3], [0, 1, 7], [5, 0, 35, 20]):  # the last ones share no point
        at = (6 * np.array(photos)[:, None] + np.arange(6)).ravel()
        at = np.concatenate([at, np.arange(6 * 36, len(inverse))])
        apart = (found.of(photos) - inverse[np.ix_(at, at)]) / np.outer(scale[at], scale[at])
        assert np.abs(apart).max() < 1e-6
    assert found.photo_sigmas.ravel() == pytest.approx(
        np.sqrt(np.diag(inverse)[: 6 * 36]).reshape(-1, 6)[:, 3:].ravel(), rel=1e-6
    )


def test_the_common_shift_is_that_of_an_adjustment_with_shifted_positions():
    """Measured centres that are all shifted leave the block where control points hold it."""
    block = make_block(5, lines=2, per_line=4, points=300, noise=0.0)
    X0 = block.problem.X0.copy()
    X0[:8] = block.truth.X[:8]
    C0 = block.truth.C + [40.0, -30.0, 12.0]
    problem = replace(
        block.problem, X0=X0, sigma_X=np.full(X0.shape, 0.01), C0=C0, K0=block.truth.K, offset=True
    )
    found = adjust(problem, block.start, iterations=60, tolerance=1e-12)
    assert np.abs(found.state.C - block.truth.C).max() < 0.15


def test_the_divided_adjustment_ends_where_the_whole_does(monkeypatch):
    block = make_block(6, lines=3, per_line=5)
    whole = adjust(block.problem, block.start, tolerance=1e-12)
    monkeypatch.setattr(block_cholesky, "LEAF", 3)
    monkeypatch.setattr(equations, "LEAF", 3)
    divided = adjust(block.problem, block.start, tolerance=1e-12)
    assert pytest.approx(whole.state.C, abs=1e-6) == divided.state.C
    assert divided.cost == pytest.approx(whole.cost, rel=1e-9)


def test_an_undetermined_system_has_no_covariance():
    block = make_block(6, lines=2, per_line=3)
    nothing = replace(
        block.problem,
        C0=np.full_like(block.problem.C0, np.nan),
        sigma_K=np.full_like(block.problem.sigma_K, -1.0),
        trust=-1.0,
    )
    with np.errstate(invalid="ignore"):
        assert covariance(nothing, block.start) is None


@pytest.mark.slow
def test_an_error_that_all_tilts_share_moves_the_block_as_its_covariance_says():
    """A strip of two cameras, with a lens that is adjusted: the same adjustment with one camera's
    measured attitudes turned by one deviation about the same axis of their own.
    """
    block = make_block(11, lines=1, per_line=8, cameras=2)
    problem, turned = block.problem, (block.problem.camera == 1)[:, None, None]
    first = adjust(problem, block.start, tolerance=1e-12).state
    alone = covariance(problem, first)
    stated = problem.sigma_R[:, 0]
    told = with_common_tilts(alone, problem, first, stated)
    for axis, by in enumerate(rotation_from_vector(np.radians(1.0) * np.eye(3)[:2])):
        R0 = np.where(turned, by @ problem.R0, problem.R0)
        moved = adjust(replace(problem, R0=R0), first, tolerance=1e-12).state
        photos, lens = np.split(told.common[:, 2 + axis], [6 * len(first.C)])
        assert pytest.approx(photos.reshape(-1, 6)[:, 3:], abs=0.012) == moved.C - first.C
        said = lens.reshape(-1, CAMERA) / problem.sigma_K
        assert pytest.approx(said, abs=0.01) == (moved.K - first.K) / problem.sigma_K
    assert np.abs(told.common[: 6 * len(first.C)].reshape(-1, 6, 4)[:, 3:]).max() > 0.4
    both = np.sqrt(np.diagonal(told.of([0, 7]))[[3, 4, 5, 9, 10, 11]].reshape(2, 3))
    assert pytest.approx(both) == told.photo_sigmas[[0, 7]]
    assert (told.photo_sigmas > alone.photo_sigmas).all()


# what it finds


def test_exact_observations_give_the_exact_block():
    """No noise at all, positions exact: the truth is the minimum, from a start metres and degrees
    away.
    """
    block = make_block(1, noise=0.0, gps=1.5)
    problem = replace(block.problem, C0=block.truth.C, R0=block.truth.R, K0=block.truth.K)
    found = adjust(problem, block.start, iterations=60, tolerance=1e-14)
    assert found.converged
    assert np.abs(residuals_px(problem, found.state)).max() < 1e-6
    assert pytest.approx(block.truth.C, abs=1e-6) == found.state.C
    assert pytest.approx(block.truth.X, abs=1e-5) == found.state.X
    assert pytest.approx(block.truth.K, abs=1e-4) == found.state.K


@pytest.mark.slow
def test_a_block_with_lies_is_recovered_within_its_deviations():
    """3 lines x 6, 0.3 px, 3 % lies, 1.5 m GPS. The window has two sides: suspiciously good fails
    too.
    """
    ratios, errors = [], []
    for seed in range(4):
        block = make_block(seed, lies=0.03, loss_prior=3.0)
        problem, state = block.problem, block.start
        for wide, limit in (
            (1000.0, 200.0),
            (20.0, 40.0),
            (5.0, 12.0),
            (2.0, 5.0),
        ):  # as `bundle` does
            state = adjust(problem.with_loss(wide), state, tolerance=1e-3).state
            problem, state = prune(problem, state, limit)
        found = adjust(problem, state, iterations=60, tolerance=1e-6)
        assert found.converged
        dropped = len(block.problem.px) - len(problem.px)  # a point seen twice goes with its lie
        assert 0.8 < dropped / block.wrong.sum() < 2.2
        e, mask = unknowns_error(block, found.state), free_mask(block)
        cov = dense_covariance(covariance(problem, found.state))[np.ix_(mask, mask)]
        ratios.append(float(e[mask] @ np.linalg.solve(cov, e[mask])) / mask.sum())
        errors.append(float(np.sqrt(((found.state.C - block.truth.C)[:, :2] ** 2).mean())))
        assert np.abs(found.state.K[0, 0] - block.truth.K[0, 0]) < 20
        right = residuals_px(problem, found.state)
        spare = right.size - 3 * len(found.state.X) - mask.sum()
        assert np.sqrt((right**2).sum() / spare) == pytest.approx(0.3, rel=0.06)
    # Cauchy's weights overstate the deviations of Gaussian observations by 27 %: 1 / 1.27 = 0.79
    assert 0.6 < np.mean(ratios) < 1.05
    # a common shift of 1.5 / sqrt(18) = 0.35 m remains, and the block bends a little
    assert 0.15 < np.mean(errors) < 0.9


@pytest.mark.slow
def test_deviations_are_calibrated():
    """Normalised squared errors of plain least squares follow chi-squared over 24 blocks.

    With priors as good as RTK's: the valley of worse ones is bent, and no covariance describes it
    (next test).
    """
    total, dof, per_axis = 0.0, 0, []
    tight = np.array([2.0, 0.5, 0.5, 3e-3, 3e-3, 1e-3, 1e-4, 1e-4, 1e-3, 1.0, 1e-3])
    for seed in range(24):
        block = make_block(
            100 + seed,
            lines=2,
            per_line=3,
            points=120,
            gps=0.1,
            tilt_deg=0.1,
            yaw_deg=0.2,
            sigma_k=tight,
        )
        problem = least_squares_only(block.problem)
        found = adjust(problem, block.start, iterations=40, tolerance=1e-10)
        e, mask = unknowns_error(block, found.state), free_mask(block)
        cov = dense_covariance(covariance(problem, found.state))[np.ix_(mask, mask)]
        total += float(e[mask] @ np.linalg.solve(cov, e[mask]))
        dof += int(mask.sum())
        per_axis.append((e[mask] / np.sqrt(np.diag(cov)))[-5:])
    assert dof == 24 * (36 + FREE.sum())
    assert abs(total / dof - 1) < 3.3 * np.sqrt(2 / dof)  # 0.15
    z = np.array(per_axis)  # focal length, principal point, distortion: each with its own deviation
    assert 0.6 < np.sqrt((z**2).mean()) < 1.4


@pytest.mark.slow
def test_the_truth_costs_what_chi_squared_says():
    """The cost at the true poses (points settled) less that of the minimum is chi-squared, however
    bent the valley.
    """
    rises = []
    for seed in range(16):
        block = make_block(100 + seed, lines=2, per_line=3, points=120)
        problem = least_squares_only(block.problem)
        found = adjust(problem, block.start, iterations=60, tolerance=1e-10)
        settled = block.truth
        for _ in range(5):
            settled = polish_points(problem, settled)
        rises.append(robust_cost(problem, settled) - found.cost)
    dof = 36 + int(FREE.sum())
    assert abs(np.mean(rises) / dof - 1) < 3.3 * np.sqrt(2 / dof / 16)  # 0.18


def test_the_cost_never_rises_and_convergence_is_told():
    block = make_block(8, lines=2, per_line=4, lies=0.05, loss_prior=3.0)
    costs = [
        adjust(block.problem, block.start, iterations=k, tolerance=0).cost for k in (1, 2, 3, 5, 8)
    ]
    start = robust_cost(block.problem, block.start)
    assert costs[0] <= start * (1 + 1e-12) and (np.diff(costs) <= 1e-9 * start).all()
    assert not adjust(block.problem, block.start, iterations=1, tolerance=0).converged
    done = adjust(block.problem, block.start, iterations=80, tolerance=1e-9)
    assert done.converged
    again = adjust(block.problem, done.state, iterations=80, tolerance=1e-9)
    assert again.iterations <= 2 and pytest.approx(done.state.C, abs=1e-3) == again.state.C


def test_polishing_moves_points_only_and_downhill():
    block = make_block(9, lines=2, per_line=3)
    start = replace(block.truth, X=block.truth.X + 0.3)
    moved = polish_points(block.problem, start)
    assert moved.C is start.C and moved.R is start.R and moved.K is start.K
    before = np.linalg.norm(start.X - block.truth.X, axis=1)
    after = np.linalg.norm(moved.X - block.truth.X, axis=1)
    assert np.median(after) < 0.5 * np.median(before)


def test_fixed_intrinsics_stay_and_free_ones_move():
    block = make_block(2)
    free = np.zeros((1, 11), bool)
    found = adjust(replace(block.problem, free=free), block.start)
    assert (found.state.K == block.start.K).all()
    free[0, 0] = True
    found = adjust(replace(block.problem, free=free), block.start)
    assert (found.state.K[0, 1:] == block.start.K[0, 1:]).all() and found.state.K[
        0, 0
    ] != block.start.K[0, 0]


@pytest.mark.slow
def test_surveyed_points_hold_the_block():
    """Four points known to a centimetre take out the GPS's common error."""
    before, after = [], []
    for seed in range(3):
        block = make_block(20 + seed, gps=3.0)
        well = np.argsort(-np.bincount(block.problem.point))[:40:10]
        X0 = block.problem.X0.copy()
        X0[well] = block.truth.X[well]
        held = replace(block.problem, X0=X0, sigma_X=np.full(X0.shape, 0.01))
        for problem, out in ((block.problem, before), (held, after)):
            state = adjust(problem, block.start, iterations=50, tolerance=1e-9).state
            out.append(np.abs(np.mean(state.C - block.truth.C, axis=0)[:2]).max())
            if problem is held:
                assert np.abs(state.X[well] - block.truth.X[well]).max() < 0.05
    assert np.mean(after) < 0.25 * np.mean(before)


# a strip


def strip(seed):
    """One line of 20 photos; observations with a bending systematic error of the lens that nobody
    models.
    """
    lens = np.array([700.0, 399.5, 299.5, -0.006, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    block = make_block(
        seed,
        lines=1,
        per_line=20,
        points=500,
        gps=1.5,
        lens=lens,
        free=np.zeros(11, bool),
        lens_errs=False,
        true_tilt_deg=0.0,
        tilt_deg=1.0,
    )
    wrong = replace(
        block.problem,
        K0=np.array([[700.0, 399.5, 299.5, 0, 0, 0, 0, 0, 1, 0, 0]]),
        R0=block.truth.R,
        trust=min(1.0, 40 * 20 / len(block.problem.px)),
    )
    return block, wrong


def tilt_deg(state):
    """(n,) angles of the optical axes off the vertical in degrees."""
    return np.degrees(np.arccos(np.clip(-state.R[:, 2, 2], -1, 1)))


@pytest.mark.slow
def test_a_strip_stays_straight_by_its_tilt_priors_and_bends_without():
    block, problem = strip(0)
    start = replace(block.start, R=block.truth.R, K=problem.K0)
    held = adjust(problem, start, iterations=60, tolerance=1e-7).state
    assert tilt_deg(held).max() < 1.0
    loose = replace(problem, sigma_R=np.full_like(problem.sigma_R, np.inf))
    bends = adjust(loose, start, iterations=60, tolerance=1e-7).state
    assert tilt_deg(bends).max() > 2.0


# leave one out


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_leaving_one_out_is_what_re_solving_gives(seed):
    """The identity on the covariance against six solutions, each without one photo's position."""
    block = make_block(40 + seed, lines=2, per_line=3, points=120)
    problem = least_squares_only(block.problem)
    found = adjust(problem, block.start, iterations=40, tolerance=1e-12).state
    predicted = leave_one_out(problem, found, covariance(problem, found))
    errors = []
    for i in range(len(found.C)):
        C0 = problem.C0.copy()
        C0[i] = np.nan
        without = adjust(replace(problem, C0=C0), found, iterations=40, tolerance=1e-12).state
        errors.append(without.C[i] - problem.C0[i])
    assert predicted == pytest.approx(np.sqrt(np.mean(np.square(errors), axis=0)), rel=0.01)
    ordinary = np.sqrt(np.mean((found.C - problem.C0) ** 2, axis=0))
    assert (np.array(predicted) > 1.05 * ordinary).all()


def test_too_few_positions_to_leave_one_out():
    block = make_block(1, lines=1, per_line=3, points=60)
    C0 = block.problem.C0.copy()
    C0[0] = np.nan
    problem = replace(block.problem, C0=C0)
    assert leave_one_out(problem, block.truth, covariance(problem, block.truth)) is None
    assert leave_one_out(block.problem, block.truth, None) is None


@pytest.mark.parametrize("lone", [0, 4])
def test_a_photo_of_which_others_tell_nothing_is_not_left_out_by_a_million_metres(lone):
    """Its position is known as well as it was measured, to rounding: nothing is left to divide
    by.
    """
    block = make_block(41, lines=2, per_line=3, points=120)
    found = adjust(block.problem, block.start, iterations=40).state
    full = covariance(block.problem, found)
    C0, photos = block.problem.C0.copy(), full.photos.copy()
    photos[lone, 3:6, 3:6] = np.diag(block.problem.sigma_C[lone] ** 2) * (1 - 1e-12)
    alone = replace(block.problem, C0=C0.copy())
    alone.C0[lone] = found.C[lone] - 1e-3 * block.problem.sigma_C[lone]
    C0[lone] = np.nan
    others = leave_one_out(replace(block.problem, C0=C0), found, full)
    assert leave_one_out(alone, found, replace(full, photos=photos)) == pytest.approx(others)
