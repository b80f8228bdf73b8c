"""Simulated flights: errors of poses, surface and map against the truth, in one table.

    python benchmarks/accuracy.py [--flights default,default+gcp,strip] [--work FOLDER] [--json
    FILE]

A flight is simulated once and kept in the work folder. `+gcp` uses its control points, but not its
check points. `large` has 500 photos and 12 control points, and takes half an hour to simulate.
Every figure has a lower and an upper limit: a result that is suspiciously good fails too.
"""

import argparse
import json
import shutil
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio

from skyquilt import simulate as sim
from skyquilt.quality.map_error import map_error
from skyquilt.settings import MosaicSettings
from skyquilt.simulate.settings import Control
from skyquilt.workflows.mosaic import mosaic

WINDOWS = {
    "default": {
        "map_median_gsd": (0.05, 60.0),
        "height_error_pct": (-4, 4),
        "bias_over_gps": (0, 3.0),
    },
    "default+gcp": {
        "map_median_gsd": (0.02, 1.0),
        "height_error_pct": (-2, 2),
        "focal_error_pct": (-2, 2),
    },
    "strip": {"tilt_max_deg": (0.001, 1.0)},
    "strip+gcp": {"tilt_max_deg": (0.001, 1.0)},
    "large+gcp": {"check_xy_gsd": (0.02, 1.0), "check_z_gsd": (0.02, 2.0)},
}
"""Flight -> figure -> (least, most)."""


LARGE = replace(
    sim.preset("default"),
    seed=41,
    route=replace(sim.preset("default").route, photos=500),
    control=Control(points=12, checks=30),
)
"""A large flight with its control points."""


@dataclass(frozen=True)
class Truth:
    """What truth.json says."""

    record: dict
    folder: Path

    @property
    def shots(self) -> dict[str, dict]:
        return {s["name"]: s for s in self.record["photos"]}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", default="default,default+gcp,strip")
    parser.add_argument(
        "--work", type=Path, default=Path(tempfile.gettempdir()) / "skyquilt-accuracy"
    )
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows, bad = {}, 0
    for name in args.flights.split(","):
        rows[name] = figures(name, args.work)
        print(f"{name}")
        for key, value in rows[name].items():
            low, high = WINDOWS.get(name, {}).get(key, (-np.inf, np.inf))
            verdict = (
                ""
                if key not in WINDOWS.get(name, {})
                else "ok"
                if low <= value <= high
                else f"OUTSIDE {low}..{high}"
            )
            bad += verdict.startswith("OUTSIDE")
            print(
                f"  {key:28s} {value:12.4f} {verdict}"
                if isinstance(value, float)
                else f"  {key:28s} {value!s:>12s} {verdict}"
            )
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))
    return int(bad > 0)


def figures(name: str, work: Path) -> dict[str, object]:
    """One row of the table."""
    preset, _, extra = name.partition("+")
    flight = work / preset
    if not (flight / "truth" / "truth.json").is_file():
        asked = LARGE if preset == "large" else sim.preset(preset)
        for _ in sim.simulate(asked, flight, overwrite=True):
            pass
    truth = Truth(json.loads((flight / "truth" / "truth.json").read_text()), flight)
    settings = MosaicSettings(gcp=flight / "gcp_list.txt" if extra == "gcp" else None)
    out = work / f"{name}.out"
    shutil.rmtree(out, ignore_errors=True)  # a cold store
    metrics = dict(mosaic(flight / "photos", out, settings, overwrite=True).metrics)
    return {
        **pose_figures(out, truth, metrics),
        **surface_figures(out, truth),
        **map_figures(out, truth, metrics),
        **check_figures(metrics),
    }


def check_figures(metrics: dict) -> dict[str, object]:
    """Errors (RMS) of check points, over the ground size of the photos; nothing without them."""
    checks = [p for p in metrics["control"] if p["check"]]
    if not checks or not any(not p["check"] for p in metrics["control"]):
        return {}
    error = np.array([[p["dx_m"], p["dy_m"], p["dz_m"]] for p in checks], float)
    rms = np.sqrt(np.nanmean(error**2, axis=0)) / metrics["native_gsd_m"]
    return {
        "check_points": len(checks),
        "check_xy_gsd": float(np.hypot(*rms[:2])),
        "check_z_gsd": float(rms[2]),
    }


def pose_figures(out: Path, truth: Truth, metrics: dict) -> dict[str, object]:
    """Positions, tilts, flying height and focal length against the truth."""
    shots = json.loads((out / "shots.geojson").read_text())["features"]
    found = {s["properties"]["filename"]: s["properties"] for s in shots}
    common = sorted(set(found) & set(truth.shots))
    C = np.array([found[k]["translation"] for k in common])
    C0 = np.array([truth.shots[k]["position"] for k in common])
    error = C - C0
    if metrics["vertical_datum"] == "takeoff":
        error[:, 2] += truth.record["vertical"]["takeoff_m"]
    tilt = [
        np.degrees(
            np.arccos(
                np.clip(
                    _axis(found[k]["rotation"]) @ np.array(truth.shots[k]["cam_R_map"])[2], -1, 1
                )
            )
        )
        for k in common
    ]
    camera = truth.record["cameras"]["visible"]
    focal = next(iter(metrics["cameras"].values()))["focal"]["value"]
    bias = error.mean(0)
    n = len(common)
    return {
        "photos": f"{metrics['photos_used']}/{metrics['photos_total']}",
        "reprojection_mean_px": float(metrics["reprojection_error_px"]["mean"]),
        "focal_error_pct": 100 * (focal / camera["focal"] - 1),
        "position_rms_x_m": float(np.sqrt((error[:, 0] ** 2).mean())),
        "position_rms_y_m": float(np.sqrt((error[:, 1] ** 2).mean())),
        "position_rms_z_m": float(np.sqrt((error[:, 2] ** 2).mean())),
        "bias_x_m": float(bias[0]),
        "bias_y_m": float(bias[1]),
        "bias_z_m": float(bias[2]),
        "bias_over_gps": float(np.hypot(*bias[:2]) / (2.0 / np.sqrt(n))),
        "tilt_max_deg": float(np.max(tilt)),
        "tilt_median_deg": float(np.median(tilt)),
        "height_error_pct": height_error(out, truth, C, C0),
        "check_rms_xy_m": _check(metrics, ("dx_m", "dy_m")),
        "check_rms_z_m": _check(metrics, ("dz_m",)),
    }


def height_error(out: Path, truth: Truth, C: np.ndarray, C0: np.ndarray) -> float:
    """Median error of the flying height above ground in percent."""
    with (
        rasterio.open(out / "surface.tif") as found,
        rasterio.open(truth.folder / "truth" / "truth_surface.tif") as real,
    ):
        ground = np.array([v[0] for v in found.sample(C[:, :2])])
        true_ground = np.array([v[0] for v in real.sample(C0[:, :2])])
    return float(np.nanmedian((C[:, 2] - ground) / (C0[:, 2] - true_ground) - 1) * 100)


def _axis(rotation_vector: list[float]) -> np.ndarray:
    """Optical axis in map coordinates."""
    import cv2

    return cv2.Rodrigues(np.array(rotation_vector))[0][2]


def _check(metrics: dict, keys: tuple[str, ...]) -> float:
    values = [c[k] for c in metrics["control"] if c["check"] for k in keys if c[k] is not None]
    return float(np.sqrt(np.mean(np.square(values)) * len(keys))) if values else float("nan")


def surface_figures(out: Path, truth: Truth) -> dict[str, object]:
    """Heights against the true surface (objects included), offset taken out."""
    with (
        rasterio.open(out / "surface.tif") as found,
        rasterio.open(truth.folder / "truth" / "truth_surface.tif") as real,
    ):
        x, y = np.meshgrid(
            np.linspace(real.bounds.left, real.bounds.right, 60)[8:-8],
            np.linspace(real.bounds.bottom, real.bounds.top, 60)[8:-8],
        )
        places = list(zip(x.ravel(), y.ravel(), strict=True))
        a = np.array([v[0] for v in found.sample(places)], float)
        b = np.array([v[0] for v in real.sample(places)], float)
    good = np.isfinite(a) & np.isfinite(b) & (b > -1e4) & (a > -1e4)
    d = (a - b)[good]
    return {
        "surface_offset_m": float(np.median(d)),
        "surface_median_abs_m": float(np.median(np.abs(d - np.median(d)))),
    }


def map_figures(out: Path, truth: Truth, metrics: dict) -> dict[str, object]:
    """The map against the true orthophoto."""
    e = map_error(out / "mosaic.tif", truth.folder / "truth" / "truth_ortho.tif")
    gsd = metrics["gsd_m"]
    return {
        "gsd_cm": gsd * 100,
        "map_median_gsd": float(e.absolute.median_m / gsd),
        "map_p95_gsd": float(e.absolute.p95_m / gsd),
        "map_median_m": float(e.absolute.median_m),
        "map_relative_median_gsd": float(e.relative.median_m / gsd),
        "map_bias_x_m": float(e.bias_x_m),
        "map_bias_y_m": float(e.bias_y_m),
        "map_measured": f"{e.measured}/{e.attempted}",
        "seam_median_px": float(metrics["seam_disparity_px"]["median"] or np.nan),
        "cpu_seconds": float(metrics["cpu_seconds"]),
    }


if __name__ == "__main__":
    sys.exit(main())
