"""The end of the story: seams measured, files written, the report."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt import __version__
from skyquilt.engine.clock import Clock, Steps, peak_memory_mb
from skyquilt.matching.levelled import depth_map
from skyquilt.model.event import Note
from skyquilt.model.poses import Alignment, Prior
from skyquilt.ortho import orthomosaic as drawing
from skyquilt.ortho.compose import Composer
from skyquilt.ortho.orthomosaic import Drawn, Ground
from skyquilt.ortho.patches import grey_pairs
from skyquilt.quality.seam_points import SeamPoint, seam_points
from skyquilt.quality.seams import PatchPairs, SeamReport, seam_disparity
from skyquilt.raster.atomic import write_text
from skyquilt.report.input import CameraResiduals, DepthPicture, ReportInput, SeamMark, Shot
from skyquilt.report.page import write_report
from skyquilt.workflows import run_files as files
from skyquilt.workflows.methods import MosaicSettings
from skyquilt.workflows.photo_features import Intake

DEPTHS, DEPTH_WIDTH = 4, 420
"""Depth maps shown, and their width in px."""
LEAST_DISPARITIES = 12
"""Disparities that make a depth map."""
SEAM_POINTS = 300
"""Points at which seams are measured."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Seams:
    """Seam disparity: the figures, and where they were taken."""

    report: SeamReport
    """All samples."""
    figures: Mapping[str, Any]
    """What metrics.json says."""


def seams(compose: Composer, drawn: Drawn, ground: Ground) -> Steps[Seams]:
    """Measures the disparity along all seams of the finished map."""
    yield 0, 1
    shown = drawing.used_photos(ground.views)
    views = {
        k + 1: next(v for v in ground.views if v.photo == photo) for k, photo in enumerate(shown)
    }
    points = seam_points(drawn.provenance, limit=SEAM_POINTS)
    grid = drawn.provenance_grid

    def patches(at: Sequence[SeamPoint]) -> PatchPairs:
        xy = np.array([(grid.x(np.array(p.column)), grid.y(np.array(p.row))) for p in at])
        a, b, seen = grey_pairs(
            [views[p.a] for p in at],
            [views[p.b] for p in at],
            xy,
            ground.surface,
            compose.pixels,
            ground.native_gsd,
        )
        return PatchPairs(a=a, b=b, seen=seen)

    report = seam_disparity(points, patches, gsd_m=ground.native_gsd)
    yield 1, 1
    return Seams(report=report, figures=_figures(report))


def _figures(report: SeamReport) -> dict[str, Any]:
    def short(value: float | None) -> float | None:
        return None if value is None else round(value, 3)

    return {
        "median": short(report.median_px),
        "p95": short(report.p95_px),
        "median_cm": short(report.median_cm),
        "p95_cm": short(report.p95_cm),
        "measured": report.measured,
        "attempted": report.attempted,
    }


def finish(
    output: Path,
    taken: Intake,
    priors: Sequence[Prior],
    alignment: Alignment,
    ground: Ground,
    drawn: Drawn,
    seen: Seams,
    figures: dict[str, Any],
    settings: MosaicSettings,
    clock: Clock,
    folder: Path | Sequence[Path],
) -> Steps[dict[str, Any]]:
    """Writes every file of the run but the rasters already there; metrics.json comes last."""
    yield 0, 3
    order = drawing.used_photos(ground.views)
    drawing.write_surface(output, ground, alignment)
    files.write_cameras(output / "cameras.json", alignment)
    files.write_shots(output / "shots.geojson", taken.photos, alignment, order)
    files.write_footprints(output / "footprints.geojson", taken.photos, alignment, ground.views)
    files.write_reconstruction(output / "reconstruction.json", taken.photos, alignment, None)
    source = str(folder) if isinstance(folder, Path) else f"{len(folder)} files"
    files.write_run(
        output / "run.toml", settings.as_table(), source, files.source_commit(), alignment.method
    )
    yield 1, 3
    metrics = figures | _times(clock)
    write_report(
        output / "report.html",
        report_input(taken, priors, alignment, ground, drawn, seen, metrics, settings, source),
    )
    yield 2, 3
    metrics |= _times(clock)
    write_text(output / "metrics.json", json.dumps(metrics, indent=1, allow_nan=False))
    if not alignment.frame.crs:
        yield Note(
            text="the map is not georeferenced: the photos carry no usable positions", warning=True
        )
    yield 3, 3
    return metrics


def report_input(
    taken: Intake,
    priors: Sequence[Prior],
    alignment: Alignment,
    ground: Ground,
    drawn: Drawn,
    seen: Seams,
    metrics: Mapping[str, Any],
    settings: MosaicSettings,
    title: str,
) -> ReportInput:
    """What the report shows."""
    grid = drawn.provenance_grid
    x, y = np.meshgrid(
        drawn.views_grid.x(np.arange(drawn.views_grid.width)),
        drawn.views_grid.y(np.arange(drawn.views_grid.height)),
    )
    heights = np.where(drawn.views > 0, ground.surface.at(x, y), np.float32(np.nan))
    return ReportInput(
        metrics=metrics,
        preview=drawn.preview,
        bounds=drawn.preview_grid.bounds,
        origin=alignment.frame.origin,
        crs=alignment.frame.crs,
        metric=alignment.frame.metric,
        views=drawn.views,
        views_bounds=drawn.views_grid.bounds,
        surface=heights,
        surface_bounds=drawn.views_grid.bounds,
        vertical_datum=alignment.frame.vertical_datum,
        shots=_shots(taken, priors, alignment, ground),
        residuals=_residuals(taken, alignment),
        seams=[
            SeamMark(
                x=float(grid.x(np.array(s.column))),
                y=float(grid.y(np.array(s.row))),
                disparity_px=float(np.hypot(s.dx, s.dy)) if s.ok else None,
            )
            for s in seen.report.samples
        ],
        depths=_depths(taken, alignment),
        settings=settings.as_table(),
        title=Path(title).name,
        version=__version__,
    )


def _depths(taken: Intake, alignment: Alignment) -> list[DepthPicture]:
    """False-colour depth maps (Y 4.8) of a few registrations, spread over the survey."""
    told = [j for j in alignment.joins if len(j.px) >= LEAST_DISPARITIES]
    chosen = (
        [told[k] for k in sorted({round(i) for i in np.linspace(0, len(told) - 1, DEPTHS)})]
        if told
        else []
    )
    pictures = []
    for join in chosen:
        photo = taken.photos[join.photo]
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


def _shots(
    taken: Intake, priors: Sequence[Prior], alignment: Alignment, ground: Ground
) -> list[Shot]:
    outline = {v.photo: v.footprint for v in ground.views}
    block = {i: k for k, b in enumerate(alignment.blocks) for i in b}
    held = set(alignment.held)
    return [
        Shot(
            name=taken.photos[i].name,
            xyz=pose.map_C,
            reported_xyz=priors[i].map_C,
            block=block.get(i, 0),
            method=alignment.method if i in held else "pose",
            footprint=outline.get(i, np.zeros((0, 2))),
        )
        for i, pose in sorted(alignment.poses.items())
    ]


def _residuals(taken: Intake, alignment: Alignment) -> list[CameraResiduals]:
    ties = alignment.ties
    name = np.array([alignment.camera_of.get(i, "") for i in range(len(taken.photos))])[ties.photo]
    return [
        CameraResiduals(
            camera=key,
            width=alignment.cameras[key].width,
            height=alignment.cameras[key].height,
            px=ties.px[name == key],
            residual_px=ties.residual_px[name == key],
        )
        for key in sorted(set(name.tolist()))
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
