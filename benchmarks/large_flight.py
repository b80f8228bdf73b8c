"""Simulates a flight of thousands of 2 MP photos from three drones, in minutes rather than hours.

python benchmarks/large_flight.py FOLDER [--photos 2000]

Terrain, camera, noise and metadata are those of the simulator. Only the ray casting is simplified:
rays meet a smoothed ground (hills; houses and trees are painted on it flat), so nothing is hidden
by anything else. The photos are suitable for measuring time and memory per photo, but not for
measuring accuracy.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from skyquilt.simulate import FlightSettings, expose, simulate
from skyquilt.simulate.raycast import Rays, sample
from skyquilt.simulate.settings import Control, Route

GSD = 0.1
"""Cell of the country's raster in m; the photos' own is 0.045 m."""


def smooth_hits(surface: np.ndarray, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Where rays meet the smoothed ground: two steps of the fixed point, ample for gentle hills."""
    ground = cv2.blur(surface, (101, 101))
    height = np.full(rays.start.shape[:2], np.float32(np.median(ground)))
    for _ in range(2):
        height = sample(ground, rays.at(height))
    return rays.at(height), height


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photos", type=int, default=2000)
    asked = parser.parse_args()
    expose.first_hits = smooth_hits
    route, control = Route(photos=asked.photos, drones=3), Control(points=0, checks=0)
    settings = FlightSettings(seed=2, route=route, control=control, gsd=GSD)
    began, last = time.process_time(), -1
    for step in simulate(settings, asked.folder, overwrite=True):
        if step.done * 10 // step.total != last:
            last = step.done * 10 // step.total
            print(
                f"{step.stage} {step.done} of {step.total}, {time.process_time() - began:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
