"""Measure the error of a map against the true orthophoto of a simulated flight, or against any more
accurate map.

python examples/04_map_against_truth.py MOSAIC.tif TRUTH.tif [METRICS.json]

With the run's metrics.json it also says what its control points did.
"""

import json
import sys
from pathlib import Path
from typing import Any

from skyquilt.quality.map_error import map_error


def main(mosaic: Path, truth: Path, metrics: Path | None = None) -> None:
    points = [] if metrics is None else json.loads(metrics.read_text())["control"]
    found = map_error(mosaic, truth)
    if found.absolute is None or found.relative is None:
        sys.exit(f"none of {found.attempted} places could be found again")
    print(f"against the truth, at {found.measured} of {found.attempted} places:")
    print(
        f"  the map as a whole lies {found.bias_x_m:+.2f} m east and {found.bias_y_m:+.2f} m north"
        " of it"
    )
    print(
        f"  within the map: median {found.relative.median_m:.2f} m, 95 % below"
        f" {found.relative.p95_m:.2f} m"
    )
    if points:
        told(points)
    else:
        print(
            "  the photos' positions are off by metres, and what they have in common moves the"
            " whole map; control points take it away"
        )


def told(points: list[dict[str, Any]]) -> None:
    """What control points did, and what the check points say of it."""
    used = [p for p in points if not p["check"]]
    kept = [p for p in points if p["check"]]
    print(
        f"  {len(used)} control points, marked in the photos with their surveyed coordinates, hold"
        " the map in place: the photos' own positions are off by metres"
    )
    if kept:
        rms = (sum(p["dx_m"] ** 2 + p["dy_m"] ** 2 for p in kept) / len(kept)) ** 0.5
        print(
            f"  {len(kept)} check points, surveyed too but not used, lie within {100 * rms:.1f} cm"
            " (RMS): what you would tell a client"
        )


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    main(*map(Path, sys.argv[1:]))
