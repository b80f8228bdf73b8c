"""Bands of simulated multispectral flights against their truth.

    python benchmarks/multispectral.py WORK [--flight landscape] [--seeds 1 2 3]

Each flight (`skyquilt simulate --multispectral --rtk`, 15 captures of five bands of 720 x 540 px,
cameras 3 cm apart and turned against each other by half a degree) is mapped with `--all-bands`.
Other flights than `landscape` have cameras 8 cm apart (`low`: at 30 m; `slope`: a mountain side;
`cliff`), or turned against each other by some 4 degrees (`knocked`).
Printed are, per flight: how far a band lies beside the green one in windows of 64 px (median and
nine of ten, map px: the displacement of each from the truth by phase correlation, less that of the
green band, scatter of the correlation included); the largest relative difference of a band's
factor from the others' (0 = one factor for all); errors of NDVI, means over 1.5 m, off edges; CPU
seconds of map and bands.
"""

import argparse
import itertools
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.warp import Resampling, reproject

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.cost import machine

from skyquilt.model.bands import canonical
from skyquilt.model.event import StageFinished
from skyquilt.multispectral.workflow import iter_bands
from skyquilt.settings import MosaicSettings
from skyquilt.simulate import FlightSettings, simulate
from skyquilt.simulate.scene import SceneSettings
from skyquilt.simulate.settings import Multispectral, Reporting, Route
from skyquilt.simulate.terrain import Terrain

FLIGHTS: dict[str, tuple[Terrain, float, float, float]] = {
    "landscape": ("landscape", 60.0, 0.03, 0.4),
    "low": ("landscape", 30.0, 0.08, 0.4),
    "slope": ("slope", 110.0, 0.08, 0.4),
    "cliff": ("cliff", 95.0, 0.08, 0.4),
    "knocked": ("landscape", 60.0, 0.05, 4.0),
}
"""Terrain, height in m, distance of the cameras in m, and the angle that they are turned by."""
WINDOW = 64
LEAST_RESPONSE = 0.3
"""Windows whose phase correlation has a lower peak tell nothing."""


def flown(folder: Path, seed: int, kind: str = "landscape") -> None:
    """Simulates a flight, unless it is there."""
    if (folder / "truth" / "truth.json").exists():
        return
    lens = FlightSettings().lens.scaled(1200, 900)
    terrain, height, apart_m, turned_deg = FLIGHTS[kind]
    settings = FlightSettings(
        seed=seed,
        lens=lens,
        scene=SceneSettings(kind=terrain),
        route=Route(photos=15, height=height),
        reporting=Reporting(rtk=True, gps_noise=0.02),
        multispectral=Multispectral(width=720, height=540, apart_m=apart_m, turned_deg=turned_deg),
    )
    for _ in simulate(settings, folder, overwrite=True):
        pass


def truth_on(path: Path, mapped: rasterio.DatasetReader) -> dict[str, NDArray[np.float32]]:
    """True reflectance of each band on the grid of a map; NaN beyond it."""
    with rasterio.open(path) as source:
        names = source.tags()["BANDS"].split()
        found = np.full((len(names), mapped.height, mapped.width), np.nan, np.float32)
        reproject(
            source.read().astype(np.float32) / 1000,
            found,
            src_transform=source.transform,
            src_crs=source.crs,
            dst_transform=mapped.transform,
            dst_crs=mapped.crs,
            resampling=Resampling.average,
            dst_nodata=np.nan,
        )
    return {canonical(n.lower()): values for n, values in zip(names, found, strict=True)}


def displaced(
    a: NDArray[np.float32], b: NDArray[np.float32]
) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Where windows (row, column) of a lie beside b, px."""
    found, hanning = {}, cv2.createHanningWindow((WINDOW, WINDOW), cv2.CV_32F)
    for row in range(0, a.shape[0] - WINDOW, WINDOW // 2):
        for column in range(0, a.shape[1] - WINDOW, WINDOW // 2):
            at = (slice(row, row + WINDOW), slice(column, column + WINDOW))
            p, q = a[at], b[at]
            if np.isfinite(p).all() and np.isfinite(q).all() and p.std() > 0 and q.std() > 0:
                shift, peak = cv2.phaseCorrelate(p / p.mean(), q / q.mean(), hanning)
                if peak > LEAST_RESPONSE:
                    found[row, column] = np.array(shift)
    return found


def judged(out: Path, flight: Path) -> dict[str, float]:
    """Figures of bands.tif."""
    with rasterio.open(out / "bands.tif") as source:
        bands = dict(zip(source.descriptions, source.read(), strict=True))
        truth = truth_on(flight / "truth" / "truth_bands.tif", source)
        gsd = source.transform.a
    moved = {name: displaced(values, truth[name]) for name, values in bands.items()}
    beside = [
        np.hypot(*(moved[name][at] - moved["green"][at]))
        for name in bands
        if name != "green"
        for at in moved[name].keys() & moved["green"].keys()
    ]
    known = np.isfinite(np.stack([*bands.values(), *truth.values()])).all(0)
    factors = [
        float(values[known].sum() / truth[name][known].sum()) for name, values in bands.items()
    ]
    size = max(1, round(1.5 / gsd)) | 1
    mean = {
        (whose, name): cv2.blur(np.nan_to_num(values), (size, size))
        for whose, found in (("map", bands), ("truth", truth))
        for name, values in found.items()
    }
    ndvi = {
        whose: (mean[whose, "nir"] - mean[whose, "red"])
        / np.maximum(mean[whose, "nir"] + mean[whose, "red"], 1e-9)
        for whose in ("map", "truth")
    }
    inner = cv2.erode(known.astype(np.uint8), np.ones((size, size))) > 0
    off = np.abs(ndvi["map"] - ndvi["truth"])[inner]
    return {
        "beside green, median": float(np.median(beside)),
        "90 %": float(np.percentile(beside, 90)),
        "factors differ by": max(abs(a / b - 1) for a, b in itertools.permutations(factors, 2)),
        "NDVI off, median": float(np.median(off)),
        "NDVI off, 90 %": float(np.percentile(off, 90)),
    }


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--flight", choices=FLIGHTS, default="landscape")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    asked = parser.parse_args()
    print(machine())
    for seed in asked.seeds:
        name = f"{asked.flight}{seed}"
        flight, out = asked.work / name, asked.work / f"map-{name}"
        flown(flight, seed, asked.flight)
        cpu = {}
        settings = MosaicSettings(jobs=1)
        for event in iter_bands(flight / "multispectral", out, settings, overwrite=True):
            if isinstance(event, StageFinished):
                cpu[event.stage] = event.cpu_seconds
        told = json.loads((out / "metrics.json").read_text())["bands"]
        own = {b["name"]: b["off_px"] for b in told["shown"] if b["off_px"] is not None}
        figures = judged(out, flight)
        said = ", ".join(f"{name} {value:.3f}" for name, value in figures.items())
        cost = f"map {sum(v for k, v in cpu.items() if k not in ('rig', 'bands')):.1f} s"
        cost += f", cameras {cpu['rig']:.1f} s, bands {cpu['bands']:.1f} s"
        print(f"seed {seed}: {said}; own figures {own}; {cost}")


if __name__ == "__main__":
    main()
