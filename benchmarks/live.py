"""How quickly does a photo appear, how good is the growing map, and does the work per photo stay bounded?

python benchmarks/live.py latency SURVEY [--rate 1.0] [--gsd 5]     every photo from 'file complete' to 'tile in hand'
python benchmarks/live.py seams SURVEY [--gsd 5]                    seam disparity of the live map against the batch map
python benchmarks/live.py scaling PHOTOS                            a simulated flight: time and memory per photo
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np


def latency(survey: Path, rate: float, gsd: float) -> None:
    home = Path(tempfile.mkdtemp())
    inbox, out = home / "in", home / "out"
    inbox.mkdir()
    command = [
        sys.executable,
        "-m",
        "skyquilt",
        "live",
        str(inbox),
        "-o",
        str(out),
        "--port",
        "0",
        "--gsd",
        str(gsd),
        "--json",
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        url = json.loads(process.stdout.readline())["url"]
        threading.Thread(target=lambda: process.stdout.read(), daemon=True).start()
        complete: dict[str, float] = {}
        visible: dict[str, float] = {}
        threading.Thread(target=watch, args=(url, visible), daemon=True).start()
        time.sleep(1)
        for path in sorted(p for p in survey.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".tif")):
            began = time.monotonic()
            shutil.copyfile(path, inbox / path.name)
            complete[path.name] = time.monotonic()
            time.sleep(max(0.0, 1 / rate - (time.monotonic() - began)))
        until = time.monotonic() + 60
        while len(visible) < len(complete) and time.monotonic() < until:
            time.sleep(0.1)
    finally:
        process.terminate()
        process.wait()
        shutil.rmtree(home, ignore_errors=True)
    waits = np.array([visible[n] - t for n, t in complete.items() if n in visible])
    print(
        f"{len(waits)} of {len(complete)} photos seen: median {np.median(waits):.2f} s, worst {waits.max():.2f} s"
    )
    print(" ".join(f"{w:.2f}" for w in waits))


def watch(url: str, visible: dict[str, float]) -> None:
    """Follows the news as a browser does and fetches the tile at each photo's centre."""
    with urllib.request.urlopen(f"{url}events?after=0") as news:
        kind = ""
        for raw in news:
            line = raw.decode().rstrip()
            if line.startswith("event: "):
                kind = line[7:]
            elif line.startswith("data: ") and kind == "photo":
                said = json.loads(line[6:])
                if said.get("ring") and said["name"] not in visible:
                    lon, lat = said["at"]
                    n, phi = 2**21, np.radians(lat)
                    x, y = (
                        int((lon + 180) / 360 * n),
                        int((1 - np.log(np.tan(phi) + 1 / np.cos(phi)) / np.pi) / 2 * n),
                    )
                    with urllib.request.urlopen(f"{url}tiles/21/{x}/{y}") as tile:
                        if tile.status == 200 and tile.read():
                            visible[said["name"]] = time.monotonic()


def seams(survey: Path, gsd: float) -> None:
    from skyquilt.config import MosaicSettings, methods
    from skyquilt.imaging.views import grid_of, make_views, native_gsd
    from skyquilt.model.poses import Alignment, no_ties
    from skyquilt.photos.pixels import read_color
    from skyquilt.pipelines import drawing, intake, reporting
    from skyquilt.pipelines.live.settings import LiveSettings
    from skyquilt.pipelines.live.story import LiveMap
    from skyquilt.pipelines.mosaic import REGISTRY, mosaic
    from skyquilt.render.exposure import NEUTRAL
    from skyquilt.run.pixel_cache import PixelCache
    from skyquilt.run.store import Store

    home = Path(tempfile.mkdtemp())
    live = LiveMap(home / "live", LiveSettings(gsd_cm=gsd))
    for path in sorted(p for p in survey.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".tif")):
        live.add(path)
    time.sleep(2.2)
    for _ in live.settle():
        pass
    members = list(live.members.on_map())
    photos = tuple(m.photo for m in members)
    store = Store(folder=home / "store", registry=REGISTRY)
    cache = PixelCache(read=lambda i: read_color(photos[i]), budget_bytes=600_000_000)
    settings = MosaicSettings(balance=False)
    parts = methods(settings)
    taken = drain(intake.take_in(photos, cache, parts, store, 2))
    alignment = Alignment(
        method="live", why="", frame=live.members.frame,
        poses={k: m.pose for k, m in enumerate(members)},
        cameras={m.camera: live.members.camera(m) for m in members},
        camera_of={k: m.camera for k, m in enumerate(members)},
        blocks=(tuple(range(len(members))),), ties=no_ties(),
    )  # fmt: skip
    rough = make_views(alignment, live.canvas.surface((-1, -1, 1, 1)))
    bounds = grid_of(rough, 1.0).bounds
    surface = live.canvas.surface(bounds)
    views = make_views(alignment, surface)
    native = native_gsd(views, surface)
    ground = drawing.Ground(
        surface=surface, views=tuple(views), grid=grid_of(views, drawing.round_gsd(native)), native_gsd=native
    )
    compose = drawing.composer(taken, ground, alignment, NEUTRAL, parts, cache)
    drawn = drain(drawing.draw(home, compose, alignment, settings, store, "live", drawing.unit_of(taken), 2))
    of_live = drain(reporting.seams(compose, drawn, ground)).figures
    of_batch = mosaic(survey, home / "batch").metrics["seam_disparity_px"]
    print("live: ", of_live)
    print("batch:", of_batch)
    live.close()
    shutil.rmtree(home, ignore_errors=True)


def drain(steps):
    try:
        while True:
            next(steps)
    except StopIteration as stop:
        return stop.value


def scaling(count: int) -> None:
    from skyquilt.photos.survey import read_survey
    from skyquilt.pipelines.live.flying import FlySettings, order_of
    from skyquilt.pipelines.live.settings import LiveSettings
    from skyquilt.pipelines.live.story import LiveMap
    from skyquilt.simulate import FlightSettings, simulate
    from skyquilt.simulate.camera import Lens
    from skyquilt.simulate.settings import Control, Route

    home = Path(tempfile.mkdtemp())
    settings = FlightSettings(
        seed=2,
        lens=Lens().scaled(480, 360),
        route=Route(photos=count, drones=3),
        control=Control(points=0, checks=0),
        gsd=0.3,
    )
    for _ in simulate(settings, home / "flight", overwrite=True):
        pass
    arrivals = order_of(read_survey(home / "flight" / "photos").photos, FlySettings(drones=3))
    live = LiveMap(home / "out", LiveSettings())
    seconds, memory = [], []
    for k, (_, photo, _) in enumerate(arrivals):
        began = time.thread_time()
        live.add(photo.path)
        seconds.append(time.thread_time() - began)
        memory.append(resident_mb())
        if k % 50 == 49:
            print(
                f"{k + 1} photos: {np.mean(seconds[-50:]):.3f} s of CPU per photo, {memory[-1]:.0f} MB",
                flush=True,
            )
    early, late = np.mean(seconds[100:200]), np.mean(seconds[-100:])
    print(f"photos 100-200: {early:.3f} s, last hundred: {late:.3f} s, factor {late / early:.2f}")
    print(f"memory {memory[200 if count > 200 else 0]:.0f} -> {memory[-1]:.0f} MB; {live.ledger.counts()}")
    live.close()
    shutil.rmtree(home, ignore_errors=True)


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("latency", "seams", "scaling"))
    parser.add_argument("of")
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--gsd", type=float, default=5.0)
    asked = parser.parse_args()
    if asked.what == "latency":
        latency(Path(asked.of), asked.rate, asked.gsd)
    elif asked.what == "seams":
        seams(Path(asked.of), asked.gsd)
    else:
        scaling(int(asked.of))
