"""Measures whether the work per photo, and the memory, stay bounded as a live map grows.

python benchmarks/large_flight.py FLIGHT   first: simulates 2,000 photos of 2 MP from three drones
python benchmarks/live_scaling.py FLIGHT   then: adds all of them to a live map, with a burst

Photos are added as fast as the map accepts them, except in the burst: 90 photos at intervals of a
third of a second. The figure is CPU time per photo of the process that places, links and draws;
that of the background process is reported separately. CPU times are longer when other work shares
caches and cores. So a fixed piece of work is timed after every photo, and figures are also given in
units of its time.
"""

import argparse
import resource
import shutil
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.photos.survey import capture_order, read_survey

BURST, THIRD_S = 90, 1 / 3


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("flight", type=Path)
    parser.add_argument("--photos", type=int, default=10**6, help="stop after so many")
    asked = parser.parse_args()
    survey = read_survey(asked.flight / "photos")
    arrivals = sorted(survey.photos, key=capture_order)[: asked.photos]
    home = Path(tempfile.mkdtemp())
    live = LiveMap(home / "out", LiveSettings())
    cpu, memory, pieces = handed_in(live, [photo.path for photo in arrivals])
    early, late = np.mean(cpu[100:200]), np.mean(cpu[-100:])
    fair = [np.mean(cpu[at]) / np.mean(pieces[at]) for at in (slice(100, 200), slice(-100, None))]
    print(f"in pieces of fixed work: {fair[0]:.1f}, {fair[1]:.1f}, factor {fair[1] / fair[0]:.2f}")
    low, high = np.median(memory[100:200]), np.median(memory[-100:])
    print(f"photos 100-200: {early:.3f} s, last hundred: {late:.3f} s, factor {late / early:.2f}")
    print(
        f"memory: {low:.0f} -> {high:.0f} MB, factor {high / low:.2f}; background"
        f" {background():.0f} s"
    )
    print(f"{live.ledger.counts()}; blocks {sorted(map(len, live.members.blocks.values()))[-5:]}")
    live.close()
    shutil.rmtree(home, ignore_errors=True)


def handed_in(live: LiveMap, paths: list[Path]) -> tuple[list[float], list[float], list[float]]:
    """CPU seconds and MB of memory per photo, and CPU seconds of a fixed piece of work after
    each.
    """
    middle = range(len(paths) // 2, len(paths) // 2 + BURST)
    cpu: list[float] = []
    memory: list[float] = []
    pieces: list[float] = []
    for k, path in enumerate(paths):
        began, wall = time.process_time(), time.monotonic()
        live.intake.take_file(path, path.name[:5])
        for _ in live.drain():
            if k in middle and time.monotonic() - wall > THIRD_S:
                break
        cpu.append(time.process_time() - began)
        memory.append(resident_mb())
        pieces.append(piece_of_work())
        if k % 50 == 49:
            waiting = len(live.queues.untried)
            mean = np.mean(cpu[-50:])
            work = f"{mean:.3f} s per photo, {mean / np.mean(pieces[-50:]):.1f} pieces"
            print(
                f"{k + 1} photos: {work}, {memory[-1]:.0f} MB, {waiting} to refine, background"
                f" {background():.0f} s",
                flush=True,
            )
    return cpu, memory, pieces


PICTURE = np.random.default_rng(0).integers(0, 255, (600, 800), np.uint8)


def piece_of_work() -> float:
    """CPU seconds of some features of a fixed picture."""
    began = time.process_time()
    cv2.SIFT_create(300).detectAndCompute(PICTURE, None)
    return time.process_time() - began


def background() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


if __name__ == "__main__":
    main()
