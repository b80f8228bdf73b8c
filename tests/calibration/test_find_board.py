import numpy as np
import pytest

from skyquilt.calibration.find_board import FindBoard
from skyquilt.model.board import Board
from skyquilt.simulate.board import Chessboard, tilted
from tests.calibration.boards import BOARD, CHESS, LENS, frame, frontal, poses, to_truth, truth


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1, 2, 3, 4])
def test_a_tilted_board_before_clutter_is_found_and_counted_right(number):
    pose = poses()[number]
    view = FindBoard()("", frame(pose, seed=number), BOARD)
    assert view, view.reason
    corners = truth(pose, BOARD.corners)
    assert np.nanmax(np.linalg.norm(to_truth(view.corners, corners) - corners, axis=-1)) < 0.15
    assert np.isfinite(view.centroids[BOARD.inner]).all()
    centres = truth(pose, BOARD.centres)
    off = np.linalg.norm(to_truth(view.centroids, centres) - centres, axis=-1)[BOARD.inner]
    assert off.max() < 2  # centroids of images, not images of centres
    assert off.mean() > 0.3  # so a result that hits the centres would be wrong


@pytest.mark.slow
def test_the_board_is_counted_clockwise_never_mirrored():
    for spin in (0, 130, 250):
        view = FindBoard()("", frame(frontal(spin=spin, shift=(0, 0, 1.9))), BOARD)
        assert view, (spin, view.reason)
        inner = view.corners
        x, y = inner[2, 4] - inner[2, 1], inner[3, 3] - inner[1, 3]
        assert x[0] * y[1] - x[1] * y[0] > 0


@pytest.mark.slow
def test_16_bit_counts_and_gaps_make_no_difference():
    image = frame(poses()[0])
    counts = np.round(image * 100).astype(np.uint16)
    gaps = image.copy()
    gaps[:20, :50] = np.nan
    plain, whole, holed = (FindBoard()("", i, BOARD) for i in (image, counts, gaps))
    assert np.abs(plain.corners - whole.corners).max() < 0.02
    assert np.abs(plain.corners - holed.corners).max() < 0.1


@pytest.mark.slow
def test_a_board_that_is_larger_than_said_is_refused():
    view = FindBoard()("", frame(frontal()), Board(columns=6, rows=5, square_m=0.1))
    assert not view
    assert "continues beyond 6 x 5" in view.reason
    assert "not corners" in view.reason


@pytest.mark.slow
def test_a_board_that_is_smaller_than_said_is_refused():
    view = FindBoard()("", frame(frontal()), Board(columns=8, rows=7, square_m=0.1))
    assert not view
    assert "squares were found" in view.reason


@pytest.mark.slow
@pytest.mark.parametrize("shift", [(-0.55, 0, 1.5), (0.5, 0.1, 1.4), (0, 0.45, 1.5)])
def test_a_board_half_outside_the_frame_is_refused(shift):
    view = FindBoard()("", frame(frontal(shift=shift)), BOARD)
    assert not view
    assert "outside the frame" in view.reason


def test_frames_without_a_board_are_refused_with_the_reason():
    rng = np.random.default_rng(1)
    blank, noise = np.full((480, 640), 300.0), rng.normal(300, 1, (480, 640))
    stripes = np.tile(np.repeat([0.0, 1.0], 40), (480, 8))
    assert "blank" in FindBoard()("", blank, BOARD).reason
    assert "blank" in FindBoard()("", np.full((480, 640), np.nan), BOARD).reason
    for picture in (noise, stripes):
        assert "no chess pattern" in FindBoard()("", picture, BOARD).reason


@pytest.mark.slow
def test_two_squares_swapped_make_another_pattern():
    image = frame(frontal(), clutter=0.0)
    board = Chessboard(columns=7, rows=6)
    a, b = truth(frontal(), np.array([[0.25, 0.25, 0], [0.35, 0.25, 0]])).round().astype(int)
    patch = image[a[1] - 22 : a[1] + 22, a[0] - 22 : a[0] + 22].copy()
    image[a[1] - 22 : a[1] + 22, a[0] - 22 : a[0] + 22] = image[
        b[1] - 22 : b[1] + 22, b[0] - 22 : b[0] + 22
    ]
    image[b[1] - 22 : b[1] + 22, b[0] - 22 : b[0] + 22] = patch
    assert board == CHESS
    assert not FindBoard()("", image, BOARD)


@pytest.mark.slow
def test_the_same_board_in_a_large_photo_lies_where_it_lay():
    big = LENS.scaled(1280, 960)
    pose = tilted(20, 15, 5, (0.0, 0.0, 1.7))
    from skyquilt.simulate.board import Sensor, still

    view = FindBoard()(
        "", still(big, CHESS, pose, Sensor(), np.random.default_rng(2), clutter=0.5), BOARD
    )
    small = FindBoard()("", frame(pose), BOARD)
    assert np.abs((view.corners + 0.5) / 2 - 0.5 - small.corners).max() < 0.15
