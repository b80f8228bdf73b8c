from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from skyquilt.calibration.calibrate import Calibrate, strangers
from skyquilt.calibration.figures import error_px, hold_out
from skyquilt.calibration.solve import solve
from skyquilt.calibration.start import start_camera, start_pose
from skyquilt.geometry.camera import project
from skyquilt.model.board import Board, BoardView
from skyquilt.model.calibration import BoardPose, Observations, rms
from skyquilt.model.camera import PARAMETERS, SQUARE, Camera
from tests.calibration.boards import BOARD, CAMERA, MIDDLE, frontal, poses


def pose_of(simulated):
    R = simulated.rotation
    return BoardPose(cam_R_board=R, cam_t=simulated.shift - R @ MIDDLE)


def view(name, pose, rng, noise, camera=CAMERA, board_error=0.0):
    """Centroids and corners as this project's own projection gives them: what is judged here is the
    fit.
    """
    from skyquilt.calibration.square_image import centroid_bias

    centres, corners = BOARD.centres.reshape(-1, 3) + board_error, BOARD.corners.reshape(-1, 3)
    px = project(camera, pose(centres)) + centroid_bias(camera, pose, centres, BOARD.square_m, 8.0)
    px = px + rng.normal(0, noise, px.shape)
    at = project(camera, pose(corners))
    return BoardView(
        name=name,
        width=640,
        height=480,
        contrast=10.0,
        rounding_px=np.full((BOARD.rows, BOARD.columns), 8.0),
        centroids=px.reshape(BOARD.rows, BOARD.columns, 2),
        corners=(at + rng.normal(0, noise, at.shape)).reshape(BOARD.rows - 1, BOARD.columns - 1, 2),
    )


def views(count=10, noise=0.1, seed=0, **more):
    rng = np.random.default_rng(seed)
    every = [p for k in range(-(-count // 5)) for p in poses(seed * 10 + k)][:count]
    return [view(f"v{k}", pose_of(p), rng, noise, **more) for k, p in enumerate(every)]


def test_without_noise_the_camera_is_exact():
    found = Calibrate()(views(count=10, noise=0.0), BOARD)
    assert found.camera.vector == pytest.approx(CAMERA.vector, abs=0.02)
    assert found.rms_px < 1e-4


def test_leaving_the_perspective_bias_in_shows():
    """Poses absorb most of it, and the focal length the rest."""
    seen = [Calibrate().observations(v, BOARD) for v in views(noise=0.0)]
    start = start_camera(seen, width=640, height=480)
    raw = solve(seen, start, [start_pose(s, start) for s in seen])
    assert abs(raw.camera.focal - CAMERA.focal) > 0.5
    assert rms(np.concatenate(raw.residuals)) > 0.004


@pytest.mark.parametrize(
    "free", [SQUARE, ("focal", "cx", "cy", "k1"), ("focal", "cx", "cy", "p1", "p2"), ("focal",)]
)
def test_the_fit_is_the_minimum_that_scipy_finds(free):
    seen = [Calibrate(marks="corners").observations(v, BOARD) for v in views(count=5)]
    start = replace(start_camera(seen, width=640, height=480), k1=-0.2, k2=0.05, p1=0.001)
    at = [start_pose(s, start) for s in seen]
    before = [p.cam_t.copy() for p in at]
    found = solve(seen, start, at, free)
    assert all((p.cam_t == t).all() for p, t in zip(at, before, strict=True))
    columns = [PARAMETERS.index(n) for n in free]
    held = [k for k in range(8) if k not in columns]
    assert (found.camera.vector[held] == start.vector[held]).all()

    def residuals(x):
        vector = start.vector
        vector[columns] = x[: len(free)] * scale
        camera = replace(start, **dict(zip(PARAMETERS, vector.tolist(), strict=True)))
        at = [
            BoardPose(cam_R_board=cv2.Rodrigues(p[:3])[0], cam_t=p[3:])
            for p in x[len(free) :].reshape(-1, 6)
        ]
        return np.concatenate(
            [(s.px - project(camera, p(s.board))).ravel() for s, p in zip(seen, at, strict=True)]
        )

    scale = np.array([100.0, 100, 100, 0.1, 0.1, 0.1, 0.01, 0.01])[columns]
    turns = [np.r_[cv2.Rodrigues(p.cam_R_board)[0].ravel(), p.cam_t] for p in found.poses]
    here = np.r_[found.camera.vector[columns] / scale, np.ravel(turns)]
    best = least_squares(residuals, here + 1e-4, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    assert (np.concatenate(found.residuals) ** 2).sum() <= 2 * best.cost * (1 + 1e-6)
    assert found.camera.focal == pytest.approx(best.x[0] * 100, abs=0.01)


@pytest.mark.parametrize("marks", ["centres", "corners"])
@pytest.mark.parametrize("count", [3, pytest.param(6, marks=pytest.mark.slow)])
def test_boards_that_are_not_tilted_give_a_camera_that_admits_it(marks, count):
    """Nothing tells the focal length from the distance."""
    rng = np.random.default_rng(0)
    seen = [
        view(f"v{k}", pose_of(frontal(0.3 * k, (0.02 * k, 0.0, 1.6))), rng, 0.1)
        for k in range(count)
    ]
    found = Calibrate(marks=marks)(seen, BOARD)
    assert found.camera.focal > 0
    assert found.sigma("focal") > 0.1 * found.camera.focal  # the command refuses it


@pytest.mark.slow
def test_small_coefficients_are_dropped_and_large_ones_stay():
    found = Calibrate()(views(count=15), BOARD)
    names = [n for n, _, _ in found.dropped]
    assert {"k3", "p1", "p2"} <= set(names)
    assert "k1" in found.free
    assert all(abs(v) < t for _, v, t in found.dropped)
    assert all(getattr(found.camera, n) == 0 and found.sigma(n) == 0 for n in names)
    tilted = Camera(
        width=640, height=480, focal=690, cx=324.5, cy=235.5, k1=-0.3, k2=0.12, p1=0.01, p2=-0.01
    )
    kept = Calibrate()(views(count=15, camera=tilted), BOARD)
    assert {"p1", "p2"} <= set(kept.free)


@pytest.mark.slow
def test_deviations_are_neither_too_small_nor_too_large():
    z = []
    for seed in range(8):
        found = Calibrate()(views(count=8, seed=seed), BOARD)
        for name in ("focal", "cx", "cy"):
            z.append((getattr(found.camera, name) - getattr(CAMERA, name)) / found.sigma(name))
    assert 0.4 < np.std(z) < 1.3
    assert np.mean(np.abs(z) < 2) > 0.9


@pytest.mark.slow
def test_errors_that_repeat_at_a_mark_are_not_averaged_away():
    """A board drawn 0.3 mm wrong is as wrong in 20 views as in five: its deviation must not shrink
    like noise.
    """
    rng = np.random.default_rng(5)
    bent = np.column_stack([rng.normal(0, 0.0003, (42, 2)), np.zeros(42)])
    few = Calibrate()(views(count=5, noise=0.05, board_error=bent), BOARD)
    many = Calibrate()(views(count=20, noise=0.05, board_error=bent), BOARD)
    assert many.sigma("focal") > 0.7 * few.sigma("focal")
    assert abs(many.camera.focal - CAMERA.focal) < 3 * many.sigma("focal")


@pytest.mark.slow
def test_a_view_of_another_board_is_a_stranger():
    seen = views(count=8)
    odd = views(count=1, seed=3)[0]
    shifted = odd.centroids.copy()
    shifted[2:4] += np.array([0.0, 6.0])
    found = Calibrate()([*seen, replace(odd, name="odd", centroids=shifted)], BOARD)
    assert list(strangers(found)) == ["odd"]
    assert strangers(Calibrate()(seen, BOARD)) == {}


@pytest.mark.slow
def test_views_kept_out_show_what_noise_there_is():
    seen = views(count=10, noise=0.2)
    way = Calibrate()
    held = hold_out(way, seen, BOARD)
    assert sorted(i for p in held.parts for i in p) == list(range(10))
    error = error_px(held, way, seen, BOARD)
    assert 0.9 < error / (0.2 * np.sqrt(2) * np.sqrt(1 - 6 / 40)) < 1.15


def test_a_wrong_lens_shows_in_views_kept_out():
    seen = views(count=10, noise=0.05)
    wrong = Camera.ideal(width=640, height=480, focal=690)
    errors = [np.sqrt((Calibrate().left_over(v, wrong, BOARD) ** 2).sum(1).mean()) for v in seen]
    assert min(errors) > 0.1


def test_every_parameter_has_its_place():
    found = Calibrate(tolerance=0.0)(views(), BOARD)
    assert found.free == SQUARE
    assert all(s > 0 for s in found.camera.sigmas[:8]) and found.camera.sigmas[8] == 0


def test_what_a_programmer_can_do_wrong():
    with pytest.raises(ValueError, match="one size"):
        Calibrate()(views()[:1], BOARD)
    with pytest.raises(ValueError, match="3 x 3"):
        Board(columns=2, rows=5, square_m=0.1)
    flat = Observations(name="", board=BOARD.centres[0], px=np.zeros((7, 2)))
    assert len(flat.px) == 7
