"""Residuals and Jacobians of an adjustment against textbook formulas and differences."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.alignment.problem import (
    CAMERA,
    READOUT,
    State,
    attitude_error,
    linearise,
    linearised_points,
    residuals_px,
)
from skyquilt.alignment.setup import FISHEYE
from skyquilt.geometry.frames import cam_R_map_from_angles, rotation_from_vector
from tests.alignment.blocks import make_block, seen_by

ALL = np.arange(CAMERA) != FISHEYE


def bent(seed=0, cameras=2):
    """A small block of two cameras away from its minimum, every intrinsic in use."""
    lens = np.array([700.0, 402, 297, -0.06, 0.03, -0.01, 2e-3, -1e-3, 1.002, 0.0, 0.0])
    return make_block(
        seed, lines=2, per_line=2, points=40, lens=lens, free=ALL, cameras=cameras, overlap=0.6
    )


def test_residuals_are_projected_minus_seen():
    block = bent()
    found = residuals_px(block.problem, block.start)
    s, p = block.start, block.problem
    for k in range(0, len(found), 7):
        i = p.photo[k]
        px = seen_by(s.R[i], s.C[i], s.K[p.camera[i]], s.X[p.point[k]][None])[0]
        assert found[k] == pytest.approx(px - p.px[k], abs=1e-9)
    lin = linearise(p, s)
    assert lin.residual == pytest.approx(found / p.sigma_px[:, None])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_jacobians_are_those_of_the_residuals(seed):
    """Every photo, camera and point moved along every axis, through `State.moved`."""
    block = bent(seed)
    p, s = block.problem, block.start
    rng = np.random.default_rng(seed)
    moving = rng.normal(0, 5, (len(s.C), 3))
    p = replace(p, sigma_px=rng.uniform(0.2, 2, len(p.px)), velocity=moving)
    p = replace(p, sigma_turn=np.ones(len(s.C)))
    s.K[:, READOUT] = 0.03
    n, m, P = len(s.C), len(s.K), len(s.X)
    # which row sees a point is found to first order of what its observation is off
    for _ in range(3):
        p = replace(p, px=p.px + residuals_px(p, s))
    p = replace(p, px=p.px + rng.normal(0, 0.02, p.px.shape))
    lin = linearise(p, s)
    assert m == 2

    def difference(step, h):
        def at(sign):
            return linearise(p, s.moved(*(sign * h * part for part in step))).residual

        return (at(1) - at(-1)) / (2 * h)

    def close(exact, numeric):
        assert np.abs(exact - numeric).max() < 2e-6 * max(1.0, np.abs(numeric).max())

    zero = [np.zeros((n, 9)), np.zeros((m, 11)), np.zeros((P, 3))]
    for axis in range(9):
        step = [z.copy() for z in zero]
        step[0][:, axis] = 1
        close(lin.J_photo[:, :, axis], difference(step, 1e-5))
    for axis in np.flatnonzero(ALL):
        step = [z.copy() for z in zero]
        step[1][:, axis] = 1
        close(lin.J_camera[:, :, axis], difference(step, 1e-3 if axis < 3 else 1e-5))
    for axis in range(3):
        step = [z.copy() for z in zero]
        step[2][:, axis] = 1
        close(lin.J_point[:, :, axis], difference(step, 1e-4))


def test_fixed_intrinsics_have_no_derivative():
    block = bent()
    free = np.array([ALL, ~ALL])
    free[0, 3] = False
    lin = linearise(replace(block.problem, free=free), block.start)
    second = block.problem.camera[block.problem.photo] == 1
    assert not lin.J_camera[second].any() and not lin.J_camera[:, :, 3].any()
    assert np.abs(lin.J_camera[~second][:, :, [0, 4, 7]]).min() > 0
    none = linearise(replace(block.problem, free=np.zeros_like(free)), block.start)
    assert none.J_camera.shape == (len(second), 2, 0)
    whole = linearise(block.problem, block.start)
    for name in ("residual", "J_photo", "J_point"):
        assert np.array_equal(getattr(none, name), getattr(whole, name))
    residual, J_point = linearised_points(block.problem, block.start)
    assert np.array_equal(residual, whole.residual) and np.array_equal(J_point, whole.J_point)


def test_points_behind_a_camera_do_not_count():
    block = bent()
    s = replace(block.start, X=block.start.X.copy())
    s.X[0, 2] = 500.0
    lin = linearise(block.problem, s)
    mine = block.problem.point == 0
    assert lin.behind[mine].all() and not lin.behind[~mine].any()
    assert (
        not lin.residual[mine].any() and not lin.J_photo[mine].any() and not lin.J_point[mine].any()
    )
    assert np.isnan(residuals_px(block.problem, s)[mine]).all()


vectors = st.lists(st.floats(-1.8, 1.8), min_size=3, max_size=3).map(np.array)


@settings(max_examples=150)
@given(vectors, vectors)
def test_attitude_error_undoes_a_rotation(w, turn):
    """R0 exp(w) lies w from R0 (shorter than half a turn), in axes of the map whatever R0."""
    if np.linalg.norm(w) > 3.1:
        return
    R0 = rotation_from_vector(turn)
    assert attitude_error((R0 @ rotation_from_vector(w))[None], R0[None])[0] == pytest.approx(
        w, abs=1e-7
    )


@given(st.floats(-180, 180), st.floats(0, 89), st.floats(-40, 40), st.floats(-90, 90))
def test_a_compass_that_is_off_makes_no_tilt_wrong(yaw, pitch, roll, off):
    told = cam_R_map_from_angles(yaw + off, pitch, roll)
    error = attitude_error(cam_R_map_from_angles(yaw, pitch, roll)[None], told[None])[0]
    assert np.abs(error[:2]).max() < 1e-9
    assert abs(error[2]) == pytest.approx(np.radians(abs(off)), abs=1e-9)


def test_a_step_of_a_state():
    block = bent()
    s = block.start
    step = np.zeros((len(s.C), 6))
    step[1] = [0, 0, np.radians(10), 1, 2, 3]
    moved = s.moved(step, np.zeros_like(s.K), np.zeros_like(s.X))
    assert isinstance(moved, State)
    assert moved.C[1] - s.C[1] == pytest.approx([1, 2, 3])
    # a turn about the camera's own axis z: x goes to y
    assert (moved.R[1] @ s.R[1].T)[:, 0] == pytest.approx(
        [np.cos(np.radians(10)), np.sin(np.radians(10)), 0], abs=1e-12
    )
    assert (moved.R[0] == s.R[0]).all() and (moved.C[0] == s.C[0]).all()
