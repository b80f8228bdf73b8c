import numpy as np
import pytest

from skyquilt.calibration.assemble import WEIGHTS, Assemble, bimodality, cell_of, separation
from skyquilt.calibration.calibrate import Calibrate
from skyquilt.calibration.deviations import widened
from skyquilt.calibration.find_board import FindBoard
from skyquilt.calibration.series import StoodStill, mostly_still, runs
from skyquilt.simulate.board import Lamp, Sensor, sweep
from tests.calibration.boards import BOARD, CHESS, LENS, poses


def test_bimodality_by_hand():
    """Two clusters at 1 +- 0.1 and 5 +- 0.1: (0.1 + 0.1) / 4^2."""
    cell = np.array([0.9, 1.1, 4.9, 5.1])
    assert bimodality(cell) == pytest.approx(0.2 / 16)
    assert bimodality(cell, variance=True) == pytest.approx(0.02 / 16)
    assert bimodality(100 * cell, variance=True) == pytest.approx(0.02 / 16)  # has no unit


def test_bimodality_is_low_where_black_and_white_part():
    rng = np.random.default_rng(0)
    noise = rng.normal(20, 0.3, 500)
    parted = np.where(np.arange(500) % 2, 20.0, 24.0) + rng.normal(0, 0.3, 500)
    assert bimodality(parted) < bimodality(noise) / 5
    assert bimodality(np.full(9, 3.0)) == np.inf
    assert bimodality(np.full(9, np.nan)) == np.inf


def test_the_weight_is_where_the_heat_is():
    image = np.random.default_rng(1).normal(0, 0.05, (120, 160)).astype(np.float32)
    image[20:60:2, 20:60] += 4
    weight = Assemble(cell_px=30).weight(image, BOARD)
    assert weight[40, 40] > 5 * weight[100, 130]
    assert separation(image, 30).shape == (7, 10)


def test_cells_are_two_squares_wide():
    """Of a board that fills the frame: no board has larger squares."""
    assert cell_of((480, 640), BOARD) == 160


def test_equal_frames_assemble_to_themselves():
    frame = np.random.default_rng(2).normal(0, 1, (60, 80)).astype(np.float32)
    assert Assemble()([frame, frame, frame], BOARD) == pytest.approx(frame, abs=1e-4)


def few(pose, rng, frames=24):
    return list(sweep(LENS, CHESS, pose, Lamp(frames=frames, cooling=0.35), Sensor(), rng))


@pytest.mark.slow
def test_the_printed_weight_does_no_harm_if_sigma_is_a_variance():
    """(5.3) weighs by phi itself: with deviations it prefers frames without contrast, with
    variances it hardly prefers any.
    """
    pose, rng = poses()[0], np.random.default_rng(4)
    frames = few(pose, rng)
    contrasts = []
    for made in (Assemble(power=-1.0), WEIGHTS["printed"]()):
        found = FindBoard()("", made(frames, BOARD), BOARD)
        contrasts.append(found.contrast if found else 0.0)
    assert contrasts[1] > 2 * contrasts[0]
    flat = np.random.default_rng(5).normal(20, 0.3, 4000)
    of_noise = bimodality(flat, variance=True)
    assert of_noise == pytest.approx(0.285, abs=0.01)  # (1 - 2 / pi) / (4 / pi)


@pytest.mark.slow
def test_a_sweep_shows_the_whole_board_though_no_frame_does():
    rng = np.random.default_rng(4)
    frames = few(poses()[0], rng)
    assert not any(FindBoard()("", f, BOARD) for f in frames[::6])
    assembled = FindBoard()("", Assemble()(frames, BOARD), BOARD)
    assert assembled
    as_printed = FindBoard()("", Assemble(power=-1.0)(frames, BOARD), BOARD)
    assert not as_printed or as_printed.contrast < 0.7 * assembled.contrast


@pytest.mark.slow
def test_frames_of_one_pose_are_told_from_those_of_another():
    rng = np.random.default_rng(6)
    every = [f for p in poses()[:2] for f in few(p, rng, frames=16)]
    still = StoodStill()
    parts = runs((still.structure(f) for f in every), still)
    where = next(k for k, p in enumerate(parts) if 16 in p)
    assert parts[where][0] == 16
    assert mostly_still(parts)
    assert not mostly_still([[k] for k in range(9)])


@pytest.mark.slow
@pytest.mark.long
def test_sweeps_of_five_poses_calibrate_the_lens():
    for seed in range(2):
        rng = np.random.default_rng([seed, 5])
        views = []
        for k, pose in enumerate(poses(seed)):
            picture = Assemble()(sweep(LENS, CHESS, pose, Lamp(), Sensor(), rng), BOARD)
            views.append(FindBoard()(str(k), picture, BOARD, frames=92))
        assert all(views)
        corners = Calibrate(marks="corners")(views, BOARD)
        found = widened(Calibrate()(views, BOARD), corners)
        assert found.sigma("focal") < 0.02 * found.camera.focal
        assert abs(found.camera.focal - LENS.focal) < 2.5 * found.sigma("focal")
        assert found.rms_px < corners.rms_px
