"""Simulates large flights in minutes rather than hours.

python benchmarks/large_flight.py FOLDER [--photos 2000]    2 MP photos from three drones
                                          [--jobs 2]         by two processes
python benchmarks/large_flight.py FOLDER --kind small       300 photos of 0.3 MP from three drones
python benchmarks/large_flight.py FOLDER --kind tiny        300 photos of 0.17 MP
python benchmarks/large_flight.py FOLDER --kind dense       172 photos of 0.5 MP, 87 % overlap
python benchmarks/large_flight.py FOLDER --kind wing        167 photos of 9.7 MP, 50 % overlap

Terrain, camera, noise and metadata are those of the simulator. Only the ray casting is simplified:
rays meet a smoothed ground (hills; houses and trees are painted on it flat), so nothing is hidden
by anything else. The photos are suitable for measuring time and memory per photo, but not for
measuring accuracy; the poses in truth/truth.json are true, and no true rasters are written.

The same command goes on where an earlier one stopped. The terrain lies in files, of which only
what is being drawn is in memory.
"""

import argparse
import json
import mmap
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from skyquilt.simulate import FlightSettings, Progress, expose, prepare
from skyquilt.simulate import run as run_module
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.expose import Exposer, exposer
from skyquilt.simulate.flight import Shot
from skyquilt.simulate.grid import Grid
from skyquilt.simulate.raycast import rays_of, sample
from skyquilt.simulate.run import World, photograph
from skyquilt.simulate.scene import Scene
from skyquilt.simulate.settings import Control, Route
from skyquilt.simulate.truth import write_truth

KINDS = {
    "large": (Lens(), Route(photos=2000, drones=3)),
    "small": (Lens(width=640, height=480, focal=533.0), Route(photos=300, drones=3)),
    "tiny": (Lens(width=480, height=360, focal=400.0), Route(photos=300, drones=3)),
    "dense": (
        Lens(width=816, height=612, focal=680.0),
        Route(photos=172, overlap=0.87, sidelap=0.7, height=40.0),
    ),
    "wing": (
        Lens(width=3600, height=2700, focal=2900.0),
        Route(photos=167, overlap=0.5, sidelap=0.6, height=120.0, speed=15.0),
    ),
}
"""Camera and route by name."""
GSD = 0.1
"""Least cell of the country's raster in m; the pixels of 2 MP photos are 0.045 m."""
LAYERS = {"height": ((), np.float32), "rgb": ((3,), np.uint8), "look": ((4,), np.float16)}
"""Rasters of the terrain."""
NODES = 8
"""Spacing in px of the rays that are cast."""
OFTEN = 8
"""Steps after which what was drawn is put away."""
DRAWN: list[tuple[World, Path]] = []
"""What a process draws, and the folder of its terrain."""


class LevelExposer(Exposer):
    """Takes photos of the smoothed ground, quickly: rays are cast at nodes, and nothing has flanks
    or a horizon.
    """

    def pixels(self, shot: Shot) -> tuple[np.ndarray, np.ndarray, Grid]:
        """Where rays meet the ground: two steps of the fixed point, ample for gentle hills."""
        window = self.window(shot)
        ground = cv2.blur(self.scene.height[window.slices], (101, 101))
        rows, columns = (
            np.unique(np.r_[0:n:NODES, n - 1]) for n in (self.lens.height, self.lens.width)
        )
        directions = np.ascontiguousarray(self.directions[np.ix_(rows, columns)])
        corner = np.array([window.xs[0], window.ys[0]])
        rays = rays_of(directions, shot.rotation, shot.place, corner, window.res)
        height = np.full(rays.start.shape[:2], np.float32(np.median(ground)))
        for _ in range(2):
            height = sample(ground, rays.at(height))
        u, v = (
            np.interp(np.arange(n), at, np.arange(len(at))).astype(np.float32)
            for n, at in ((self.lens.width, columns), (self.lens.height, rows))
        )
        hits = cv2.remap(rays.at(height), *np.meshgrid(u, v), cv2.INTER_LINEAR)
        return hits, height, window

    def flanks(self, hits: np.ndarray, heights: np.ndarray, window: Grid) -> np.ndarray:
        return np.ones((1, 1), np.float32)


def level_exposer(scene: Scene, lens: Lens) -> Exposer:
    """Prepares a camera over a scene."""
    plain = exposer(scene, lens)
    return LevelExposer(scene=scene, lens=lens, directions=plain.directions, lowest=plain.lowest)


def open_terrain(world: World, folder: Path) -> Scene:
    """The terrain's files, made where they are not there."""
    grid = world.country.grid(world.settings.resolution)
    folder.mkdir(parents=True, exist_ok=True)
    rasters: dict[str, Any] = {}
    for name, (tail, kind) in LAYERS.items():
        path, shape = folder / f"{name}.npy", (grid.height, grid.width, *tail)
        known = path.exists() and np.load(path, mmap_mode="r").shape == shape
        mode = "r+" if known else "w+"
        rasters[name] = np.lib.format.open_memmap(path, mode=mode, dtype=kind, shape=shape)
        if not known:
            (folder / "done.json").unlink(missing_ok=True)
    return Scene(grid=grid, thermal=None, **rasters)


def put_away(scene: Scene) -> None:
    """Gives back the memory of a terrain that lies in files."""
    for raster in (scene.height, scene.rgb, scene.look):
        raster._mmap.madvise(mmap.MADV_DONTNEED)


def draw(world: World, scene: Scene, folder: Path, jobs: int) -> Iterator[Progress]:
    """Draws what is not drawn yet: all surfaces, then their light, which needs those around."""
    note = folder / "done.json"
    done = json.loads(note.read_text()) if note.exists() else 0
    blocks = world.country.blocks(scene)
    total = 2 * blocks
    world.country.layout  # noqa: B018  computed before the processes part
    drawing = {"initializer": DRAWN.append, "initargs": ((world, folder),)}
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork"), **drawing) as pool:
        while done < total:
            end = min(done + OFTEN * jobs, blocks if done < blocks else total)
            parts = [range(done + k, end, jobs) for k in range(jobs)]
            for part in [pool.submit(draw_steps, p) for p in parts]:
                part.result()
            done = end
            note.write_text(json.dumps(done))
            yield Progress(stage="terrain", done=done, total=total)


def draw_steps(steps: range) -> None:
    """Draws some blocks into the terrain's files, in a process of its own."""
    world, folder = DRAWN[-1]
    scene = open_terrain(world, folder)
    for step in steps:
        world.country.draw_step(scene, world.settings.weather, step)
    for raster in (scene.height, scene.rgb, scene.look):
        raster.flush()
    put_away(scene)


def take(world: World, folder: Path, share: tuple[int, int]) -> None:
    """Takes a share of the photos."""
    scene = open_terrain(world, folder / ".terrain")
    for step in photograph(world, scene, folder, resume=True, share=share):
        if step.done % OFTEN == 0:
            put_away(scene)


def run(world: World, folder: Path, jobs: int) -> Iterator[Progress]:
    """The whole flight."""
    scene = open_terrain(world, folder / ".terrain")
    yield from draw(world, scene, folder / ".terrain", jobs)
    others = [
        get_context("fork").Process(target=take, args=(world, folder, (k, jobs)))
        for k in range(1, jobs)
    ]
    for other in others:
        other.start()
    if others:
        take(world, folder, (0, jobs))
    for other in others:
        other.join()
    photos = photograph(world, scene, folder, resume=True)
    while True:
        try:
            step = next(photos)
        except StopIteration as end:
            taken = end.value
            break
        if step.done % OFTEN == 0:
            put_away(scene)
        yield step
    (folder / "truth").mkdir(exist_ok=True)
    truth = folder / "truth" / "truth.json"
    write_truth(truth, world.settings, world.place, world.start, taken, [], [], [])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kind", choices=KINDS, default="large")
    parser.add_argument("--photos", type=int, help="instead of the kind's own number")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=1, help="processes at work")
    asked = parser.parse_args()
    run_module.exposer, expose.with_horizon = level_exposer, lambda seen, *_: seen
    lens, route = KINDS[asked.kind]
    if asked.photos:
        route = replace(route, photos=asked.photos)
    pixel = route.height / lens.focal
    settings = FlightSettings(
        seed=asked.seed,
        lens=lens,
        route=route,
        control=Control(points=0, checks=0),
        gsd=min(max(GSD, pixel), 2 * pixel),
    )
    world = prepare(settings)
    began, last = time.process_time(), ("", -1)
    for step in run(world, asked.folder, max(asked.jobs, 1)):
        if last != (step.stage, step.done * 10 // step.total):
            last = step.stage, step.done * 10 // step.total
            spent = time.process_time() - began
            print(f"{step.stage} {step.done} of {step.total}, {spent:.0f} s", flush=True)


if __name__ == "__main__":
    main()
