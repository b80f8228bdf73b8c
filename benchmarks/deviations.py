"""Are the reported deviations right? Errors over them, on simulated observations.

    python -m benchmarks.deviations [--draws 300] [--kinds block,control,...] [--noise 0.15]

Each draw is a flight of its own: errors of focal length, lens, positions and angles are drawn from
the deviations that the metadata state, keypoints err independently. The whole of `bundle` runs on
its photos, features and links. Prints the RMS of errors over stated deviations (right: 1) and the
share of errors within two (right: 95 %).
"""

import argparse
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from tests.alignment.blocks import LENS  # noqa: E402
from tests.alignment.test_bundle import FRAME, Flown  # noqa: E402

from skyquilt.alignment.bundle import Bundle  # noqa: E402
from skyquilt.alignment.control import Control  # noqa: E402
from skyquilt.model.camera import PARAMETERS, Camera  # noqa: E402

SIGMA_K = np.array([8.0, 4.0, 4.0, 0.02, 0.02, 0.01, 1e-3, 1e-3, 2e-3, 1e-9])
KINDS = {
    "control": ({"gps": 2.0}, True),
    "block": ({"gps": 2.0}, False),
    "strip": ({"gps": 2.0, "lines": 1, "per_line": 16, "overlap": 0.8}, False),
    "rtk": ({"gps": 0.02, "true_tilt_deg": 1.0}, False),
    "two heights": ({"gps": 2.0, "heights": (60.0, 85.0)}, False),
}
"""Name -> the block, and whether it has control points."""


class Drawn(Flown):
    """A flight whose lens errs by the deviations that its calibration states."""

    def __init__(self, seed: int, noise: float, **options) -> None:
        free = np.array([1, 1, 1, 1, 1, 1, 1, 1, 1, 0], bool)
        super().__init__(seed, noise=noise, sigma_k=SIGMA_K, free=free, lens=LENS, **options)
        names = dict(zip(PARAMETERS, LENS[:9].tolist(), strict=True))
        told = Camera(width=800, height=600, sigmas=tuple(SIGMA_K[:9].tolist()), **names)
        self.photos = [
            replace(p, calibration=told, focal=replace(p.focal, sigma_px=float(SIGMA_K[0])))
            for p in self.photos
        ]


def points_of(flown: Flown, rng: np.random.Generator, check: bool, count: int) -> list[Control]:
    """Surveyed points, marked in photos with the deviations that the adjustment assumes."""
    from tests.alignment.blocks import HEIGHT, WIDTH, ground, seen_by

    from skyquilt.alignment.control import MARKED_PX

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
    out: dict[str, list[float]] = {}
    for name in ("focal", "cx", "cy", "k1", "p1", "aspect"):
        k = PARAMETERS.index(name)
        out[name] = [(camera.vector[k] - flown.truth.K[0, k]) / camera.sigmas[k]]
    centres = [
        (p.map_C - flown.truth.C[i]) / p.sigma_m
        for i, p in found.poses.items()
        if p.sigma_m is not None
    ]
    out["centres xy"] = np.array(centres)[:, :2].ravel().tolist()
    out["centres z"] = np.array(centres)[:, 2].tolist()
    checks = [c.error_m / c.sigma_m for c in found.control if c.check and c.sigma_m is not None]
    if checks:
        out["checks xy"] = np.array(checks)[:, :2].ravel().tolist()
        out["checks z"] = np.array(checks)[:, 2].tolist()
    return out


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=300)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--noise", type=float, default=0.15)
    args = parser.parse_args()
    for kind in args.kinds.split(","):
        pooled: dict[str, list[float]] = defaultdict(list)
        for seed in range(args.draws):
            for name, values in draw(kind, seed, args.noise).items():
                pooled[name] += values
        print(f"{kind}, {args.draws} draws")
        for name, values in pooled.items():
            e = np.array(values)
            within = 100 * np.mean(np.abs(e) < 1.96)
            print(f"  {name:12s} RMS {np.sqrt((e**2).mean()):5.2f}   within 95 %: {within:5.1f} %")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
