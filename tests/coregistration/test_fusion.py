"""Pictures for people, pixel by pixel."""

import numpy as np

from skyquilt.coregistration.fusion import alpha, checkerboard, false_colour, shown, side_by_side

A = np.arange(64, dtype=np.uint8).reshape(8, 8)
B = (255 - A).astype(np.uint8)
SEEN = np.indices((8, 8))[1] < 6


def test_false_colour_is_grey_where_both_are_alike():
    same = false_colour(A, A, np.ones((8, 8), bool))
    assert (same == A[..., None]).all()
    other = false_colour(A, B, SEEN)
    assert (other[..., 1] == A).all()
    assert (other[..., 0] == np.where(SEEN, B, 0)).all() and (other[..., 2] == other[..., 0]).all()


def test_checkerboard_takes_turns():
    board = checkerboard(A, B, SEEN, squares=4)[..., 0]
    assert (board[:2, :2] == A[:2, :2]).all() and (board[:2, 2:4] == B[:2, 2:4]).all()
    assert (board[2:4, :2] == B[2:4, :2]).all()
    assert (board[:, 6:] == A[:, 6:]).all()  # b is not there


def test_alpha_ends():
    assert (alpha(A, B, SEEN, weight=0.0) == A[..., None]).all()
    full = alpha(A, B, SEEN, weight=1.0)
    assert (full[:, 6:] == A[:, 6:, None]).all()
    assert np.ptp(full[:, :6].astype(int), axis=2).max() > 50  # in colour


def test_side_by_side_joins_inliers():
    a, b = np.zeros((40, 50), np.uint8), np.zeros((30, 60), np.uint8)
    canvas = side_by_side(a, b, np.array([[10.0, 20.0]]), np.array([[30.0, 20.0]]))
    assert canvas.shape == (40, 50 + 8 + 60, 3)
    assert (
        np.abs(canvas[20, 20:80].astype(int) - (64, 200, 255)) < 40
    ).all()  # the line, at one height
    assert not (canvas[:10, :50]).any()
    assert (canvas[35, 60:] == 255).all()  # below the smaller picture
    none = np.zeros((0, 2))
    assert not side_by_side(a, b, none, none)[:30, :50].any()


def test_shown_stretches_and_leaves_gaps_black():
    values = np.linspace(20, 30, 101, dtype=np.float32).reshape(1, -1)
    valid = np.ones(values.shape, bool)
    valid[0, :3] = False
    levels = shown(values, valid)[0]
    assert levels[:3].tolist() == [0, 0, 0] and levels[3] == 0 and levels[-1] == 255
    assert (np.diff(levels[3:].astype(int)) >= 0).all()
    assert not shown(np.full((3, 3), np.nan), np.ones((3, 3), bool)).any()
