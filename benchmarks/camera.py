"""Lens, shutter and their deviations on simulated flights, against the truth.

    python benchmarks/camera.py [KIND ...] [--seeds 1,2,3] [--work FOLDER] [--json FILE]
    python benchmarks/camera.py --list

A flight is simulated once and kept in the work folder; a map is made without drawing it. Prints one
row for each flight and seed; figures over several seeds are RMS.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from skyquilt import simulate as sim
from skyquilt.alignment.conflicts import conflicts
from skyquilt.engine.clock import Clock, result_of
from skyquilt.engine.store import Store
from skyquilt.model.camera import PARAMETERS
from skyquilt.settings import MosaicSettings
from skyquilt.simulate.settings import Control, FlightSettings, Reporting, Route
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.flow import align_photos
from skyquilt.workflows.methods import methods_for
from skyquilt.workflows.survey_input import read_input

LENS = FlightSettings().lens
RTK = Reporting(
    gps_noise=0.01, gps_noise_z=0.02, rtk=True, dewarp=(0.004, 0.004), altitude_drift=0.0
)
LEVEL = Route(height=44.0, tilt_noise=1.0)
LOW = replace(FlightSettings().scene, relief=3.0)
FAST = Route(height=40.0, speed=10.0, photos=40)
CONTROL = Control(points=5, checks=6)
PLAIN = Reporting(gps_noise=2.0)
ROLLING = replace(LENS, readout=0.030, aspect=1.003)


def _focal_error(seed: int) -> float:
    return float(np.random.default_rng([seed, 77]).normal(0, 0.01))


KINDS = {
    "rtk": (FlightSettings(route=LEVEL, scene=LOW, control=CONTROL, reporting=RTK), {}),
    "rtk-level": (
        FlightSettings(
            route=replace(LEVEL, tilt_noise=0.05), scene=LOW, control=CONTROL, reporting=RTK
        ),
        {},
    ),
    "noisy": (
        FlightSettings(
            route=LEVEL,
            scene=LOW,
            control=CONTROL,
            reporting=replace(RTK, gps_noise=3.0, rtk=False),
        ),
        {"gcp": True},
    ),
    "rolling": (
        FlightSettings(lens=ROLLING, route=FAST, control=CONTROL, reporting=PLAIN),
        {"gcp": True, "shutter_readout_ms": 30.0},
    ),
    "rolling-told": (
        FlightSettings(
            lens=ROLLING,
            route=FAST,
            control=CONTROL,
            reporting=replace(PLAIN, dewarp=(LENS.p1, LENS.p2)),
        ),
        {"gcp": True, "shutter_readout_ms": 30.0},
    ),
    "rolling-fixed": (
        FlightSettings(
            lens=ROLLING, route=replace(FAST, fixed_yaw=True), control=CONTROL, reporting=PLAIN
        ),
        {"gcp": True, "shutter": "rolling"},
    ),
    "rolling-turns": (
        FlightSettings(
            lens=ROLLING, route=replace(FAST, turns=2.0), control=CONTROL, reporting=PLAIN
        ),
        {"gcp": True, "shutter_readout_ms": 30.0},
    ),
    "stops": (
        FlightSettings(
            lens=ROLLING, route=replace(FAST, stops=True), control=CONTROL, reporting=PLAIN
        ),
        {"gcp": True, "shutter_readout_ms": 30.0},
    ),
    "plain": (
        FlightSettings(route=FAST, control=CONTROL, reporting=PLAIN),
        {"gcp": True, "shutter": "global"},
    ),
    "global": (FlightSettings(route=FAST, control=CONTROL, reporting=PLAIN), {"gcp": True}),
    "global-rolling": (
        FlightSettings(route=FAST, control=CONTROL, reporting=PLAIN),
        {"gcp": True, "shutter": "rolling"},
    ),
    "stops-plain": (
        FlightSettings(
            lens=ROLLING, route=replace(FAST, stops=True), control=CONTROL, reporting=PLAIN
        ),
        {"gcp": True, "shutter": "global"},
    ),
}
"""Name -> the flight, and the options of its map."""


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kinds", nargs="*", metavar="KIND", default=list(KINDS))
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument(
        "--work", type=Path, default=Path(tempfile.gettempdir()) / "skyquilt-camera"
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument("--list", action="store_true", help="the kinds of flights")
    parser.add_argument("--simulate-only", action="store_true", help="prepare the flights")
    parser.add_argument("--option", action="append", default=[], metavar="NAME=VALUE")
    args = parser.parse_args()
    if args.list:
        print("\n".join(KINDS))
        return 0
    if unknown := [kind for kind in args.kinds if kind not in KINDS]:
        parser.error(f"there is no kind {unknown[0]}; --list names them")
    extra = dict(text.split("=", 1) for text in args.option)
    rows = []
    for kind in args.kinds:
        for seed in map(int, args.seeds.split(",")):
            flight = flown(kind, seed, args.work)
            if args.simulate_only:
                continue
            row = {"kind": kind, "seed": seed, **figures(kind, flight, extra)}
            rows.append(row)
            print("  ".join(f"{k} {_text(v)}" for k, v in row.items()), flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))
    return 0


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def flown(kind: str, seed: int, work: Path) -> Path:
    """The folder of a simulated flight."""
    settings, _ = KINDS[kind]
    error = _focal_error(seed)
    settings = replace(
        settings, seed=seed, reporting=replace(settings.reporting, focal_error=error)
    )
    name = next(k for k, (other, _) in KINDS.items() if other == KINDS[kind][0])  # flown once
    folder = work / f"{name}-{seed}"
    if not (folder / "truth" / "truth.json").is_file():
        for _ in sim.simulate(settings, folder, overwrite=True):
            pass
    return folder


def figures(kind: str, folder: Path, extra: dict[str, str]) -> dict[str, object]:
    """Errors against the truth, and the deviations stated for them."""
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    options = dict(KINDS[kind][1]) | extra
    with_control = bool(options.pop("gcp", False))
    if "shutter_readout_ms" in options:
        options["shutter_readout_ms"] = float(options["shutter_readout_ms"])
    settings = MosaicSettings(gcp=folder / "gcp_list.txt", **options)
    given = read_input(folder / "photos", settings.input)
    if not with_control:  # all points are checks
        given = replace(given, control=tuple(replace(c, check=True) for c in given.control))
    store = Store(folder=folder / "store", registry=REGISTRY)
    clock = Clock(store=store, began=Clock.now())
    aligned = result_of(align_photos(given, methods_for(settings), settings, clock))
    return {
        **_centres(aligned.photos, aligned.alignment, truth),
        **_lens(aligned.alignment, truth),
        **_points(aligned.alignment),
        **_said(aligned),
        "reprojection_px": float(np.sqrt((aligned.alignment.ties.residual_px**2).sum(1).mean())),
    }


def _said(aligned) -> dict[str, object]:
    """Contradictions that the report names, and whether it warns that the focal length is open."""
    found = conflicts(aligned.photos, aligned.priors, aligned.alignment)
    kinds = sorted({c.field for c in found if c.field in ("focal", "lens", "principal_point")})
    warned = any("does not determine the focal length" in n for n in aligned.alignment.notes)
    return {"named": ",".join(kinds) or "-", "warned": warned}


def _centres(photos, alignment, truth) -> dict[str, object]:
    """RMS errors of camera centres in m, the mean height error apart (what the zero is, positions
    without control do not say).
    """
    true = {p["name"]: np.array(p["position"]) for p in truth["photos"]}
    frame = alignment.frame
    origin = np.array([*frame.origin, 0.0])
    error = np.array(
        [p.map_C + origin - true[photos[i].name] for i, p in sorted(alignment.poses.items())]
    )
    if frame.vertical_datum == "takeoff":
        error[:, 2] += truth["vertical"]["takeoff_m"]
    rms = np.sqrt((error**2).mean(0))
    stated = [p.sigma_m for _, p in sorted(alignment.poses.items())]
    known = [e / s for e, s in zip(error, stated, strict=True) if s is not None]
    over = np.array(known).reshape(-1, 3)
    return {
        "photos": len(error),
        "x_cm": float(100 * rms[0]),
        "y_cm": float(100 * rms[1]),
        "z_cm": float(100 * rms[2]),
        "z_mean_cm": float(100 * error[:, 2].mean()),
        "xy/s": float(np.sqrt((over[:, :2] ** 2).mean())),
        "z/s": float(np.sqrt((over[:, 2] ** 2).mean())),
    }


def _lens(alignment, truth) -> dict[str, object]:
    """Errors of the lens in per cent, px and ms, and in units of their stated deviations."""
    camera, true = next(iter(alignment.cameras.values())), truth["cameras"]["visible"]
    out: dict[str, object] = {"focal_pct": 100 * (camera.focal / true["focal"] - 1)}
    sigmas = camera.sigmas or (float("nan"),) * len(PARAMETERS)
    for name, sigma in zip(PARAMETERS, sigmas, strict=True):
        if sigma > 0 and name in ("focal", "cx", "cy", "k1", "p1", "aspect"):
            out[f"{name}/s"] = (getattr(camera, name) - true[name]) / sigma
    out["focal_s_pct"] = 100 * sigmas[0] / camera.focal
    out["aspect"] = camera.aspect
    out["readout_ms"] = 1000 * camera.readout_s
    out["readout_s_ms"] = 1000 * (camera.sigma_readout_s or 0.0)
    return out


def _points(alignment) -> dict[str, object]:
    """RMS errors of check points in cm, and over their stated deviations."""
    error = np.array([c.error_m for c in alignment.control if c.check])
    if not len(error):
        return {}
    flat, up = np.sqrt((error[:, :2] ** 2).mean()), np.sqrt((error[:, 2] ** 2).mean())
    over = np.array([c.error_m / c.sigma_m for c in alignment.control if c.sigma_m is not None])
    return {
        "check_xy_cm": float(100 * flat),
        "check_z_cm": float(100 * up),
        "checks/s": float(np.sqrt((over**2).mean())) if len(over) else float("nan"),
    }


if __name__ == "__main__":
    sys.exit(main())
