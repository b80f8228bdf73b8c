"""Does the work per photo, and the memory, stay bounded as a live map grows?

python benchmarks/large_flight.py FLIGHT            first: 2,000 photos of 2 MP from three drones
python benchmarks/live_scaling.py FLIGHT            then: all of them into a live map, with a burst in the middle

Photos are handed in as fast as the map takes them, but for the burst: 90 photos, of each of which the map has a third
of a second before the next one comes. What counts is CPU time per photo of the process that places, links and draws,
so that other work on the machine does not; that of the background process is told besides.
"""

import argparse
import resource
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from skyquilt.photos.survey import read_survey
from skyquilt.pipelines.live.flying import FlySettings, order_of
from skyquilt.pipelines.live.settings import LiveSettings
from skyquilt.pipelines.live.story import LiveMap

BURST, THIRD_S = 90, 1 / 3


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("flight", type=Path)
    parser.add_argument("--photos", type=int, default=10**6, help="stop after so many")
    asked = parser.parse_args()
    survey = read_survey(asked.flight / "photos")
    arrivals = order_of(survey.photos, FlySettings(drones=3))[: asked.photos]
    home = Path(tempfile.mkdtemp())
    live = LiveMap(home / "out", LiveSettings())
    cpu, memory = handed_in(live, [photo.path for _, photo, _ in arrivals])
    early, late = np.mean(cpu[100:200]), np.mean(cpu[-100:])
    low, high = np.median(memory[100:200]), np.median(memory[-100:])
    print(f"photos 100-200: {early:.3f} s, last hundred: {late:.3f} s, factor {late / early:.2f}")
    print(f"memory: {low:.0f} -> {high:.0f} MB, factor {high / low:.2f}; background {background():.0f} s")
    print(f"{live.ledger.counts()}; blocks {sorted(map(len, live.members.blocks.values()))[-5:]}")
    live.close()
    shutil.rmtree(home, ignore_errors=True)


def handed_in(live: LiveMap, paths: list[Path]) -> tuple[list[float], list[float]]:
    """CPU seconds and MB of memory per photo."""
    middle = range(len(paths) // 2, len(paths) // 2 + BURST)
    cpu: list[float] = []
    memory: list[float] = []
    for k, path in enumerate(paths):
        began, wall = time.process_time(), time.monotonic()
        live.intake.take_file(path, path.name[:5])
        for _ in live.drain():
            if k in middle and time.monotonic() - wall > THIRD_S:
                break
        cpu.append(time.process_time() - began)
        memory.append(resident_mb())
        if k % 50 == 49:
            waiting = len(live.queues.untried)
            print(
                f"{k + 1} photos: {np.mean(cpu[-50:]):.3f} s per photo, {memory[-1]:.0f} MB, {waiting} to be refined,"
                f" background {background():.0f} s",
                flush=True,
            )
    return cpu, memory


def background() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


if __name__ == "__main__":
    main()
