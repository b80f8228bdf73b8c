"""Are the reported deviations right? Errors over them, on simulated observations.

    OMP_NUM_THREADS=1 python -m benchmarks.deviations [--draws 300] [--kinds block,control,...]
    [--noise 0.15] [--lines FILE] [--pictures 30] [--work FOLDER]

Each draw is a flight of its own: errors of focal length, lens, positions and angles are drawn from
the deviations that the metadata state, keypoints err independently. The whole of `bundle` runs on
its photos, features and links. Prints the RMS of errors over stated deviations (right: 1) and the
share of errors within two (right: 95 %). `--pictures N` takes N flights with simulated pictures
instead, of all kinds in turn, 15 photos of 800 px each.
"""

import argparse
import json
import sys
import tempfile
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from tests.alignment.blocks import LENS  # noqa: E402
from tests.alignment.test_bundle import FRAME, Flown  # noqa: E402

from skyquilt.alignment.bundle import Bundle  # noqa: E402
from skyquilt.alignment.control import MARKED_PX, Control  # noqa: E402
from skyquilt.alignment.false_tilts import turned_prior  # noqa: E402
from skyquilt.alignment.problem import READOUT  # noqa: E402
from skyquilt.engine.clock import Clock, result_of  # noqa: E402
from skyquilt.engine.store import Store  # noqa: E402
from skyquilt.geometry.frames import rotation_from_vector  # noqa: E402
from skyquilt.model.camera import PARAMETERS, Camera  # noqa: E402
from skyquilt.model.poses import Alignment  # noqa: E402
from skyquilt.settings import MosaicSettings  # noqa: E402
from skyquilt.simulate import simulate  # noqa: E402
from skyquilt.simulate.camera import Lens  # noqa: E402
from skyquilt.simulate.settings import Control as SurveyedPoints  # noqa: E402
from skyquilt.simulate.settings import FlightSettings, Reporting, Route  # noqa: E402
from skyquilt.workflows.artefacts import REGISTRY  # noqa: E402
from skyquilt.workflows.flow import align_photos  # noqa: E402
from skyquilt.workflows.methods import methods_for  # noqa: E402
from skyquilt.workflows.survey_input import read_input  # noqa: E402

SIGMA_K = np.array([8.0, 4.0, 4.0, 0.02, 0.02, 0.01, 1e-3, 1e-3, 2e-3, 1.0, 1e-9])
KINDS = {
    "control": ({"gps": 2.0}, True),
    "block": ({"gps": 2.0}, False),
    "strip": ({"gps": 2.0, "lines": 1, "per_line": 16, "overlap": 0.8}, False),
    "rtk": ({"gps": 0.02, "true_tilt_deg": 1.0}, False),
    "two heights": ({"gps": 2.0, "heights": (60.0, 85.0)}, False),
}
"""Name -> the block, and whether it has control points."""


TILT_DEG, YAW_DEG = 0.5, 3.0
"""Deviations of reported angles."""


class Drawn(Flown):
    """A flight whose lens and angles err by the deviations that are stated for them; tilts each for
    itself, and all alike.
    """

    def __init__(self, seed: int, noise: float, **options) -> None:
        free = np.array([1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0], bool)
        options = {"sigma_k": SIGMA_K, "free": free, "lens": LENS, **options}
        super().__init__(seed, noise=noise, tilt_deg=TILT_DEG, yaw_deg=YAW_DEG, **options)
        alike = np.radians(np.random.default_rng([seed, 9]).normal(0, TILT_DEG, 2))
        gimbal = rotation_from_vector(np.array([[*alike, 0.0]]))[0]
        self.priors = [
            replace(p, sigma_tilt_deg=TILT_DEG, sigma_yaw_deg=YAW_DEG)
            for p in (turned_prior(p, gimbal) for p in self.priors)
        ]
        names = dict(zip(PARAMETERS, LENS[:READOUT].tolist(), strict=True))
        told = Camera(width=800, height=600, sigmas=tuple(SIGMA_K[:READOUT].tolist()), **names)
        self.photos = [
            replace(p, calibration=told, focal=replace(p.focal, sigma_px=float(SIGMA_K[0])))
            for p in self.photos
        ]


def points_of(flown: Flown, rng: np.random.Generator, check: bool, count: int) -> list[Control]:
    """Surveyed points, marked in photos with the deviations that the adjustment assumes."""
    from tests.alignment.blocks import HEIGHT, WIDTH, ground, seen_by

    C = flown.truth.C
    low, high = C[:, :2].min(0), C[:, :2].max(0)
    found = []
    while len(found) < count:
        xy = rng.uniform(low - 5, high + 5)
        X = np.array([*xy, float(ground(xy[None])[0])])
        photo, px = [], []
        for i in range(len(C)):
            p = seen_by(flown.truth.R[i], C[i], flown.truth.K[0], X[None])[0]
            if (p > 5).all() and p[0] < WIDTH - 6 and p[1] < HEIGHT - 6:
                photo.append(i)
                px.append(p + rng.normal(0, MARKED_PX, 2))
        if len(photo) >= 3:
            found.append(
                Control(
                    name=f"{'c' if check else 'g'}{len(found)}",
                    check=check,
                    xyz=X + rng.normal(0, 0.02, 3),
                    sigma_m=0.02,
                    photo=np.array(photo),
                    px=np.array(px),
                )
            )
    return found


def draw(kind: str, seed: int, noise: float) -> dict[str, list[float]]:
    """Normalised errors of one flight."""
    options, with_control = KINDS[kind]
    flown = Drawn(1000 + seed, noise, **options)
    rng = np.random.default_rng([seed, 5])
    control = points_of(flown, rng, True, 4)
    if with_control:
        control += points_of(flown, rng, False, 5)
    found = Bundle()(flown.photos, FRAME, flown.priors, flown.features, flown.links, control, None)
    (camera,) = found.cameras.values()
    lens = dict(zip(PARAMETERS, flown.truth.K[0].tolist(), strict=False))
    return errors(found, camera, lens, dict(enumerate(flown.truth.C)), heights=True)


SMALL = Lens().scaled(800, 600)
GPS = Reporting(gps_noise=2.0)
RTK = Reporting(gps_noise=0.02, gps_noise_z=0.03, rtk=True)
FLIGHTS = (
    (Route(photos=15, overlap=0.8), GPS, True),
    (Route(photos=15, overlap=0.8, heading=80.0), GPS, False),
    (Route(pattern="strip", photos=15, overlap=0.8), GPS, False),
    (Route(photos=15, overlap=0.8, height=45.0), RTK, False),
    (Route(photos=15, overlap=0.8, jitter=4.0), GPS, False),
)
"""Route, what is reported, and whether control points are used."""


def pictured(number: int, work: Path) -> dict[str, list[float]]:
    """Normalised errors of one flight with pictures; its focal length errs by 1 %."""
    route, reporting, with_control = FLIGHTS[number % len(FLIGHTS)]
    wrong = float(np.random.default_rng([number, 77]).normal(0, 0.01))
    reporting = replace(reporting, dewarp=(SMALL.p1, SMALL.p2), focal_error=wrong)
    control = SurveyedPoints(points=4, checks=4, pixel_noise=MARKED_PX)
    settings = FlightSettings(
        seed=500 + number, lens=SMALL, route=route, reporting=reporting, control=control
    )
    home = work / f"flight-{number}"
    if not (home / "truth" / "truth.json").is_file():
        for _ in simulate(settings, home, overwrite=True):
            pass
    truth = json.loads((home / "truth" / "truth.json").read_text())
    asked = MosaicSettings(gcp=home / "gcp_list.txt", shutter="global")
    given = read_input(home / "photos", asked.input)
    if not with_control:
        given = replace(given, control=tuple(replace(c, check=True) for c in given.control))
    clock = Clock(store=Store(folder=home / "store", registry=REGISTRY), began=Clock.now())
    aligned = result_of(align_photos(given, methods_for(asked), asked, clock))
    found, lens = aligned.alignment, truth["cameras"]["visible"]
    (camera,) = found.cameras.values()
    true = {p["name"]: np.array(p["position"]) for p in truth["photos"]}
    origin = np.array([*found.frame.origin, 0.0])
    if found.frame.vertical_datum == "takeoff":
        origin[2] += truth["vertical"]["takeoff_m"]
    C = {i: true[aligned.photos[i].name] - origin for i in found.poses}
    return errors(found, camera, lens, C, heights=with_control or reporting.rtk)


def errors(
    found: Alignment, camera: Camera, lens: dict[str, float], C: dict[int, Any], *, heights: bool
) -> dict[str, list[float]]:
    """Errors over stated deviations: of a camera, of the centres C (3,) in m by photo, and of check
    points. Without `heights` their common zero is not stated, and errors of heights are left out.
    """
    out: dict[str, list[float]] = {}
    for name in ("focal", "cx", "cy", "k1", "p1", "aspect"):
        out[name] = [(getattr(camera, name) - lens[name]) / camera.sigmas[PARAMETERS.index(name)]]
    poses = [(i, p) for i, p in found.poses.items() if p.sigma_m is not None]
    centres = np.array([(p.map_C - C[i]) / p.sigma_m for i, p in poses])
    checks = [c.error_m / c.sigma_m for c in found.control if c.check and c.sigma_m is not None]
    for name, values in (("centres", centres), ("checks", np.array(checks))):
        if len(values):
            out[f"{name} xy"] = values[:, :2].ravel().tolist()
            if heights:
                out[f"{name} z"] = values[:, 2].tolist()
    return out


def printed(title: str, pooled: dict[str, list[float]]) -> None:
    """Prints RMS and share within 95 % of each quantity."""
    print(title)
    for name, values in pooled.items():
        e = np.array(values)
        within = 100 * np.mean(np.abs(e) < 1.96)
        print(f"  {name:12s} RMS {np.sqrt((e**2).mean()):5.2f}   within 95 %: {within:5.1f} %")
    sys.stdout.flush()


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=300)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--noise", type=float, default=0.15)
    parser.add_argument("--lines", type=Path, help="errors of each draw, a JSON object per line")
    parser.add_argument("--pictures", type=int, metavar="N", help="flights with pictures instead")
    folder = Path(tempfile.gettempdir()) / "skyquilt-deviations"
    parser.add_argument("--work", type=Path, default=folder)
    args = parser.parse_args()
    if unknown := set(args.kinds.split(",")) - set(KINDS):
        parser.error(f"no kind {', '.join(sorted(unknown))}; there are {', '.join(KINDS)}")
    if args.pictures:
        pooled = defaultdict[str, list[float]](list)
        for number in range(args.pictures):
            found = pictured(number, args.work)
            for name, values in found.items():
                pooled[name] += values
            print(number, {k: [round(e, 2) for e in v] for k, v in found.items()}, flush=True)
        printed(f"{args.pictures} flights with pictures", pooled)
        return 0
    for kind in args.kinds.split(","):
        pooled = defaultdict(list)
        for seed in range(args.draws):
            found = draw(kind, seed, args.noise)
            if args.lines:
                with args.lines.open("a") as file:
                    file.write(json.dumps({"kind": kind, "seed": seed, **found}) + "\n")
            for name, values in found.items():
                pooled[name] += values
        printed(f"{kind}, {args.draws} draws", pooled)
    return 0


if __name__ == "__main__":
    sys.exit(main())
