"""Where a growing map shows its photos, and when: how far seams are off while a flight arrives.

python benchmarks/live_places.py FLIGHT [--rate 1]     a simulated flight, against its truth
python benchmarks/live_places.py SURVEY --run RUN      photos, against the finished map of a run
    [--order shuffled|bursts]                          photos out of order, or ten at once
    [--without positions]                              photos that tell no position
    [--pictures FOLDER]                                the map as PNG after each sixth of photos
    [--json FILE]                                      the figures besides

Photos arrive at a rate in real time. Seams: a photo is off its neighbours where the ground between
it and most of its nearest six lies apart by more than 5 % of its width in the two, as they are
drawn. Places: its centre is off by so much, after a shift that all have in common (by a similarity
on maps without a place). Both when it is first drawn, and 1, 3 and 10 photos later.
"""

import argparse
import json
import os
import random
import shutil
import tempfile
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from skyquilt.geometry.camera import project, rays
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.model.camera import PARAMETERS, Camera
from skyquilt.model.poses import Pose
from skyquilt.model.surface import Surface
from skyquilt.raster.tile_store import SIDE
from skyquilt.runs.opened import open_run

Array = NDArray[np.float64]
OFF = 0.05
"""Share of a photo's width on the ground from which a seam, or a place, is off."""
NEAREST = 6
"""Neighbours with which a photo is compared."""
LATER = (0, 1, 3, 10)
"""Photos drawn after a photo, when it is looked at."""
STILL_S = 3.0
"""A map is done when nothing happens for so many seconds."""


@dataclass
class Truth:
    """Where photos belong."""

    pose: dict[str, Pose]
    camera: dict[str, Camera]
    surface: Surface
    centre: dict[str, Array] = field(default_factory=dict)
    width: dict[str, float] = field(default_factory=dict)
    near: dict[str, list[tuple[str, Array, Array]]] = field(default_factory=dict)
    """Neighbours of a photo, and the pixels (k, 2) at which both show ground between them."""

    def __post_init__(self) -> None:
        for n, pose in self.pose.items():
            self.centre[n] = met(pose, rays(self.camera[n], middle(self.camera[n])), self.surface)[
                0
            ]
            high = pose.map_C[2] - float(self.surface.at(*self.centre[n][:, None])[0])
            self.width[n] = self.camera[n].width * high / self.camera[n].focal
        for n in self.pose:
            near = sorted(
                (float(np.hypot(*(self.centre[n] - self.centre[o]))), o) for o in self.pose
            )
            self.near[n] = [
                (o, *px)
                for apart, o in near
                if o != n
                and apart < 0.6 * min(self.width[n], self.width[o])
                and len((px := self._shared(n, o))[0])
            ]

    def _shared(self, n: str, o: str) -> tuple[Array, Array]:
        a, b = self.centre[n], self.centre[o]
        across = np.array([[0.0, -1.0], [1.0, 0.0]]) @ (b - a) / max(np.hypot(*(b - a)), 1e-6)
        xy = (a + b) / 2 + np.array([[-0.2], [0.0], [0.2]]) * self.width[n] * across
        xyz = np.column_stack([xy, self.surface.at(xy[:, 0], xy[:, 1])])
        px = [
            project(self.camera[k], (xyz - self.pose[k].map_C) @ self.pose[k].cam_R_map.T)
            for k in (n, o)
        ]
        inside = np.ones(len(xy), bool)
        for k, at in zip((n, o), px, strict=True):
            inside &= ((at > 0) & (at < (self.camera[k].width, self.camera[k].height))).all(1)
        return px[0][inside], px[1][inside]


def middle(camera: Camera) -> Array:
    return np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])


def met(pose: Pose, cast: Array, surface: Surface) -> Array:
    """(k, 2) where rays (k, 3) of a photo meet the ground."""
    ray = cast @ pose.cam_R_map
    down = np.minimum(ray[:, 2], -0.2)
    xy = np.repeat(pose.map_C[None, :2], len(ray), axis=0)
    for _ in range(6):
        xy = pose.map_C[:2] + ray[:, :2] * ((surface.at(*xy.T) - pose.map_C[2]) / down)[:, None]
    return xy


def heights(path: Path) -> Surface:
    """A raster of heights, in cells of a metre or more."""
    with rasterio.open(path) as file:
        step = max(1, round(1.0 / file.res[0]))
        z = file.read(1, masked=True)[step // 2 :: step, step // 2 :: step]
        known = z.filled(np.float32(np.ma.median(z))).astype(np.float32)
        west, north = file.xy(step // 2, step // 2)
        cell = step * file.res[0]
    y0 = north - (len(known) - 1) * cell
    return Surface(z=known[::-1].copy(), x0=west, y0=y0, cell=cell, source="plane")


def simulated(folder: Path) -> Truth:
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    cameras = {
        k: Camera(readout_s=c["readout"], **{n: c[n] for n in ("width", "height", *PARAMETERS)})
        for k, c in truth["cameras"].items()
    }
    photos = [p for p in truth["photos"] if p["band"] == "visible"]
    return Truth(
        pose={
            p["name"]: Pose(cam_R_map=np.array(p["cam_R_map"]), map_C=np.array(p["position"]))
            for p in photos
        },
        camera={p["name"]: cameras[p["camera"]] for p in photos},
        surface=heights(folder / "truth" / "truth_surface.tif"),
    )


def finished(folder: Path) -> Truth:
    run = open_run(folder)
    camera = {n: run.cameras[key] for n, key in run.camera_of.items()}
    return Truth(pose=dict(run.poses), camera=camera, surface=heights(folder / "surface.tif"))


@dataclass
class Look:
    """What the map shows at a moment."""

    s: float
    pose: dict[str, Pose]
    camera: dict[str, Camera]
    surface: Surface
    placeless: bool

    def _seen(self, n: str, px: Array) -> Array:
        return met(self.pose[n], rays(self.camera[n], px), self.surface)

    def seams(self, truth: Truth) -> dict[str, float]:
        """How far each photo is off its neighbours, in widths."""
        off = {}
        for n, pose in self.pose.items():
            known = [f for f in truth.near.get(n, ()) if f[0] in self.pose][:NEAREST]
            if known:
                ends = np.cumsum([len(a) for _, a, _ in known])[:-1]
                own = np.split(self._seen(n, np.concatenate([a for _, a, _ in known])), ends)
                gaps = [
                    np.median(np.hypot(*(xy - self._seen(o, b)).T))
                    for xy, (o, _, b) in zip(own, known, strict=True)
                ]
                width = truth.width[n]
                if self.placeless:
                    level = float(self.surface.at(*own[0][:1].T)[0])
                    width = self.camera[n].width * (pose.map_C[2] - level) / self.camera[n].focal
                off[n] = float(np.median(gaps)) / max(abs(width), 1e-3)
        return off

    def places(self, truth: Truth, origin: Array) -> dict[str, float]:
        """How far the centre of each photo is from its place, in widths."""
        names = [n for n in self.pose if n in truth.pose]
        if not names:
            return {}
        a = np.concatenate([self._seen(n, middle(self.camera[n])) for n in names])
        b = np.array([truth.centre[n] for n in names])
        a, b = (v[:, 0] + 1j * v[:, 1] for v in (a, b))
        if self.placeless:
            weight = np.ones(len(a))
            for _ in range(20):
                p, q = a - np.average(a, weights=weight), b - np.average(b, weights=weight)
                scale = (weight * p.conj() * q).sum() / max((weight * abs(p) ** 2).sum(), 1e-9)
                off = scale * p - q
                weight = 1 / np.maximum(abs(off), 0.3)
        else:
            off = a + complex(*origin) - b
            off = off - complex(np.median(off.real), np.median(off.imag))
        return {n: float(abs(o)) / truth.width[n] for n, o in zip(names, off, strict=True)}


def look_at(live: LiveMap, began: float) -> Look:
    drawn = {i: p for i, p in live.redraw._drawn.items() if live.members.by_id[i].pose is not None}
    of = {i: live.members.by_id[i] for i in drawn if live.members.by_id[i].state != "superseded"}
    C = np.array([p.map_C for p in drawn.values()]).reshape(-1, 3)
    low, high = (C.min(0) - 40, C.max(0) + 40) if len(C) else (np.zeros(3), np.ones(3))
    return Look(
        s=time.monotonic() - began,
        pose={m.photo.name: drawn[i] for i, m in of.items()},
        camera={m.photo.name: live.members.camera(m) for m in of.values()},
        surface=live.canvas.surface((low[0], low[1], high[0], high[1])),
        placeless=live.members.placeless,
    )


def stripped(path: Path, home: Path) -> Path:
    """A copy that tells no position, of otherwise the same bytes."""
    data = path.read_bytes()
    for order, tag, other in (
        ("little", b"\x25\x88\x04\x00", b"\x26\x88\x04\x00"),
        ("big", b"\x88\x25\x00\x04", b"\x88\x26\x00\x04"),
    ):
        one = (1).to_bytes(4, order)
        data = data.replace(tag + one, other + one)
    copy = home / path.name
    copy.write_bytes(data.replace(b"drone-dji:Gps", b"drone-dji:Xps"))
    return copy


def arrivals(paths: list[Path], order: str, rate: float) -> list[tuple[float, Path]]:
    if order == "shuffled":
        paths = random.Random(1).sample(paths, len(paths))
    times = [k / rate for k in range(len(paths))]
    if order == "bursts":
        times = [k // 10 * 10 / rate for k in range(len(paths))]
    return list(zip(times, paths, strict=True))


def grown(
    live: LiveMap, due: list[tuple[float, Path]], pictures: Path | None
) -> tuple[list[Look], dict[str, float]]:
    """The map at every moment at which it looks different, and the seconds from a photo's arrival
    until it is drawn.
    """
    began = time.monotonic()
    waiting, arrived = deque(due), dict[str, float]()
    looks, last, waits, busy = list[Look](), (), dict[str, float](), began
    every = max(1, len(due) // 6)
    while waiting or time.monotonic() - busy < STILL_S or live.background.busy:
        while waiting and waiting[0][0] <= time.monotonic() - began:
            at, path = waiting.popleft()
            live.intake.take_file(path, path.name[:5])
            arrived[path.name] = at
            if pictures is not None and len(arrived) % every == 0:
                picture(live, pictures / f"{len(arrived):03d}.png")
        update = live.work()
        if update is None:
            time.sleep(0.01)
            continue
        busy = time.monotonic()
        now = tuple((i, id(p)) for i, p in live.redraw._drawn.items())
        fresh = len(now) > len(last)
        if now != last and (fresh or not looks or time.monotonic() - began - looks[-1].s > 0.5):
            last = now
            looks.append(look_at(live, began))
            for n in looks[-1].pose:
                waits.setdefault(n, looks[-1].s - arrived[n])
    if looks:
        looks.append(look_at(live, began))
    if pictures is not None:
        picture(live, pictures / "end.png")
    return looks, waits


def picture(live: LiveMap, path: Path) -> None:
    """Writes what the map shows, about 1600 px wide."""
    for layer in live.tiles.layers():
        for level in range(8):
            at = live.tiles.addresses(layer, level)
            if at and max(max(a.col for a in at) - min(a.col for a in at), 1) <= 7:
                break
        if not at or "newest" in layer:
            continue
        row, column = min(a.row for a in at), min(a.col for a in at)
        rows, columns = max(a.row for a in at) - row + 1, max(a.col for a in at) - column + 1
        canvas = np.full((rows * SIDE, columns * SIDE, 3), 255, np.uint8)
        for a in at:
            tile = live.tiles.get(a)
            if tile is not None:
                y, x = (a.row - row) * SIDE, (a.col - column) * SIDE
                shown = tile.pixels[..., :3] if tile.pixels.shape[-1] >= 3 else tile.pixels[..., :1]
                if shown.dtype != np.uint8:
                    good = shown[tile.shown]
                    low, high = np.percentile(good, (1, 99)) if len(good) else (0, 1)
                    shown = np.clip(255 * (shown - low) / max(high - low, 1e-6), 0, 255)
                canvas[y : y + SIDE, x : x + SIDE][tile.shown] = np.broadcast_to(
                    shown, (SIDE, SIDE, 3)
                )[tile.shown]
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path.with_stem(f"{path.stem}-{layer}")), canvas[..., ::-1])


def figures(
    looks: list[Look], waits: dict[str, float], truth: Truth, origin: Array, photos: int
) -> dict[str, float]:
    seams = [k.seams(truth) for k in looks]
    places = [k.places(truth, origin) for k in looks]
    first = {n: next(k for k, x in enumerate(looks) if n in x.pose) for n in waits}
    order = sorted(waits, key=lambda n: first[n])
    found: dict[str, float] = {"photos": photos, "drawn": len(waits)}
    for later in LATER:
        for name, all_of in (("seam", seams), ("place", places)):
            off = []
            for k, n in enumerate(order):
                if k + later < len(order):
                    at = all_of[first[order[k + later]]].get(n)
                    off += [] if at is None else [at]
            found[f"{name} +{later}"] = float(np.mean(np.array(off) > OFF)) if off else np.nan
    for name, all_of in (("seam", seams), ("place", places)):
        end = np.array((list(all_of[-1].values()) if looks else []) or [np.nan])
        found[f"{name} end"] = float((end > OFF).mean())
        found[f"{name} end p50"], found[f"{name} end max"] = float(np.median(end)), float(end.max())
        steps = np.diff([k.s for k in looks])
        wrong = np.array([sum(v > OFF for v in all_of[k].values()) for k in range(len(steps))])
        found[f"{name} s"] = float((wrong * steps).sum()) / photos
    found["worst place"] = max((max(p.values(), default=0) for p in places), default=0)
    took = np.array(list(waits.values()) or [np.nan])
    found["wait p50"], found["wait max"] = float(np.median(took)), float(took.max())
    found["done s"] = looks[-1].s if looks else np.nan
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("flight", type=Path)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--order", choices=("as taken", "shuffled", "bursts"), default="as taken")
    parser.add_argument("--without", choices=("positions",))
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    truth = finished(asked.run) if asked.run else simulated(asked.flight)
    photos = asked.flight if asked.run else asked.flight / "photos"
    home = Path(tempfile.mkdtemp())
    paths = sorted(p for p in photos.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".tif"))
    if asked.without:
        paths = [stripped(p, home) for p in paths]
    live = LiveMap(home / "out", LiveSettings())
    looks, waits = grown(live, arrivals(paths, asked.order, asked.rate), asked.pictures)
    frame = live.members.frame
    origin = np.array(frame.origin if frame is not None else (0.0, 0.0))
    found = figures(looks, waits, truth, origin, len(paths))
    states = dict[str, int]()
    for m in live.members.by_id.values():
        states[m.state] = states.get(m.state, 0) + 1
    print(
        asked.flight.name,
        asked.order,
        asked.without or "",
        states,
        f"load {os.getloadavg()[0]:.1f}",
    )
    print("  " + ", ".join(f"{k} {v:.3g}" for k, v in found.items()), flush=True)
    if looks:
        ends = looks[-1].places(truth, origin)
        worst = sorted(ends, key=lambda n: -ends[n])[:4]
        print(
            "  worst at the end:", ", ".join(f"{n} {ends[n] * truth.width[n]:.1f} m" for n in worst)
        )
    for name, reason in live.ledger.rows("select name, reason from photo where state = 'refused'"):
        print(f"  {name} was refused: {reason}")
    log = home / "out" / "errors.log"
    if log.exists():
        print(log.read_text())
    if asked.json:
        asked.json.write_text(json.dumps(found))
    live.close()
    shutil.rmtree(home, ignore_errors=True)


if __name__ == "__main__":
    main()
