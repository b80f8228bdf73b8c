"""End of a run: writes the files beside the rasters, the report, and finally the metrics."""

import json
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.clock import Clock, Steps, peak_memory_mb
from skyquilt.engine.folder import FILES
from skyquilt.geometry.frames import angles_from_cam_R_map
from skyquilt.imaging.nodes import STEP
from skyquilt.model.event import Note
from skyquilt.model.raster import Window
from skyquilt.ortho.companions import Drawn, provenance_step
from skyquilt.ortho.compose import Composer
from skyquilt.ortho.ground import Ground
from skyquilt.ortho.height_files import write_heights
from skyquilt.ortho.orthomosaic import used_photos, write_surface
from skyquilt.quality.seam_measurement import MeasuredSeams
from skyquilt.raster.atomic import write_text
from skyquilt.report.input import CameraResiduals, DepthPicture, ReportInput, SeamMark, Shot
from skyquilt.report.page import write_report
from skyquilt.report.parts import UNITS
from skyquilt.settings import MosaicSettings
from skyquilt.version import __version__
from skyquilt.workflows import run_files
from skyquilt.workflows.flow import AlignedPhotos

DEPTHS, DEPTH_WIDTH = 4, 420
"""Depth maps shown, and their width in px."""
CROP = 320
"""Side in map px of the crops of the worst places of the seams."""
MOST_CELLS = 2000
"""Cells along a side, about, of what the report shows of views and heights."""
MOST_RESIDUALS = 1_000_000
"""Observations of tie points, about, whose residuals the report shows."""
LATER = ("metrics.json",)
"""Files that are written after the report."""
LEAST_DISPARITIES = 12
"""Fewest disparities for a depth map."""


def finish_run(
    output: Path,
    aligned: AlignedPhotos,
    ground: Ground,
    drawn: Drawn,
    compose: Composer,
    seams: MeasuredSeams,
    metrics: dict[str, Any],
    settings: MosaicSettings,
    clock: Clock,
) -> Steps[dict[str, Any]]:
    """Writes all files of the run except the rasters; returns the metrics with times and memory."""
    yield 0, 3
    alignment, photos = aligned.alignment, aligned.photos
    write_surface(output, ground, alignment)
    write_heights(output, ground, drawn, alignment, settings.output)
    run_files.write_cameras(output / "cameras.json", alignment)
    run_files.write_shots(output / "shots.geojson", photos, alignment, used_photos(ground.views))
    run_files.write_footprints(output / "footprints.geojson", photos, alignment, ground.views)
    run_files.write_reconstruction(
        output / "reconstruction.json", photos, alignment, _colours(aligned, drawn)
    )
    run_files.write_run(
        output / "run.toml",
        settings.as_table(),
        aligned.given.title,
        run_files.source_commit(),
        alignment.method,
    )
    yield 1, 3
    metrics = metrics | _times(clock)
    page = report_input(output, aligned, ground, drawn, compose, seams, metrics, settings)
    write_report(output / "report.html", page)
    yield 2, 3
    metrics |= _times(clock)
    write_figures(output, metrics)
    if not alignment.frame.crs:
        yield Note(
            text="the map is not georeferenced: the photos carry no usable positions", warning=True
        )
    yield 3, 3
    return metrics


def _colours(aligned: AlignedPhotos, drawn: Drawn) -> NDArray[np.uint8]:
    """Colour (P, 3) of each tie point: that of the map at its place, grey where the map has
    none.
    """
    xyz, (rows, columns) = aligned.alignment.ties.xyz, drawn.preview.shape[:2]
    found = np.full((len(xyz), 3), 128, np.uint8)
    c, r = (np.rint(v) for v in drawn.preview_grid.pixel(xyz[:, 0], xyz[:, 1]))
    inside = (c >= 0) & (c < columns) & (r >= 0) & (r < rows)
    at = r[inside].astype(int), c[inside].astype(int)
    shown = drawn.preview[at][:, 3] > 0
    found[np.flatnonzero(inside)[shown]] = drawn.preview[at][shown, :3]
    return found


def report_input(
    output: Path,
    aligned: AlignedPhotos,
    ground: Ground,
    drawn: Drawn,
    compose: Composer,
    seams: MeasuredSeams,
    metrics: Mapping[str, Any],
    settings: MosaicSettings,
) -> ReportInput:
    """The data shown in the report."""
    frame, views = aligned.alignment.frame, drawn.views_grid
    every = 1 + max(drawn.views.shape) // MOST_CELLS
    number = drawn.views[::every, ::every]
    columns, rows = (np.arange(0, n, every) for n in (views.width, views.height))
    z = ground.surface.on(views.x(columns), views.y(rows))
    heights = np.where(number > 0, z, np.float32(np.nan))
    return ReportInput(
        metrics=metrics,
        doubts=aligned.alignment.notes,
        preview=drawn.preview,
        bounds=drawn.preview_grid.bounds,
        origin=frame.origin,
        crs=frame.crs,
        metric=frame.metric,
        views=number,
        views_bounds=views.bounds,
        surface=heights,
        surface_bounds=views.bounds,
        vertical_datum=frame.vertical_datum,
        shots=_shots(aligned, ground),
        residuals=_residuals(aligned),
        seams=_seam_marks(seams, drawn),
        worst_seams=_crops(compose, seams, drawn),
        depths=_depths(aligned),
        settings=settings.as_table(),
        values=None
        if drawn.preview_range is None
        else (*drawn.preview_range, UNITS.get(aligned.photos[0].unit, "")),
        processed=datetime.now().isoformat(timespec="seconds"),
        files=[name for name in FILES if (output / name).is_file() or name in LATER],
        title=Path(aligned.given.title).name,
        version=__version__,
    )


def _seam_marks(seams: MeasuredSeams, drawn: Drawn) -> list[SeamMark]:
    grid = drawn.provenance_grid
    return [
        SeamMark(
            x=float(grid.x(np.array(s.column))),
            y=float(grid.y(np.array(s.row))),
            disparity_px=float(np.hypot(s.dx, s.dy)) if s.ok else None,
        )
        for s in seams.report.samples
    ]


def _crops(compose: Composer, seams: MeasuredSeams, drawn: Drawn) -> list[NDArray[np.uint8]]:
    """The map around the worst places of the seams."""
    crops, step = [], provenance_step(compose.grid)
    for point in seams.worst:
        row, column = (
            int(np.clip(at * step - CROP // 2, 0, max(size - CROP, 0))) // STEP * STEP
            for at, size in ((point.row, compose.grid.height), (point.column, compose.grid.width))
        )
        pixels = compose(Window(row=row, column=column, height=CROP, width=CROP)).pixels
        crops.append(np.ascontiguousarray(np.broadcast_to(pixels[..., :3], (CROP, CROP, 3))))
    return crops


def _depths(aligned: AlignedPhotos) -> list[DepthPicture]:
    """False-colour depth maps (Y 4.8) of a few registrations, distributed over the survey."""
    usable = [j for j in aligned.alignment.joins if len(j.px) >= LEAST_DISPARITIES]
    if not usable:
        return []
    from skyquilt.matching.levelled import depth_map

    chosen = sorted({round(i) for i in np.linspace(0, len(usable) - 1, DEPTHS)})
    pictures = []
    for join in (usable[k] for k in chosen):
        photo = aligned.photos[join.photo]
        scale = DEPTH_WIDTH / photo.width
        shape = (max(1, round(photo.height * scale)), DEPTH_WIDTH)
        field = depth_map((join.px + 0.5) * scale - 0.5, join.d_px, shape)
        pictures.append(
            DepthPicture(
                name=photo.name,
                pixels=np.rint(255 * field).astype(np.uint8),
                features=len(join.px),
                removed=int((~join.levelled).sum()),
            )
        )
    return pictures


def _shots(aligned: AlignedPhotos, ground: Ground) -> list[Shot]:
    alignment = aligned.alignment
    outline = {v.photo: v.footprint for v in ground.views}
    block = {i: k for k, b in enumerate(alignment.blocks) for i in b}
    held = set(alignment.held)
    error = np.linalg.norm(alignment.ties.residual_px, axis=1)
    tied = alignment.ties.of_photos(sorted(alignment.poses))
    return [
        Shot(
            name=aligned.photos[i].name,
            xyz=pose.map_C,
            reported_xyz=aligned.priors[i].map_C,
            block=block.get(i, 0),
            method=alignment.method if i in held else "pose",
            footprint=outline.get(i, np.zeros((0, 2))),
            **_shot_figures(aligned, ground, i, error[tied[i]]),
        )
        for i, pose in sorted(alignment.poses.items())
    ]


def _shot_figures(
    aligned: AlignedPhotos, ground: Ground, i: int, error_px: NDArray[np.float64]
) -> dict[str, Any]:
    """What the table of photos says of one."""
    pose, photo, frame = aligned.alignment.poses[i], aligned.photos[i], aligned.alignment.frame
    yaw, _, _ = angles_from_cam_R_map(pose.cam_R_map)
    below = float(ground.surface.at(pose.map_C[:1], pose.map_C[1:2])[0])
    axis = float(np.clip(-pose.cam_R_map[2, 2], -1, 1))
    return {
        "time": photo.time.isoformat() if photo.time else "",
        "above_ground_m": float(pose.map_C[2]) - below if np.isfinite(below) else None,
        "yaw_deg": (yaw + frame.convergence_deg) % 360,
        "tilt_deg": float(np.degrees(np.arccos(axis))),
        "tie_points": len(error_px),
        "error_px": float(np.sqrt((error_px**2).mean())) if len(error_px) else None,
    }


def _residuals(aligned: AlignedPhotos) -> list[CameraResiduals]:
    alignment, ties = aligned.alignment, aligned.alignment.ties
    every = 1 + len(ties.photo) // MOST_RESIDUALS
    photo, px, residual = ties.photo[::every], ties.px[::every], ties.residual_px[::every]
    keys = sorted({alignment.camera_of[i] for i in np.unique(photo).tolist()})
    number = {key: k for k, key in enumerate(keys)}
    of_photo = [number.get(alignment.camera_of.get(i, ""), -1) for i in range(len(aligned.photos))]
    camera = np.array(of_photo)[photo]
    return [
        CameraResiduals(
            camera=key,
            width=alignment.cameras[key].width,
            height=alignment.cameras[key].height,
            px=px[camera == k],
            residual_px=residual[camera == k],
            every=every,
        )
        for key, k in number.items()
    ]


def _times(clock: Clock) -> dict[str, Any]:
    memory = peak_memory_mb()
    return {
        "seconds": {**clock.seconds, "total": round(clock.total(), 3)},
        "cpu_seconds": round(clock.cpu_total(), 3),
        "cpu_seconds_of_stage": dict(clock.cpu),
        "peak_memory_mb_of_stage": dict(clock.peak_mb),
        "peak_memory_mb": None if memory is None else round(memory, 1),
    }


def write_figures(output: Path, metrics: Mapping[str, Any]) -> None:
    """Writes metrics.json."""
    write_text(output / "metrics.json", json.dumps(metrics, indent=1, allow_nan=False))
