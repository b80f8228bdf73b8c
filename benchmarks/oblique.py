"""Oblique photos among vertical ones, with the sky in some of them.

    python benchmarks/oblique.py [--seeds 1,2,3] [--kite] [--work FOLDER]

For each seed, 32 vertical and eight oblique photos (57 to 80 degrees, sky in five) are simulated,
1000 px wide, and mapped with and without the oblique ones. `--kite`: without positions and angles,
tilts of 8 degrees. Sky is looked for by the truth: each map pixel is traced to the photo that it
shows (provenance.tif) and along that photo's true ray.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from skyquilt import simulate as sim
from skyquilt.settings import MosaicSettings
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, FlightSettings, Reporting, Route
from skyquilt.workflows.mosaic import mosaic

SIDE = (1000, 750)


def flight(seed: int, *, kite: bool) -> FlightSettings:
    """The simulated flight."""
    lens = Lens().scaled(*SIDE)
    if not kite:
        return FlightSettings(seed=seed, lens=lens, route=Route(photos=32, oblique=8))
    route = Route(photos=32, oblique=8, tilt_noise=8.0, yaw_noise=30.0, jitter=3.0)
    reporting = Reporting(attitude_missing=True, gps_missing=40)
    none = Control(points=0, checks=0)
    return FlightSettings(seed=seed, lens=lens, route=route, reporting=reporting, control=none)


def sky_pixels(folder: Path, truth: dict[str, Any]) -> tuple[int, float]:
    """Map pixels (of provenance.tif) whose photo shows the sky there, and the largest true angle in
    degrees from the vertical of any pixel shown.
    """
    shots = json.loads((folder / "shots.geojson").read_text())["features"]
    cameras = json.loads((folder / "cameras.json").read_text())
    true = {p["name"]: np.array(p["cam_R_map"]) for p in truth["photos"]}
    with (
        rasterio.open(folder / "provenance.tif") as file,
        rasterio.open(folder / "surface.tif") as heights,
    ):
        number = file.read(1)
        row, column = np.nonzero(number)
        x, y = file.transform * (column + 0.5, row + 0.5)
        r, c = rasterio.transform.rowcol(heights.transform, x, y)
        z = heights.read(1)
        z = z[np.clip(r, 0, z.shape[0] - 1), np.clip(c, 0, z.shape[1] - 1)]
    ground, shown, sky, steepest = np.column_stack([x, y, z]), number[row, column], 0, 0.0
    for k, shot in enumerate(shots, 1):
        mine = shown == k
        if not mine.any():
            continue
        said = shot["properties"]
        assert said["camera"] in cameras
        R = rotation(np.array(said["rotation"]))
        ray = (ground[mine] - np.array(said["translation"])) @ R.T  # camera axes as estimated
        up = ray @ true[said["filename"]]  # and where the true camera looked there
        angle = np.degrees(np.arctan2(np.hypot(up[:, 0], up[:, 1]), -up[:, 2]))
        sky += int((angle >= 90).sum())
        steepest = max(steepest, float(angle.max()))
    return sky, steepest


def rotation(vector: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Rotation matrix of a rotation vector."""
    import cv2

    return np.asarray(cv2.Rodrigues(vector)[0])


def levelled_to(folder: Path, truth: dict[str, Any]) -> float:
    """Angle in degrees between the map's vertical and the true one, by the photos' rotations."""
    shots = json.loads((folder / "shots.geojson").read_text())["features"]
    true = {p["name"]: np.array(p["cam_R_map"]) for p in truth["photos"]}
    ups = [
        (true[s["properties"]["filename"]].T @ rotation(np.array(s["properties"]["rotation"])))[2]
        for s in shots
    ]
    return float(np.degrees(np.arccos(np.clip(np.median(ups, axis=0)[2], -1, 1))))


def one(seed: int, work: Path, *, kite: bool) -> None:
    """Simulates and maps one flight; prints its rows."""
    home = work / f"{'kite' if kite else 'drone'}-{seed}"
    for _ in sim.simulate(flight(seed, kite=kite), home / "flight", overwrite=True):
        pass
    truth = json.loads((home / "flight/truth/truth.json").read_text())
    photos = sorted((home / "flight/photos").glob("*.jpg"))
    upright = [p for p in photos if "oblique" not in p.name]
    settings = MosaicSettings(gsd_cm=6, gcp=None)
    for name, chosen in (("with", photos), ("without", upright)):
        done = mosaic(chosen, home / name, settings, overwrite=True).metrics
        sky, steepest = sky_pixels(home / name, truth)
        gps = done["gps_residual_rms_m"]
        hung = sum("oblique" in p.name for p in photos) - sum(
            "oblique" in p for p in done["photos_rejected"]
        )
        print(
            f"| {seed} | {name} | {done['photos_used']} | {hung if name == 'with' else '-'} |"
            f" {sky} | {steepest:.1f} | {done['size_px'][0]} x {done['size_px'][1]} |"
            f" {done['reprojection_error_px']['rms']:.3f} |"
            f" {done['seam_disparity_px']['median']:.2f} / {done['seam_disparity_px']['p95']:.2f} |"
            f" {'-' if gps is None else ' '.join(f'{gps[a]:.2f}' for a in 'xyz')} |"
            f" {levelled_to(home / name, truth):.2f} |",
            flush=True,
        )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--kite", action="store_true")
    parser.add_argument("--work", type=Path)
    asked = parser.parse_args()
    print(
        "| seed | oblique photos | photos in the map | oblique ones placed | pixels of sky |"
        " largest true angle | size | reprojection rms px | seams median / p95 px |"
        " GPS residual m |"
        " level off by |\n|---|---|---|---|---|---|---|---|---|---|---|"
    )
    with tempfile.TemporaryDirectory() as folder:
        for seed in asked.seeds.split(","):
            one(int(seed), asked.work or Path(folder), kite=asked.kite)


if __name__ == "__main__":
    main()
