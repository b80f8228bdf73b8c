"""The methods of both papers on simulated surveys: A's Tables 1 and 2 for surveys of six lines, and
the closed loop of the thesis.

    python benchmarks/methods.py [--surveys six-73,six-168,loop] [--work FOLDER] [--json FILE]

six-N: N photos in six lines, by flightline and bundle: geolocation MAE and RMS per axis against the
TRUE positions (which the papers did not have), and CPU seconds. loop: the thesis's round trip of 40
planned photos, three of them lost. For each method, the distance on level ground between the places
where the first and the last photo show the same ground (not for bundle, which uses the relief; null
if the two are too far apart to be registered).

Photos have 640 x 480 px (six lines) and 1600 x 1200 px (loop). A survey is simulated once and kept
in the work folder.
"""

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from skyquilt import simulate as sim
from skyquilt.errors import SkyquiltError
from skyquilt.quality.geolocation import geolocation_errors
from skyquilt.settings import MosaicSettings
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Route
from skyquilt.workflows.mosaic import mosaic

LINES = 6
METHODS = {
    "flightline": {"method": "flightline"},
    "flightline-sift-all": {"method": "flightline", "detector": "sift-all"},
    "flightline-similarity": {"method": "flightline", "transform": "similarity"},
    "bundle": {"method": "bundle"},
}
LOOP = (
    ("pose", {}),
    ("image", {}),
    ("hybrid", {"optimiser": "surfaces"}),
    ("hybrid-anneal", {"optimiser": "anneal"}),
    ("bundle", {}),
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--surveys", default="six-73,six-168,loop")
    parser.add_argument(
        "--work", type=Path, default=Path(tempfile.gettempdir()) / "skyquilt-methods"
    )
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = {}
    for name in args.surveys.split(","):
        rows[name] = loop(args.work) if name == "loop" else six(int(name.split("-")[1]), args.work)
        print(json.dumps({name: rows[name]}, indent=1), flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


def simulated(folder: Path, settings: sim.FlightSettings) -> dict:
    """The survey's truth; simulated where it is not there yet."""
    if not (folder / "truth" / "truth.json").is_file():
        for _ in sim.simulate(settings, folder, overwrite=True):
            pass
    return json.loads((folder / "truth" / "truth.json").read_text())


def six_lines(photos: int) -> sim.FlightSettings:
    """Six lines, as many photos as asked for: the last ones of the last line are missing."""
    lens = Lens().scaled(640, 480)
    along = 60.0 * lens.height / lens.focal * (1 - 0.75)
    across = 60.0 * lens.width / lens.focal * (1 - 0.60)
    each = -(-photos // LINES)
    route = Route(
        site=((each - 1) * along, (LINES - 1) * across), overlap=0.75, sidelap=0.60, height=60.0
    )
    return sim.FlightSettings(seed=7, lens=lens, route=route, control=Control(points=0, checks=0))


def six(photos: int, work: Path) -> dict:
    """Geolocation and time of both methods on a six-line survey."""
    folder = work / f"six{photos}"
    truth = simulated(folder, six_lines(photos))
    chosen = sorted((folder / "photos").iterdir())[:photos]
    place = {p["name"]: np.array(p["position"]) for p in truth["photos"]}
    found: dict = {"photos": len(chosen)}
    for method in METHODS:
        began = time.process_time()
        try:
            result = mosaic(
                chosen,
                work / f"six{photos}-{method}",
                MosaicSettings(**METHODS[method]),
                overwrite=True,
            )
        except SkyquiltError as error:
            found[method] = {"refused": str(error)}
            continue
        shots = json.loads((result.output / "shots.geojson").read_text())["features"]
        names = [s["properties"]["filename"] for s in shots]
        solved = np.array([s["properties"]["translation"] for s in shots])
        errors = geolocation_errors(solved, np.array([place[n] for n in names]))
        found[method] = {
            "placed": len(names),
            # heights count from take-off on one side and from the sea on the other
            "mae_xy_m": np.round(errors.mae_m[:2], 3).tolist(),
            "rms_xy_m": np.round(errors.rms_m[:2], 3).tolist(),
            "cpu_seconds": round(time.process_time() - began, 1),
            "align_seconds": result.metrics["seconds"]["align"],
            "lambda_corr": result.metrics["quality"]["lambda_corr"],
            "notes": [n for n in result.metrics["notes"] if "line" in n],
        }
    return found


def loop(work: Path) -> dict:
    """The step where the loop closes, of every method."""
    folder = work / "loop"
    settings = replace(sim.preset("roundtrip"), seed=1)
    truth = simulated(folder, settings)
    places = {p["name"]: np.array(p["position"]) for p in truth["photos"]}
    found = {}
    for name, more in LOOP:
        settings = MosaicSettings(method=name.split("-")[0], gsd_cm=8, **more)
        result = mosaic(folder / "photos", work / f"loop-{name}", settings, overwrite=True)
        q = result.metrics["quality"]
        shots = json.loads((result.output / "shots.geojson").read_text())["features"]
        solved = {
            s["properties"]["filename"]: np.array(s["properties"]["translation"]) for s in shots
        }
        off = np.array([solved[n][:2] - places[n][:2] for n in sorted(solved)])
        found[name] = {
            "lambda_corr": q["lambda_corr"],
            "closing_step_m": None
            if name == "bundle"
            else closing_step(result.output, sorted(solved)),
            "nadirs_rms_m": round(float(np.sqrt(((off - off.mean(0)) ** 2).sum(1).mean())), 2),
            "align_seconds": result.metrics["seconds"]["align"],
            "cpu_seconds": result.metrics["cpu_seconds"],
        }
    return found


def closing_step(output: Path, names: list[str]) -> float | None:
    """How far apart the first and the last photo put the same ground, m: both redrawn alone, and
    registered.
    """
    from skyquilt.imaging.plane import view_patch
    from skyquilt.imaging.views import make_views, native_gsd
    from skyquilt.ortho.tie_surface import level
    from skyquilt.papers.compare import alignment_of

    alignment = alignment_of(output)
    z = float(np.median(alignment.ties.xyz[:, 2])) if len(alignment.ties.xyz) else 0.0
    views = {v.photo: v for v in make_views(alignment, level(z))}
    gsd = 2 * native_gsd(list(views.values()), level(z))
    folder = output.parent / "loop" / "photos"
    patches = []
    for photo in (min(views), max(views)):
        grey = cv2.imread(str(folder / names[photo]), cv2.IMREAD_GRAYSCALE)
        patches.append(view_patch(grey, views[photo], level(z), gsd))
    a, b = patches
    r0, c0 = max(a.row, b.row), max(a.column, b.column)
    r1 = min(p.row + p.shown.shape[0] for p in patches)
    c1 = min(p.column + p.shown.shape[1] for p in patches)
    if r1 - r0 < 128 or c1 - c0 < 128:
        return None
    one, other = (p.pixels[r0 - p.row : r1 - p.row, c0 - p.column : c1 - p.column] for p in patches)
    both = np.logical_and(
        *(p.shown[r0 - p.row : r1 - p.row, c0 - p.column : c1 - p.column] for p in patches)
    )
    # the largest square that both show
    reach = cv2.distanceTransform(np.pad(both, 1).astype(np.uint8), cv2.DIST_C, 3)[1:-1, 1:-1]
    row, column = np.unravel_index(int(reach.argmax()), reach.shape)
    half = int(reach[row, column]) - 1
    if half < 64:
        return None
    inner = (slice(row - half, row + half), slice(column - half, column + half))
    hann = cv2.createHanningWindow((2 * half, 2 * half), cv2.CV_64F)
    shift, response = cv2.phaseCorrelate(
        one[inner].astype(np.float64), other[inner].astype(np.float64), hann
    )
    return round(float(np.hypot(*shift) * gsd), 3) if response > 0.03 else None


if __name__ == "__main__":
    main()
