"""Error of the thermal map's registration to the visual map, on a simulated flight.

    skyquilt simulate FLIGHT --preset thermal [--thermal-season winter --thermal-hour 5]
    skyquilt mosaic FLIGHT/photos --thermal FLIGHT/thermal -o OUT [--thermal-route
    maps|pairs|heights]
    python benchmarks/thermal_map.py OUT FLIGHT

Both maps are compared with their own truth. The difference of the two displacements is the error of
the registration: where the visual map has an error, the thermal map should have the same one.
"""

import json
import sys
from pathlib import Path

import numpy as np

from skyquilt.quality.map_error import map_error


def displacements(raster: Path, truth: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Places (n, 2) and displacements (n, 2) in m that could be trusted, and their share."""
    found = map_error(raster, truth, points=400)
    good = [s for s in found.samples if s.ok]
    at, off = (
        np.array([(s.x, s.y) for s in good]),
        np.array([(s.error_x_m, s.error_y_m) for s in good]),
    )
    return at, off, found.measured / max(found.attempted, 1)


def field(places: np.ndarray, off: np.ndarray, at: np.ndarray, near: int = 15) -> np.ndarray:
    """Displacements (n, 2) at other places, by robust planes through the nearest ones."""
    out = np.zeros_like(at)
    for k, place in enumerate(at):
        nearest = np.argsort(np.linalg.norm(places - place, axis=1))[:near]
        terms, weight = np.c_[np.ones(len(nearest)), places[nearest] - place], np.ones(len(nearest))
        for _ in range(8):
            plane = np.linalg.lstsq(
                terms * weight[:, None] ** 0.5, off[nearest] * weight[:, None] ** 0.5, rcond=None
            )[0]
            lacking = np.linalg.norm(off[nearest] - terms @ plane, axis=1)
            weight = 1 / (1 + (lacking / (2 * np.median(lacking) + 1e-6)) ** 2)
        out[k] = plane[0]
    return out


def main(output: Path, flight: Path) -> None:
    """Print the figures."""
    m = json.loads((output / "metrics.json").read_text())
    at, off, share = displacements(output / "thermal.tif", flight / "truth" / "truth_thermal.tif")
    there, visual, _ = displacements(output / "mosaic.tif", flight / "truth" / "truth_ortho.tif")
    error = np.linalg.norm(off - field(there, visual, at), axis=1)
    gsd = m["native_gsd_m"]
    print(
        f"route {m['thermal']['route']} (refused: {m['thermal']['routes_refused'] or 'none'});"
        f" {len(error)} places ({share:.0%} of those tried); thermal on visual: median"
        f" {np.median(error):.3f} m ="
        f" {np.median(error) / gsd:.2f} visual GSD, 95 % below"
        f" {np.percentile(error, 95) / gsd:.2f};"
        f" against the ground truth {np.median(np.linalg.norm(off, axis=1)):.3f} m"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
