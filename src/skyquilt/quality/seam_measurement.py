"""Seam disparity along all seams of a finished map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from skyquilt.engine.clock import Steps
from skyquilt.ortho.companions import Drawn
from skyquilt.ortho.compose import Composer
from skyquilt.ortho.ground import Ground
from skyquilt.ortho.orthomosaic import used_photos
from skyquilt.ortho.patches import grey_pairs
from skyquilt.quality.seam_points import SeamPoint, seam_points
from skyquilt.quality.seams import PatchPairs, SeamReport, seam_disparity

SEAM_POINTS = 300
"""Points at which seams are measured."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredSeams:
    """Seam disparity: the figures, and where they were taken."""

    report: SeamReport
    """All samples."""
    figures: Mapping[str, Any]
    """What metrics.json says."""


def measure_seams(compose: Composer, drawn: Drawn, ground: Ground) -> Steps[MeasuredSeams]:
    """Registers the two photos beside each other at points along all seams."""
    yield 0, 1
    shown = used_photos(ground.views)
    views = {k + 1: next(v for v in ground.views if v.photo == i) for k, i in enumerate(shown)}
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
    return MeasuredSeams(report=report, figures=_figures(report))


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
