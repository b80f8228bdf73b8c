"""Errors of a calibration on views that were not used for it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.calibrate import Calibrate
from skyquilt.model.board import Board, BoardView
from skyquilt.model.calibration import rms
from skyquilt.model.camera import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOut:
    """Cameras, each calibrated without some views, and these views."""

    cameras: tuple[Camera, ...]
    """One per part."""
    parts: tuple[tuple[int, ...], ...]
    """Indices of the views kept out of each camera."""


def hold_out(
    calibrate: Calibrate, views: Sequence[BoardView], board: Board, *, parts: int = 5
) -> HeldOut:
    """Calibrates once per part without the views of that part; with fewer than two views a part,
    one view a part.
    """
    count = len(views)
    parts = parts if count >= 2 * parts else count
    kept_out = tuple(tuple(range(k, count, parts)) for k in range(parts))
    cameras = tuple(
        calibrate([v for i, v in enumerate(views) if i not in out], board).camera
        for out in kept_out
    )
    return HeldOut(cameras=cameras, parts=kept_out)


def error_px(held: HeldOut, judge: Calibrate, views: Sequence[BoardView], board: Board) -> float:
    """RMS error in px of the views kept out, by the points of `judge` (not always those used for
    calibration).
    """
    return rms(
        np.concatenate(
            [
                judge.left_over(views[i], camera, board)
                for camera, part in zip(held.cameras, held.parts, strict=True)
                for i in part
            ]
        )
    )
