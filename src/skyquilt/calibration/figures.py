"""Quality of a calibration: on views kept out, compared with corners, and by the effect of
undistortion on registration.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.calibrate import Calibrate
from skyquilt.engine.clock import Steps
from skyquilt.geometry.camera import undistort
from skyquilt.model.board import Board, BoardView
from skyquilt.model.calibration import Calibration, Marks, rms
from skyquilt.model.camera import Camera
from skyquilt.quality.registration_quality import mean_squared_error

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """Figures of both calibrations."""

    held_out_px: Mapping[Marks, Mapping[Marks, float]]
    """Points calibrated from -> points evaluated -> RMS error in px of the views kept out."""
    pairs: int
    """Pairs of views registered by a homography."""
    unseen: bool
    """Whether these pairs were not used for the camera that undistorts them."""
    mse_raw_px2: float
    """(6.2) of the raw corners."""
    mse_undistorted_px2: float
    """(6.2) of the undistorted corners."""


def judge(
    views: Sequence[BoardView],
    board: Board,
    ways: tuple[Calibrate, Calibrate],
    found: tuple[Calibration, Calibration],
) -> Steps[Judged]:
    """Of the calibrations from centres and from corners; with three views, each is judged by the
    other two.
    """
    yield 0, 3
    held: dict[Marks, HeldOut] = {}
    for done, way in enumerate(ways):
        held[way.marks] = hold_out(way, views, board)
        yield done + 1, 3
    errors: dict[Marks, Mapping[Marks, float]] = {
        marks: {way.marks: error_px(h, way, views, board) for way in ways}
        for marks, h in held.items()
    }
    pairs = _pairs(held["centres"])
    errors_of = [
        _registered(views[a], views[b], camera)
        for camera, a, b in pairs or _all(len(views), found[0].camera)
    ]
    raw, undistorted = np.array(errors_of).mean(0)
    yield 3, 3
    return Judged(
        held_out_px=errors,
        pairs=len(errors_of),
        unseen=bool(pairs),
        mse_raw_px2=float(raw),
        mse_undistorted_px2=float(undistorted),
    )


def _pairs(held: HeldOut) -> list[tuple[Camera, int, int]]:
    """Pairs of views that were kept out of the same camera."""
    return [
        (camera, a, b)
        for camera, part in zip(held.cameras, held.parts, strict=True)
        for a, b in combinations(part, 2)
    ]


def _all(count: int, camera: Camera) -> list[tuple[Camera, int, int]]:
    return [(camera, a, b) for a, b in combinations(range(count), 2)]


def _registered(a: BoardView, b: BoardView, camera: Camera) -> tuple[float, float]:
    """MSE (6.2) in px^2 of b registered to a by a homography through the corners: raw, and
    undistorted.
    """
    known = np.isfinite(a.corners[..., 0]) & np.isfinite(b.corners[..., 0])
    px_a, px_b = a.corners[known], b.corners[known]
    flat_a, flat_b = (undistort(camera, px) * camera.focal for px in (px_a, px_b))
    return _mse(px_a, px_b), _mse(flat_a, flat_b)


def _mse(reference: Array, moved: Array) -> float:
    H = cv2.findHomography(moved, reference, 0)[0]
    there = np.column_stack([moved, np.ones(len(moved))]) @ H.T
    return mean_squared_error(there[:, :2] / there[:, 2:], reference)
