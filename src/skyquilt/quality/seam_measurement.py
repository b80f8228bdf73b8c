"""Seam disparity along all seams of a finished map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.workers import HERE, Workers
from skyquilt.imaging.gradients import NOISE
from skyquilt.ortho.companions import Drawn
from skyquilt.ortho.compose import Composer
from skyquilt.ortho.ground import Ground
from skyquilt.ortho.orthomosaic import used_photos
from skyquilt.quality.seam_look import cut_objects, seam_colours
from skyquilt.quality.seam_points import SeamPoint, seam_points
from skyquilt.quality.seam_views import Look, views_at
from skyquilt.quality.seams import SeamReport, noise_of, seam_disparity

SHOWN, APART = 3, 100
"""Number of the worst places that are shown, and their least distance in px of the provenance."""
SEAM_POINTS = 300
"""Points at which seams are measured."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredSeams:
    """Seam disparity: the figures, and where they were taken."""

    report: SeamReport
    """All samples."""
    figures: Mapping[str, Any]
    """What metrics.json says."""
    looks: Mapping[str, Any]
    """What it says about colours and objects at the seams."""
    worst: Sequence[SeamPoint] = ()
    """Points with the largest steps of colour, the worst first."""


def measure_seams(
    compose: Composer, drawn: Drawn, ground: Ground, workers: Workers = HERE
) -> MeasuredSeams:
    """Registers the two photos beside each other at points along all seams."""
    shown = used_photos(ground.views)
    views = {k + 1: next(v for v in ground.views if v.photo == i) for k, i in enumerate(shown)}
    points = seam_points(drawn.provenance, limit=SEAM_POINTS)
    look = Look(
        surface=ground.surface,
        pixels=compose.pixels,
        exposure=compose.exposure if compose.dtype == np.uint8 else None,
        native_gsd=ground.native_gsd,
        gsd=ground.grid.gsd,
    )
    found = views_at(points, drawn.provenance_grid, views, look, workers)
    noise = NOISE if compose.dtype == np.uint8 else noise_of(found.pairs)
    report = seam_disparity(points, found.pairs, gsd_m=ground.native_gsd, noise=noise)
    looks: dict[str, Any] = {"seam_colour_step": None, "seam_cut_objects": None, "hidden_m2": None}
    worst: list[SeamPoint] = []
    if found.lab is not None and points:
        colours = seam_colours(found.lab)
        looks["seam_colour_step"] = colours.figures
        worst = _apart(points, colours.at)
    if (labels := compose.labels) is not None:
        share = cut_objects(drawn.provenance, drawn.provenance_grid, labels)
        looks["seam_cut_objects"] = None if share is None else round(share, 4)
        looks["hidden_m2"] = round(float(labels.hidden.sum()) * labels.cells.gsd**2, 1)
    return MeasuredSeams(report=report, figures=_figures(report), looks=looks, worst=tuple(worst))


def _apart(points: Sequence[SeamPoint], step: NDArray[Any]) -> list[SeamPoint]:
    """The points with the largest steps (n,), apart from each other."""
    chosen: list[SeamPoint] = []
    for k in np.argsort(-np.nan_to_num(step, nan=-1.0), kind="stable").tolist():
        p = points[k]
        if all(np.hypot(p.row - q.row, p.column - q.column) > APART for q in chosen):
            chosen.append(p)
        if len(chosen) == SHOWN or not np.isfinite(step[k]):
            break
    return chosen


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
