"""How far the thermal map lies from where it belongs on the visual map, on a simulated flight.

    skyquilt simulate FLIGHT --preset thermal [--thermal-season winter --thermal-hour 5]
    skyquilt mosaic FLIGHT/photos --thermal FLIGHT/thermal -o OUT [--thermal-route maps|pairs|heights]
    python benchmarks/thermal_map.py OUT FLIGHT

Both maps are compared with their own truth, and the difference of the two displacements is the error of the join:
what the visual map is off by the ground truth, the thermal map should be off by too.
"""

import json
import sys
from pathlib import Path

import numpy as np

from skyquilt.metrics.map_error import map_error


def displacements(raster: Path, truth: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Places (n, 2) and displacements (n, 2) in m that could be trusted, and their share."""
    found = map_error(raster, truth, points=400)
    good = [s for s in found.samples if s.ok]
    at, off = np.array([(s.x, s.y) for s in good]), np.array([(s.error_x_m, s.error_y_m) for s in good])
    return at, off, found.measured / max(found.attempted, 1)


def main(output: Path, flight: Path) -> None:
    """Print the figures."""
    m = json.loads((output / "metrics.json").read_text())
    at, off, share = displacements(output / "thermal.tif", flight / "truth" / "truth_thermal.tif")
    there, visual, _ = displacements(output / "mosaic.tif", flight / "truth" / "truth_ortho.tif")
    nearest = np.argsort(((at[:, None] - there[None]) ** 2).sum(-1), axis=1)[:, :5]
    error = np.linalg.norm(off - np.median(visual[nearest], axis=1), axis=1)
    gsd = m["native_gsd_m"]
    print(
        f"route {m['thermal']['route']} (refused: {m['thermal']['routes_refused'] or 'none'});"
        f" {len(error)} places ({share:.0%} of those tried); thermal on visual: median {np.median(error):.3f} m ="
        f" {np.median(error) / gsd:.2f} visual GSD, 95 % below {np.percentile(error, 95) / gsd:.2f};"
        f" against the ground truth {np.median(np.linalg.norm(off, axis=1)):.3f} m"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
