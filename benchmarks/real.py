"""The real surveys beside the checkout: their figures compared with required limits.

    python benchmarks/real.py [--data ../shared/data] [--only brighton,caliterra,...] [--work
    FOLDER]

`stripped` is brighton without any metadata. `stripped+gcp` adds three control points, whose pixels
and coordinates come from tie points of the full run; further tie points are check points.
"""

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

from skyquilt.settings import MosaicSettings
from skyquilt.workflows.mosaic import mosaic

ASKED = {
    "brighton": {
        "photos": (18, 18),
        "reprojection_mean_px": (0.1, 0.7),
        "gps_x_m": (0.02, 0.6),
        "gps_y_m": (0.02, 0.6),
        "focal_px": (2310 * 0.95, 2310 * 1.05),
        "seam_median_px": (0.1, 2.0),
        "seam_measured_share": (0.6, 1.0),
        "yaw_conflicts": (6, 6),
        "peak_memory_mb": (100, 1200),
    },
    "caliterra": {
        "photos": (74, 75),
        "largest_block": (74, 75),
        "reprojection_mean_px": (0.1, 0.6),
        "altitude_conflicts": (1, 75),
    },
    "thermal-strip": {"photos": (17, 17), "yaw_conflicts": (17, 17)},
    "stripped": {"photos": (18, 18), "largest_block": (18, 18), "georeferenced": (0, 0)},
    "stripped+gcp": {"photos": (18, 18), "georeferenced": (1, 1), "check_rms_xy_m": (0.001, 0.03)},
}
"""Survey -> figure -> (least, most)."""


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "data"
    )
    parser.add_argument("--only", default=",".join(ASKED))
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "skyquilt-real")
    args = parser.parse_args()
    if not args.data.is_dir():
        print(f"{args.data} is not there: nothing measured")
        return 0
    args.work.mkdir(parents=True, exist_ok=True)
    missed = 0
    for name in args.only.split(","):
        row = figures(name, args.data, args.work)
        print(name)
        for key, value in row.items():
            low, high = ASKED[name].get(key, (-np.inf, np.inf))
            verdict = (
                ""
                if key not in ASKED[name]
                else "ok"
                if low <= value <= high
                else f"MISSED {low}..{high}"
            )
            missed += verdict.startswith("MISSED")
            print(f"  {key:24s} {value:12.3f} {verdict}")
    return int(missed > 0)


def figures(name: str, data: Path, work: Path) -> dict[str, float]:
    """The figures of one survey."""
    folder, settings = data / name, MosaicSettings(gsd_cm=2.0 if name == "brighton" else None)
    if name.startswith("stripped"):
        folder = strip_all(data / "brighton", work / "stripped-photos")
    if name == "stripped+gcp":
        settings = MosaicSettings(gcp=control_from_full_run(data / "brighton", work))
    shutil.rmtree(work / f"{name}.out", ignore_errors=True)  # a cold store
    m = mosaic(folder, work / f"{name}.out", settings, overwrite=True).metrics
    fields = [c["field"] for c in m["metadata_conflicts"]]
    gps, seam = m["gps_residual_rms_m"] or {}, m["seam_disparity_px"]
    loo = m["gps_leave_one_out_rms_m"] or {}
    check = [np.hypot(c["dx_m"], c["dy_m"]) for c in m["control"] if c["check"]]
    nan = float("nan")
    return {
        "photos": m["photos_used"],
        "largest_block": m["blocks"][0],
        "georeferenced": float(m["georeferenced"]),
        "reprojection_mean_px": m["reprojection_error_px"]["mean"],
        "tie_points": m["tie_points"],
        "gps_x_m": gps.get("x", nan),
        "gps_y_m": gps.get("y", nan),
        "gps_z_m": gps.get("z", nan),
        "loo_x_m": loo.get("x", nan),
        "loo_y_m": loo.get("y", nan),
        "loo_z_m": loo.get("z", nan),
        "focal_px": next(iter(m["cameras"].values()))["focal"]["value"],
        "seam_median_px": seam["median"],
        "seam_p95_px": seam["p95"],
        "seam_measured_share": seam["measured"] / max(seam["attempted"], 1),
        "yaw_conflicts": fields.count("yaw"),
        "altitude_conflicts": fields.count("altitude"),
        "position_conflicts": fields.count("position"),
        "focal_conflicts": fields.count("focal"),
        "check_rms_xy_m": float(np.sqrt(np.mean(np.square(check)))) if check else nan,
        "cpu_seconds": m["cpu_seconds"],
        "peak_memory_mb": m["peak_memory_mb"],
    }


def strip_all(source: Path, target: Path) -> Path:
    """Copies of JPEGs without any APP1-15 or comment segment, under names that tell nothing."""
    target.mkdir(parents=True, exist_ok=True)
    for k, path in enumerate(sorted(source.glob("*.JPG"))):
        data, at = path.read_bytes(), 2
        kept = data[:2]
        while data[at + 1] != 0xDA:
            end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
            if not (0xE1 <= data[at + 1] <= 0xEF or data[at + 1] == 0xFE):
                kept += data[at:end]
            at = end
        (target / f"img{k:02d}.jpg").write_bytes(kept + data[at:])
    return target


def control_from_full_run(source: Path, work: Path) -> Path:
    """A gcp_list.txt of three far-apart tie points of the full run; 40 others are check points."""
    from skyquilt.engine.clock import Clock, result_of
    from skyquilt.engine.store import Store
    from skyquilt.settings import InputSettings
    from skyquilt.workflows.artefacts import REGISTRY
    from skyquilt.workflows.flow import align_photos
    from skyquilt.workflows.methods import methods_for
    from skyquilt.workflows.survey_input import read_input

    settings, store = MosaicSettings(), Store(folder=work / "full-store", registry=REGISTRY)
    clock, given = Clock(store=store, began=Clock.now()), read_input(source, InputSettings())
    aligned = result_of(align_photos(given, methods_for(settings), settings, clock)).alignment
    ties, frame = aligned.ties, aligned.frame
    seen = np.bincount(ties.point)
    good = np.flatnonzero(seen >= 3)
    xy = ties.xyz[good, :2]
    first = int(np.argmin(xy.sum(1)))
    second = int(np.argmax(np.hypot(*(xy - xy[first]).T)))
    (ax, ay), (bx, by) = xy[second] - xy[first], (xy - xy[first]).T
    area = np.abs(ax * by - ay * bx)
    chosen = [int(good[k]) for k in (first, second, int(np.argmax(area)))]
    checks = [int(k) for k in np.random.default_rng(0).permutation(good)[:40] if k not in chosen]
    lines = [str(frame.crs)]
    for number, k in enumerate([*chosen, *checks]):
        kind = "" if number < 3 else " check"
        x, y, z = ties.xyz[k] + (*frame.origin, 0.0)
        for row in np.flatnonzero(ties.point == k):
            u, v = ties.px[row]
            lines.append(
                f"{x:.4f} {y:.4f} {z:.4f} {u:.3f} {v:.3f} img{ties.photo[row]:02d}.jpg"
                f" p{number}{kind}"
            )
    target = work / "gcp_list.txt"
    target.write_text("\n".join(lines) + "\n")
    return target


if __name__ == "__main__":
    sys.exit(main())
