"""The live map: time until a photo appears, quality of the growing map, CPU time per photo.

python benchmarks/live.py latency SURVEY [--rate 1.0] [--gsd 5]   file complete to tile fetched
python benchmarks/live.py browser SURVEY                          to tile shown by a browser
python benchmarks/live.py viewers SURVEY [--viewers 20]           the same with moving viewers
python benchmarks/live.py cost SURVEY                             CPU seconds per photo and step,
                                                                  and the longest step
python benchmarks/live.py seams SURVEY [--gsd 5]                  seam disparity, live and batch
python benchmarks/live.py tone SURVEY [--gsd 5]                   how evenly the balanced photos
                                                                  show the ground, live and batch

`live_scaling.py` measures whether the work per photo stays bounded.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from live_viewers import Browser

from skyquilt.engine.clock import result_of
from skyquilt.engine.pixel_cache import PixelCache
from skyquilt.engine.store import Store
from skyquilt.engine.workers import HERE
from skyquilt.imaging.views import grid_of, make_views, native_gsd
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.model.poses import Alignment, no_ties
from skyquilt.ortho import orthomosaic
from skyquilt.ortho.exposure import NEUTRAL, Exposure
from skyquilt.ortho.ground import Ground, round_gsd
from skyquilt.ortho.occlusion import gentle
from skyquilt.photos.pixels import read_color
from skyquilt.quality.seam_measurement import measure_seams
from skyquilt.quality.tone import tone_residual
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.methods import methods_for
from skyquilt.workflows.mosaic import mosaic
from skyquilt.workflows.photo_features import thumbnail_of


@contextmanager
def running(gsd: float) -> Iterator[tuple[str, Path]]:
    """A live map in a process of its own: its address and the folder it watches."""
    home = Path(tempfile.mkdtemp())
    inbox = home / "in"
    inbox.mkdir()
    options = ["-o", str(home / "out"), "--port", "0", "--gsd", str(gsd), "--json"]
    command = [sys.executable, "-m", "skyquilt", "live", str(inbox), *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        url = json.loads(process.stdout.readline())["url"]
        threading.Thread(target=lambda: process.stdout.read(), daemon=True).start()
        time.sleep(1)
        yield url, inbox
    finally:
        process.terminate()
        process.wait()
        shutil.rmtree(home, ignore_errors=True)


def photos_of(survey: Path) -> list[Path]:
    return sorted(p for p in survey.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".tif"))


def replayed(
    survey: Path, inbox: Path, rate: float, idle: Callable[[float], None] = time.sleep
) -> dict[str, float]:
    """Copies photos at a rate; when each was complete (seconds since the epoch)."""
    complete: dict[str, float] = {}
    for path in photos_of(survey):
        began = time.time()
        shutil.copyfile(path, inbox / path.name)
        complete[path.name] = time.time()
        idle(max(0.0, 1 / rate - (time.time() - began)))
    return complete


def told(complete: dict[str, float], visible: dict[str, float], what: str) -> float:
    waits = np.array([visible[n] - t for n, t in complete.items() if n in visible])
    load = os.getloadavg()[0]
    print(
        f"{what}: {len(waits)} of {len(complete)} photos seen: median {np.median(waits):.2f} s,"
        f" worst {waits.max():.2f} s; load of the machine {load:.1f}"
    )
    print(" ".join(f"{w:.2f}" for w in waits))
    return float(np.median(waits))


def latency(survey: Path, rate: float, gsd: float, viewers: int = 0) -> float:
    visible: dict[str, float] = {}
    with running(gsd) as (url, inbox):
        threading.Thread(target=watch, args=(url, visible), daemon=True).start()
        crowd = None
        if viewers:
            script = Path(__file__).parent / "live_viewers.py"
            crowd = subprocess.Popen(
                [sys.executable, str(script), url, str(viewers)], stdout=subprocess.PIPE, text=True
            )
        complete = replayed(survey, inbox, rate)
        until = time.time() + 60
        while len(visible) < len(complete) and time.time() < until:
            time.sleep(0.1)
        if crowd is not None:
            crowd.terminate()
            print(crowd.communicate()[0].strip())
    return told(complete, visible, f"{viewers} viewers besides" if viewers else "latency")


def with_viewers(survey: Path, rate: float, gsd: float, viewers: int) -> None:
    alone = latency(survey, rate, gsd)
    crowded = latency(survey, rate, gsd, viewers)
    print(f"factor {crowded / alone:.2f}")


def browser(survey: Path, rate: float, gsd: float) -> None:
    with running(gsd) as (url, inbox), Browser(url) as page:
        complete = replayed(survey, inbox, rate, page.wait)
        page.wait(5)
        visible = page.shown()
    told(complete, visible, "browser")


def cost(survey: Path, gsd: float) -> None:
    from skyquilt.live.live_map import LiveMap
    from skyquilt.live.settings import LiveSettings

    home = Path(tempfile.mkdtemp())
    live = LiveMap(home / "out", LiveSettings(gsd_cm=gsd))
    used: dict[str, list[float]] = {}
    longest = 0.0
    for path in photos_of(survey):
        shown, first = 0.0, True
        began = time.process_time()
        live.intake.take_file(path, "survey")
        steps = {"accepted": time.process_time() - began}
        while True:
            began = time.process_time()
            update = live.work()
            if update is None:
                break
            seconds = time.process_time() - began
            longest = max(longest, seconds)
            what = "drawn first" if update.what == "drawn" and first else update.what
            first = first and not (update.what == "drawn" and not live.redraw.urgent)
            steps[what] = steps.get(what, 0.0) + seconds
        shown = sum(steps.get(k, 0.0) for k in ("accepted", "placed", "drawn first"))
        for key, seconds in {**steps, "to the event": shown, "all": sum(steps.values())}.items():
            used.setdefault(key, []).append(seconds)
    print(
        {k: round(sum(v) / len(photos_of(survey)), 3) for k, v in used.items()},
        f"s of CPU per photo; longest step {longest:.2f} s",
    )
    live.close()
    shutil.rmtree(home, ignore_errors=True)


def watch(url: str, visible: dict[str, float]) -> None:
    """Follows the news as a browser does and fetches the tile at each photo's centre."""
    with urllib.request.urlopen(f"{url}events?after=0") as map_events:
        kind = ""
        for raw in map_events:
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
                            visible[said["name"]] = time.time()


@contextmanager
def mapped(survey: Path, gsd: float) -> Iterator[tuple[LiveMap, Alignment, Ground]]:
    """A live map of all photos of a survey, and its poses and heights as a batch run's."""
    home = Path(tempfile.mkdtemp())
    live = LiveMap(home / "live", LiveSettings(gsd_cm=gsd))
    for path in sorted(
        p for p in survey.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".tif")
    ):
        live.add(path)
    time.sleep(2.2)
    for _ in live.drain_all():
        pass
    members = list(live.members.on_map())
    alignment = Alignment(
        method="live",
        why="",
        frame=live.members.frame,
        poses={k: m.pose for k, m in enumerate(members)},
        cameras={m.camera: live.members.camera(m) for m in members},
        camera_of={k: m.camera for k, m in enumerate(members)},
        blocks=(tuple(range(len(members))),),
        ties=no_ties(),
    )
    rough = make_views(alignment, live.canvas.surface((-1, -1, 1, 1)))
    surface = live.canvas.surface(grid_of(rough, 1.0).bounds)
    surface = gentle(surface, np.array([p.map_C for p in alignment.poses.values()]))
    views = make_views(alignment, surface)
    native = native_gsd(views, surface)
    grid = grid_of(views, round_gsd(native))
    yield live, alignment, Ground(surface=surface, views=tuple(views), grid=grid, native_gsd=native)
    live.close()
    shutil.rmtree(home, ignore_errors=True)


def seams(survey: Path, gsd: float) -> None:
    home = Path(tempfile.mkdtemp())
    with mapped(survey, gsd) as (live, alignment, ground):
        photos = tuple(m.photo for m in live.members.on_map())
        store = Store(folder=home / "store", registry=REGISTRY)
        cache = PixelCache(read=lambda i: read_color(photos[i]), budget_bytes=600_000_000)
        settings = MosaicSettings(balance=False)
        methods = methods_for(settings)
        compose = orthomosaic.composer(3, "uint8", ground, NEUTRAL, None, methods.blend, cache)
        drawing = orthomosaic.Drawing(
            output=home, compose=compose, alignment=alignment, settings=settings.output,
            boundary=None, unit=photos[0].unit, store=store, key="live",
        )  # fmt: skip
        result_of(drawing.blocks(HERE))
        of_live = measure_seams(compose, drawing.companions(), ground).figures
    of_batch = mosaic(survey, home / "batch").metrics["seam_disparity_px"]
    print("live: ", of_live)
    print("batch:", of_batch)
    shutil.rmtree(home, ignore_errors=True)


def tone(survey: Path, gsd: float) -> None:
    with mapped(survey, gsd) as (live, _, ground):
        members = list(live.members.on_map())
        small = {k: thumbnail_of(read_color(m.photo)) for k, m in enumerate(members)}
        settled = live.canvas.exposure
        exposure = Exposure(
            gains={k: settled.gains[m.id] for k, m in enumerate(members)},
            fields={k: settled.fields[m.id] for k, m in enumerate(members)},
            offsets={},
            shades={
                k: settled.shades[m.id] for k, m in enumerate(members) if m.id in settled.shades
            },
        )
        place = ground.views, small, ground.surface, ground.grid.bounds
        of_live, of_none = (tone_residual(*place, e) for e in (exposure, NEUTRAL))
    home = Path(tempfile.mkdtemp())
    of_batch = mosaic(survey, home).metrics["tone_residual"]
    shutil.rmtree(home, ignore_errors=True)
    print("spread of balanced photos over shared cells, grey values")
    for what, found in (("live", of_live), ("batch", of_batch), ("not balanced", of_none)):
        print(f"{what:13} {found}")
    print(f"live over batch: {of_live['median'] / of_batch['median']:.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("latency", "browser", "viewers", "cost", "seams", "tone"))
    parser.add_argument("of", type=Path)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--gsd", type=float, default=5.0)
    parser.add_argument("--viewers", type=int, default=20)
    asked = parser.parse_args()
    if asked.what == "latency":
        latency(asked.of, asked.rate, asked.gsd)
    elif asked.what == "browser":
        browser(asked.of, asked.rate, asked.gsd)
    elif asked.what == "viewers":
        with_viewers(asked.of, asked.rate, asked.gsd, asked.viewers)
    elif asked.what == "cost":
        cost(asked.of, asked.gsd)
    elif asked.what == "seams":
        seams(asked.of, asked.gsd)
    else:
        tone(asked.of, asked.gsd)
