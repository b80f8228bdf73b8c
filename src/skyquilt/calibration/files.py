"""Output files of a calibration: the camera, its figures, plots, the detected boards, a page."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.board_views import Seen
from skyquilt.calibration.figures import Judged
from skyquilt.calibration.page import CalibrationInput, calibration_page, plots
from skyquilt.engine.clock import Clock, Steps, peak_memory_mb
from skyquilt.geometry.camera_formats import camera_to_opensfm
from skyquilt.imaging.grey import to_grey8
from skyquilt.model.board import Board, BoardView
from skyquilt.model.calibration import Calibration, rms
from skyquilt.model.camera import ADJUSTABLE, PARAMETERS, Camera
from skyquilt.raster.atomic import whole_file, write_text
from skyquilt.version import __version__

PLOTS = (
    "reprojection_centres.svg",
    "reprojection_corners.svg",
    "errors_centres.svg",
    "errors_corners.svg",
)
CONTRACT = ("cameras.json", "calibration.json", "report.html", "boards.jpg", *PLOTS)
"""Files of a calibration."""
_TILE, _ACROSS = 320, 5


def finish(
    output: Path,
    seen: Seen,
    board: Board,
    key: str,
    centres: Calibration,
    corners: Calibration,
    judged: Judged | None,
    clock: Clock,
    frames: Path,
    unknown: Sequence[str] = (),
) -> Steps[dict[str, Any]]:
    """Writes all files; calibration.json comes last. `judged` is None and `unknown` says what is
    left open where there were too few views to keep any out.
    """
    yield 0, 1
    write_text(
        output / "cameras.json", json.dumps({key: camera_to_opensfm(_stated(centres))}, indent=1)
    )
    figures = as_record(seen, board, key, centres, corners, judged)
    figures |= {"frames_from": frames.name, "unknown": list(unknown)}
    sheet = contact_sheet(seen)
    done, data = cv2.imencode(".jpg", sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    assert done
    with whole_file(output / "boards.jpg", needed=len(data)) as file:
        file.write(data.tobytes())
    shown = CalibrationInput(
        figures=figures,
        board=board,
        centres=centres,
        corners=corners,
        boards=sheet,
        title=frames.name,
        version=__version__,
    )
    for name, svg in zip(PLOTS, plots(shown), strict=True):
        write_text(output / name, svg)
    figures |= {
        "seconds": {**clock.seconds, "total": round(clock.total(), 3)},
        "cpu_seconds": round(clock.cpu_total(), 3),
        "peak_memory_mb": peak_memory_mb(),
    }
    write_text(output / "report.html", calibration_page(shown))
    write_text(output / "calibration.json", json.dumps(figures, indent=1, allow_nan=False))
    yield 1, 1
    return figures


def _stated(found: Calibration) -> Camera:
    """The camera with deviations that are valid for a flight; a dropped coefficient has its
    tolerance as deviation.
    """
    dropped = {name: tolerance for name, _, tolerance in found.dropped}
    return replace(
        found.camera,
        sigmas=tuple(float(dropped.get(name, found.sigma(name))) for name in PARAMETERS),
    )


def as_record(
    seen: Seen,
    board: Board,
    key: str,
    centres: Calibration,
    corners: Calibration,
    judged: Judged | None,
) -> dict[str, Any]:
    """The record of calibration.json."""
    return {
        "camera": key,
        "version": __version__,
        "board": {"columns": board.columns, "rows": board.rows, "square_m": board.square_m},
        "frames": seen.frames,
        "views_used": len(seen.views),
        "views_rejected": {r.name: r.reason for r in seen.rejected},
        "views": [_view_record(v, centres, k) for k, v in enumerate(seen.views)],
        "centres": _calibration_record(centres, judged),
        "corners": _calibration_record(corners, judged),
        "registration": None if judged is None else _registration_record(judged),
    }


def _registration_record(judged: Judged) -> dict[str, Any]:
    gain = 1 - judged.mse_undistorted_px2 / judged.mse_raw_px2 if judged.mse_raw_px2 > 0 else 0.0
    return {
        "pairs": judged.pairs,
        "pairs_unseen_by_the_camera": judged.unseen,
        "mse_raw_px2": round(judged.mse_raw_px2, 4),
        "mse_undistorted_px2": round(judged.mse_undistorted_px2, 4),
        "reduction_percent": round(100 * gain, 1),
    }


def _view_record(view: BoardView, centres: Calibration, k: int) -> dict[str, Any]:
    t = centres.poses[k].cam_t
    return {
        "name": view.name,
        "frames": view.frames,
        "squares": len(centres.observations[k].px),
        "rms_px": round(rms(centres.residuals[k]), 4),
        "contrast": round(view.contrast, 2),
        "distance_m": round(float(np.linalg.norm(t)), 4),
        "tilt_deg": round(
            float(np.degrees(np.arccos(min(1.0, abs(centres.poses[k].cam_R_board[2, 2]))))), 2
        ),
    }


def _calibration_record(found: Calibration, judged: Judged | None) -> dict[str, Any]:
    x, y = found.mean_error_px
    return {
        "parameters": {
            name: {
                "value": float(getattr(found.camera, name)),
                "sigma": found.sigma(name),
                "free": name in found.free,
            }
            for name in ADJUSTABLE
        },
        "dropped": {n: {"value": v, "tolerance": t} for n, v, t in found.dropped},
        "points": sum(len(s.px) for s in found.observations),
        "rms_px": round(found.rms_px, 4),
        "mean_error_px": [round(x, 4), round(y, 4)],
        "held_out_px": None
        if judged is None
        else {by: round(e, 4) for by, e in judged.held_out_px[found.marks].items()},
    }


def contact_sheet(seen: Seen) -> NDArray[np.uint8]:
    """All views (H, W, 3) RGB with the squares' centroids: white ones red, black ones green, the
    first ringed.
    """
    tiles = [_tile(v, seen.pictures) for v in seen.views]
    height = max(t.shape[0] for t in tiles)
    tiles += [np.zeros((height, _TILE, 3), np.uint8)] * (-len(tiles) % _ACROSS)
    rows = [np.hstack(tiles[k : k + _ACROSS]) for k in range(0, len(tiles), _ACROSS)]
    return np.ascontiguousarray(np.vstack(rows))


def _tile(view: BoardView, pictures: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    picture = pictures[view.name]
    scale = _TILE / view.width
    size = (_TILE, round(view.height * scale))
    grey = cv2.resize(to_grey8(picture), size, interpolation=cv2.INTER_AREA)
    tile = cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)
    for (row, column), _ in np.ndenumerate(view.centroids[..., 0]):
        x, y = (view.centroids[row, column] + 0.5) * scale - 0.5
        if not np.isfinite(x):
            continue
        at, colour = (
            (round(x * 16), round(y * 16)),
            (230, 60, 40) if (row + column) % 2 == 0 else (40, 190, 90),
        )
        cv2.circle(tile, at, 28, colour, -1, cv2.LINE_AA, 4)
        if row == column == 0:
            cv2.circle(tile, at, 90, (255, 220, 40), 1, cv2.LINE_AA, 4)
    label = view.name.encode("ascii", "replace").decode()[:44]
    return np.asarray(
        cv2.putText(
            tile, label, (5, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 220, 40), 1, cv2.LINE_AA
        )
    )
