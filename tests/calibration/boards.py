"""Simulated boards: frames of known truth."""

import numpy as np

from skyquilt.model.board import Board
from skyquilt.model.camera import Camera
from skyquilt.simulate.board import BoardPose, Chessboard, Sensor, five_poses, still, tilted
from skyquilt.simulate.camera import Lens

CHESS = Chessboard()
BOARD = Board(columns=CHESS.columns, rows=CHESS.rows, square_m=CHESS.square)
LENS = Lens(
    width=640, height=480, focal=690, offset_x=5, offset_y=-4, k1=-0.3, k2=0.12, p1=0.0, p2=0.0
)
CAMERA = Camera(width=640, height=480, focal=690, cx=324.5, cy=235.5, k1=-0.3, k2=0.12)
MIDDLE = np.array([CHESS.columns, CHESS.rows, 0]) * CHESS.square / 2


def poses(seed=0) -> list[BoardPose]:
    return five_poses(LENS, CHESS, np.random.default_rng([seed, 77]))


def frame(pose, seed=0, clutter=0.5, board=CHESS, noise=0.05):
    return still(
        LENS, board, pose, Sensor(noise=noise), np.random.default_rng([seed, 78]), clutter=clutter
    )


def truth(pose, points):
    """Where points (..., 3) of the board lie in the frame."""
    at = (points.reshape(-1, 3) - MIDDLE) @ pose.rotation.T + pose.shift
    return LENS.project(at, np.eye(3), np.zeros(3)).reshape(*points.shape[:-1], 2)


def frontal(spin=0.0, shift=(0.0, 0.0, 1.6)):
    return tilted(0.0, 0.0, spin, shift)


def to_truth(found, true):
    """Marks as found, in the order of the truth: a board may have been counted from its other
    end.
    """
    ways = (found, found[::-1, ::-1])
    return min(ways, key=lambda f: np.nanmean(np.linalg.norm(f - true, axis=-1)))
