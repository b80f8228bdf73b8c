"""Distances between cameras by their reported positions, by which methods are judged where nothing
on the ground is known.

No method makes them, and they are independent of its result to the degree that it does not use
positions: `image` and `flightline` use them for one transformation of the whole map, `hybrid` and
`bundle` weigh them against the pictures. `position` and `pose` repeat them, so nothing is said
about these.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt.alignment.priors import choose_frame, priors
from skyquilt.model.photo import Photo
from skyquilt.quality.replay import lambda_quality, lambda_spat, lambda_spat_of_table

CAMERAS = 6
"""Largest number of cameras between which distances are taken: 15 of them."""
REPEATS = ("position", "pose", "pose-trusted")
"""Columns that place photos exactly where they report to be."""


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """A horizontal distance between two cameras."""

    a: str
    """Name of one photo."""
    b: str
    """Name of the other."""
    metres: float
    """By the reported positions, m."""
    sigma_m: float
    """Its standard deviation by those that the positions state or their source has, m."""


def baselines(photos: Sequence[Photo], crs: str | None) -> list[Baseline]:
    """Distances between cameras that lie far from each other, in the map's CRS; empty with fewer
    than two positions.
    """
    reported = priors(photos, choose_frame(photos, crs))
    known = [k for k, p in enumerate(reported) if np.isfinite(p.map_C[:2]).all()]
    if len(known) < 2:
        return []
    xy = np.array([reported[k].map_C[:2] for k in known])
    chosen = [int(np.argmax(np.linalg.norm(xy - np.median(xy, axis=0), axis=1)))]
    while len(chosen) < min(CAMERAS, len(known)):
        chosen.append(
            int(np.min([np.linalg.norm(xy - xy[c], axis=1) for c in chosen], axis=0).argmax())
        )
    rows = []
    for i, j in combinations(sorted(chosen), 2):
        metres = float(np.linalg.norm(xy[i] - xy[j]))
        sigma = math.hypot(*(float(reported[known[k]].sigma_C[0]) for k in (i, j)))
        if metres > 0:
            rows.append(
                Baseline(
                    a=photos[known[i]].name, b=photos[known[j]].name, metres=metres, sigma_m=sigma
                )
            )
    return rows


def judged(column: Mapping[str, Any], run: Path, known: Sequence[Baseline]) -> dict[str, Any]:
    """The column of a method with its distances and lambda [Y (6.1)] by baselines, from the camera
    positions that its run wrote (shots.geojson).
    """
    places = _places(run / "shots.geojson")
    rows, actual, found = [], [], []
    for line in known:
        ends = [places.get(n) for n in (line.a, line.b)]
        on_map = None
        if ends[0] is not None and ends[1] is not None:
            on_map = math.dist(ends[0], ends[1])
            actual.append(line.metres)
            found.append(on_map)
        rows.append(
            {
                "a": line.a,
                "b": line.b,
                "metres": round(line.metres, 4),
                "on_map": None if on_map is None else round(on_map, 4),
                "error_m": None if on_map is None else round(on_map - line.metres, 4),
            }
        )
    out = dict(column) | {"distances": rows}
    if actual:
        spat = lambda_spat(actual, found)
        out |= {
            "lambda_spat": round(spat, 4),
            "lambda_spat_of_table": round(lambda_spat_of_table(actual, found), 4),
            "lambda": round(lambda_quality(spat, column["lambda_corr"], alpha=column["alpha"]), 4),
        }
    return out


def unjudged(column: Mapping[str, Any], known: Sequence[Baseline]) -> dict[str, Any]:
    """The column of a method that repeats the positions: the distances without values."""
    rows = [
        {"a": n.a, "b": n.b, "metres": round(n.metres, 4), "on_map": None, "error_m": None}
        for n in known
    ]
    return dict(column) | {"distances": rows}


def told(known: Sequence[Baseline]) -> str:
    """What the methods are judged by, as the end of a sentence."""
    sigma = float(np.median([n.sigma_m for n in known]))
    several = "baselines" if len(known) > 1 else "baseline"
    return (
        f"{len(known)} {several} between cameras by their reported positions (standard deviation of"
        f" each {sigma:.1f} m), which position and pose repeat and the other methods use in part;"
        " no distance on the ground is known"
    )


def _places(path: Path) -> dict[str, tuple[float, float]]:
    """Easting and northing in m of each photo; empty where the run has no map's CRS."""
    if not path.is_file():
        return {}
    features = json.loads(path.read_text(encoding="utf-8"))["features"]
    return {
        f["properties"]["filename"]: (
            float(f["properties"]["translation"][0]),
            float(f["properties"]["translation"][1]),
        )
        for f in features
    }
