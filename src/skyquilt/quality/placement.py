"""The quality function of the thesis, for any method: lambda, its two parts, and the graphs that
belong to it (Y 6.1).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.workers import HERE, Workers
from skyquilt.imaging.nodes import View
from skyquilt.imaging.plane import Patch, view_patch
from skyquilt.imaging.views import on_ground
from skyquilt.model.photo import KnownDistance, Photo, PointObservation
from skyquilt.model.poses import Alignment, Prior
from skyquilt.model.surface import Surface
from skyquilt.ortho.ground import GreyPicture, Ground
from skyquilt.quality.geolocation import geolocation_errors
from skyquilt.quality.replay import (
    Replay,
    lambda_corr,
    lambda_quality,
    lambda_spat,
    lambda_spat_of_table,
    replay,
)

ACROSS = 400
"""Width in px of the photos that are compared: that of the thesis."""
MOST_PX = 1.2e7
"""Largest map, in pixels, that they are compared with."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Patched:
    """Orthorectifies placed photos."""

    grey: GreyPicture
    surface: Surface
    across: int
    gsd: float

    def __call__(self, view: View) -> Patch | None:
        """A photo on the map's grid at the ground size of the comparison."""
        return view_patch(self.grey(view.photo, self.across), view, self.surface, self.gsd)


def placement_quality(
    photos: Sequence[Photo],
    alignment: Alignment,
    priors: Sequence[Prior],
    ground: Ground,
    grey: GreyPicture,
    known: Sequence[KnownDistance],
    alpha: float,
    order: Sequence[int],
    workers: Workers = HERE,
) -> dict[str, Any]:
    """Replays the placements in the given order at one ground resolution, and measures known
    distances.
    """
    views = {v.photo: v for v in ground.views}
    order = tuple(i for i in order if i in views)
    wide = max(view.camera.width for view in ground.views)
    across = _across(ground, wide)
    gsd = ground.native_gsd * wide / across
    patch = _Patched(grey=grey, surface=ground.surface, across=across, gsd=gsd)
    seen = replay(workers.each(patch, [views[i] for i in order]))
    off = np.array([np.hypot(*(alignment.poses[i].map_C - priors[i].map_C)[:2]) for i in order])
    figures = _figures(seen, photos, views, ground, known, alpha) | _geolocation(
        alignment, priors, order
    )
    off = off / (ground.native_gsd * wide)
    figures |= _joins(alignment) | {
        "photos": [photos[i].name for i in order],
        "correlation_with_last_of_photo": [finite(c) for c in seen.with_last],
        "correlation_with_map_of_photo": [finite(c) for c in seen.with_overview],
        "off_position_over_width": [finite(o) for o in off],
    }
    return figures


def _across(ground: Ground, wide: int) -> int:
    """Width in px of the compared photos: `ACROSS`, or less for a map that would have more than
    `MOST_PX` pixels then.
    """
    west, south, east, north = ground.grid.bounds
    area = (east - west) * (north - south) / (ground.native_gsd * wide / ACROSS) ** 2
    return max(16, round(ACROSS * min(1.0, float(np.sqrt(MOST_PX / max(area, 1.0))))))


def _figures(
    seen: Replay,
    photos: Sequence[Photo],
    views: dict[int, View],
    ground: Ground,
    known: Sequence[KnownDistance],
    alpha: float,
) -> dict[str, Any]:
    corr = lambda_corr(seen.with_overview)
    out: dict[str, Any] = {
        "alpha": alpha,
        "lambda_corr": finite(corr),
        "lambda_spat": None,
        "lambda_spat_of_table": None,
        "lambda": None,
        "correlation_with_last": _mean(seen.with_last),
    }
    rows, actual, found = [], [], []
    index = {p.name: i for i, p in enumerate(photos)}
    for distance in known:
        ends = [
            _place(o, index, views, ground)
            for o in (distance.observations_a, distance.observations_b)
        ]
        there = [e for e in ends if e is not None]
        metres = float(np.linalg.norm((there[0] - there[1])[:2])) if len(there) == 2 else None
        rows.append(
            {"a": distance.a, "b": distance.b, "metres": distance.metres, "on_map": finite(metres)}
        )
        if metres is not None:
            actual.append(distance.metres)
            found.append(metres)
    if actual:
        spat = lambda_spat(actual, found)
        out |= {
            "lambda_spat": finite(spat),
            "lambda_spat_of_table": finite(lambda_spat_of_table(actual, found)),
            "lambda": finite(lambda_quality(spat, corr, alpha=alpha)),
        }
    return out | ({"distances": rows} if rows else {})


def _place(
    observations: Sequence[PointObservation],
    index: dict[str, int],
    views: dict[int, View],
    ground: Ground,
) -> NDArray[np.float64] | None:
    """Where the map shows a point: from the most vertical observation whose photo the map shows
    there.
    """
    best, place = np.inf, None
    for observation in observations:
        view = views.get(index.get(observation.photo, -1))
        if view is None:
            continue
        xyz = on_ground(view, np.array([[observation.x, observation.y]]), ground.surface)[0]
        off = xyz - view.pose.map_C
        score = float(np.hypot(*off[:2]) / max(abs(off[2]), 1e-6))
        if score < best:
            best, place = score, xyz
    return place


def _geolocation(
    alignment: Alignment, priors: Sequence[Prior], order: Sequence[int]
) -> dict[str, Any]:
    """MAE and RMS per axis at the photos' centres against their reported positions (A Table 2)."""
    if alignment.frame.crs is None or not order:
        return {}
    errors = geolocation_errors(
        np.array([alignment.poses[i].map_C for i in order]),
        np.array([priors[i].map_C for i in order]),
    )
    axes = ("x", "y", "z")
    return {
        "geolocation_mae_m": {a: finite(v) for a, v in zip(axes, errors.mae_m, strict=True)},
        "geolocation_rms_m": {a: finite(v) for a, v in zip(axes, errors.rms_m, strict=True)},
    }


def _joins(alignment: Alignment) -> dict[str, Any]:
    """STE per inlier (A 15) over the registrations of a method that has them, px^2 of the working
    image.
    """
    ste = np.array([j.ste_px2 for j in alignment.joins])
    ste = ste[np.isfinite(ste)]
    if not len(ste):
        return {}
    return {
        "ste_per_inlier_px2": {
            "median": finite(float(np.median(ste))),
            "worst": finite(float(ste.max())),
        }
    }


def _mean(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return finite(float(known.mean())) if len(known) else None


def finite(value: float | None) -> float | None:
    """A figure with four digits for a JSON file; None where there is none."""
    return None if value is None or not np.isfinite(value) else round(value, 4)
