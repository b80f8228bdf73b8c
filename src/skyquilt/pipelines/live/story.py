"""The live map: photos in any order become a map that is always there, photo by photo.

Read `LiveMap.work`: one unit of work at a time, the most urgent first. Everything that must survive is in the
ledger, the tile store and the folder of photos before the next unit begins; a restart reads them and goes on.
"""

import json
import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from skyquilt.config import MosaicSettings, methods
from skyquilt.errors import OutputError, UnreadablePhotoError, UsageError
from skyquilt.model import features, poses
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Pose
from skyquilt.photos.pixels import read_color
from skyquilt.pipelines.drawing import round_gsd
from skyquilt.pipelines.intake import Looked
from skyquilt.pipelines.live.closing import Closed, Closing, Job, close
from skyquilt.pipelines.live.drawing import NEWEST, Canvas
from skyquilt.pipelines.live.intake import Accepted, Intake, Refused
from skyquilt.pipelines.live.placing import Change, Placing, link_bytes
from skyquilt.pipelines.live.settings import CLOSING, GROWTH, PART, SWEEPING, LiveSettings
from skyquilt.pipelines.live.state import Member, Members, pose_from, pose_record
from skyquilt.raster.tile_store import Address, TileStore
from skyquilt.run.inbox import Inbox
from skyquilt.run.ledger import Ledger
from skyquilt.run.pixel_cache import PixelCache
from skyquilt.run.store import Store
from skyquilt.run.write_points import reached
from skyquilt.surface.cells import HeightCells

PHOTOS, TILES, FINISHED = "photos", "tiles.db", "finished"
"""Where accepted photos, the map's tiles and the final map lie in the survey's folder."""
STORE = Path(FINISHED) / ".skyquilt" / "store"
FULL_BYTES = 120_000_000
"""Full-size photos at hand."""
DRAWN_AT_ONCE = 8
"""Tiles drawn in one unit of work."""
LOOP = 12
"""Steps along links beyond which a new link closes a loop."""


QUIET_S = 2.0
"""Without a new photo for so long, a block is bundled however little it has grown."""


@dataclass(frozen=True, kw_only=True)
class Update:
    """One unit of work done."""

    what: str
    """placed, waiting, refined, loose, refused, drawn, closed or noted."""
    photo: int | None = None
    """The photo it was about."""
    moved: tuple[int, ...] = ()
    """Photos that lie elsewhere now."""
    tiles: int = 0
    """Tiles written."""
    text: str = ""
    """A sentence, where there is something to say."""
    seconds: float = 0.0
    """Time it took."""


class LiveMap:
    """A survey's folder while it is written; one at a time."""

    def __init__(self, folder: Path, settings: LiveSettings | None = None) -> None:
        """Opens the folder, or takes up what an earlier run left.

        Raises:
            OutputError: it cannot be written. UsageError: it was begun with other settings.
        """
        cv2.setNumThreads(1)
        self.folder, self.settings = Path(folder), settings or LiveSettings()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot write to {folder}: {error.strerror or error}") from error
        self.ledger = Ledger(self.folder, write=True)
        self._same_settings()
        self.inbox = Inbox(self.ledger, self.folder / PHOTOS, most_bytes=self.settings.most_bytes)
        self.intake = Intake(self.ledger, self.inbox, self.settings)
        self.tiles = TileStore(self.folder / TILES, write=True)
        self.methods = methods(MosaicSettings(features=self.settings.features))
        registry = {c.__name__: c for c in (Looked, features.Features, poses.Pose)}
        self.store = Store(folder=self.folder / STORE, registry=registry)
        self.members = Members(self.ledger, self.inbox)
        self.full = PixelCache(read=self._pixels, budget_bytes=FULL_BYTES)
        self.heights = HeightCells(cell=float(self.ledger.meta("cell", 2.0)))
        self.heights.z = {(int(c), int(r)): float(z) for c, r, z in self.ledger.rows("select * from height")}
        self.placing = Placing(self.members, self.heights, self.methods, self.store, self.settings, self.full)
        self.canvas = Canvas(self.tiles, self.heights, self.full, self.members.by_id)
        self.closing = Closing()
        self._received: deque[Member] = deque(m for m in self.members.by_id.values() if m.state == "received")
        self._untried: deque[Member] = deque()
        self._lost: list[Member] = [
            m for m in self.members.by_id.values() if m.state == "waiting" and m.tried
        ]
        self._urgent: dict[Address, None] = {}
        self._dirty: dict[Address, None] = {}
        self._later: dict[Address, None] = {}
        self._drawn: dict[int, Pose] = {}
        self._to_draw: set[int] = set()
        self._fresh: dict[str, list[Address]] = {}
        self._closed_at: dict[int, int] = {}
        self._loop: int | None = None
        self._since_closing = 0
        self._last_arrival = time.monotonic()
        self._take_up()

    def _pixels(self, number: int) -> Any:
        return read_color(self.members.by_id[number].photo)

    def _same_settings(self) -> None:
        known, asked = self.ledger.meta("settings"), self.settings.shaping()
        if known is None:
            self.ledger.put_meta("settings", asked)
        elif known != asked:
            differing = ", ".join(k for k in asked if known.get(k) != asked[k])
            raise UsageError(
                f"{self.folder} was begun with other settings ({differing}); use the same, or another folder"
            )

    def _take_up(self) -> None:
        """After a restart: what is drawn stays, what moved since is drawn."""
        self.canvas.gsd = float(self.ledger.meta("gsd", 0.0))
        self.canvas.ground = float(self.ledger.meta("ground", 0.0))
        drawn = {
            int(i): json.loads(d)
            for i, d in self.ledger.rows("select id, footprint from photo where footprint != ''")
        }
        for member in self.members.by_id.values():
            if member.state in ("placed", "waiting") and not member.tried:
                self._untried.append(member)
            if member.tried and member.state == "refined":
                self.placing.learn(member)
        for member in self.members.on_map():
            addresses = self.canvas.place(member, self.members.camera(member))
            record = drawn.get(member.id, {}).get("pose")
            if record and _equal(pose_from(record), member.pose):
                self._drawn[member.id] = pose_from(record)
            else:
                self._to_draw.add(member.id)
                self._dirty.update(dict.fromkeys(addresses))
        self._closed_at = {int(k): int(v) for k, v in self.ledger.meta("closed_at", {}).items()}

    # -- adding -----------------------------------------------------------------------------------------------

    def add(self, path: Path, source: str = "") -> Update:
        """Accepts one photo and brings the map up to date with it."""
        done = self.intake.take_file(path, source or path.parent.name)
        if isinstance(done, Refused):
            return Update(what="refused", text=f"{done.name}: {done.reason}")
        last = Update(what="noted", photo=done.id, text="it was there already" if done.duplicate else "")
        for update in self.drain():
            if update.photo == done.id and update.what != "drawn":
                last = update
        return last

    def drain(self) -> Iterator[Update]:
        """Works until nothing is left but what background work may bring."""
        while (update := self.work()) is not None:
            yield update

    def settle(self) -> Iterator[Update]:
        """Works until nothing is left, loops closed and all."""
        while True:
            yield from self.drain()
            if not self.closing.busy:
                return
            time.sleep(0.02)

    # -- working ----------------------------------------------------------------------------------------------

    def work(self) -> Update | None:
        """The most urgent unit of work; None when there is none.

        Raises:
            OutputError: the disk is full; nothing accepted is lost, and the same unit is done when there is room.
        """
        began = time.perf_counter()
        self._received.extend(self.members.take_up())
        update = self._next()
        if update is None:
            return None
        return Update(**{**asdict(update), "seconds": time.perf_counter() - began})

    def _next(self) -> Update | None:
        if self._received:
            return self._place(self._received[0])
        if self._urgent:
            return self._draw(self._urgent, "")
        if (done := self.closing.outcome()) is not None:
            return self._take_over(done)
        if self._untried and self.members.frame is not None:
            return self._refine(self._untried[0])
        if self._dirty:
            return self._draw(self._dirty, "")
        if self._later:
            return self._draw(self._later, NEWEST)
        return self._behind()

    def _place(self, member: Member) -> Update:
        """The first look at a photo: on the map by its metadata at once."""
        number = member.id
        if self.placing.frame_from(member) and self.canvas.gsd == 0:
            self._begin(member)
        about = json.loads(
            str((self.ledger.row("select about from photo where id = ?", number) or ("{}",))[0] or "{}")
        )
        preview = next(
            (self.members.by_id[i] for i in about.get("preview", ()) if i in self.members.by_id), None
        )
        pose = (
            preview.pose if preview is not None and preview.pose is not None else self.placing.first(member)
        )
        try:
            self.full(number)
        except UnreadablePhotoError as error:
            return self._unreadable(member, str(error))
        with self.ledger.change():
            member.pose, member.state = pose, "waiting" if pose is None else "placed"
            self.members.save(member)
            if preview is not None:
                preview.state = "superseded"
                self.members.save(preview)
                self.ledger.tell(
                    "photo", {"id": preview.id, "name": preview.photo.name, "state": "superseded"}
                )
            self._tell(member)
        reached("photo placed")
        if preview is not None:
            self._dirty.update(dict.fromkeys(self.canvas.remove(preview.id)))
        self._received.popleft()
        self._untried.append(member)
        self._last_arrival = time.monotonic()
        if pose is not None:
            self._show(member, self._urgent)
        return Update(what=member.state, photo=number)

    def _begin(self, member: Member) -> None:
        """The map's frame and pixels, for good."""
        prior, photo = member.prior, member.photo
        assert prior is not None
        assert self.members.frame is not None
        pose = self.placing.first(member)
        above = max(float(pose.map_C[2]) if pose is not None else 50.0, 5.0)
        if self.members.frame.vertical_datum != "takeoff":
            above = 50.0
        gsd = self.settings.gsd_cm / 100 if self.settings.gsd_cm else round_gsd(3 * above / photo.focal.px)
        ground = 0.0 if self.members.frame.vertical_datum == "takeoff" else float(prior.map_C[2]) - above
        ground = ground if np.isfinite(ground) else 0.0
        self.canvas.gsd, self.canvas.ground, self.heights.cell = gsd, ground, max(0.04 * above, 4 * gsd)
        with self.ledger.change():
            self.ledger.put_meta("frame", asdict(self.members.frame))
            self.ledger.put_meta("gsd", gsd)
            self.ledger.put_meta("cell", self.heights.cell)
            self.ledger.put_meta("ground", ground)
            self.ledger.tell("map", {"crs": self.members.frame.crs, "gsd": gsd})

    def _unreadable(self, member: Member, reason: str) -> Update:
        with self.ledger.change():
            member.state, member.pose = "refused", None
            self.ledger.set_photo(member.id, state="refused", reason=reason, pose=None)
            self._tell(member, reason=reason)
        self._received.popleft()
        return Update(what="refused", photo=member.id, text=f"{member.photo.name}: {reason}")

    def _refine(self, member: Member) -> Update:
        """The second look: linked to its neighbours and settled among them."""
        if member.state == "superseded":
            self._untried.popleft()
            return Update(what="noted", photo=member.id)
        change = self.placing.refine(member)
        self._commit(member, change)
        self._untried.popleft()
        if member.state == "waiting":
            self._lost.append(member)
        return Update(
            what="refined" if member.state == "refined" else "loose", photo=member.id, moved=tuple(change.moved),
            text=change.reason,
        )  # fmt: skip

    def _commit(self, member: Member, change: Change) -> None:
        """All that one photo changed becomes true at once."""
        before = self._distance(member, change)
        for a, b in (key for key, k in change.links.items() if k is not None):
            self.members.joined(a, b)
        touched = self.heights.add(change.xyz)
        with self.ledger.change() as db:
            self.ledger.put_links(
                [(a, b, None if k is None else link_bytes(k)) for (a, b), k in change.links.items()]
            )
            self.members.save_cameras(change.cameras)
            member.tried = True
            self._moved(change.moved, change.camera_of)
            about = {"tried": True, "why": change.reason}
            self.members.save(member, about=about, reason=change.reason)
            values = [(c, r, self.heights.z[c, r]) for c, r in sorted(touched)]
            db.executemany("insert or replace into height values (?, ?, ?)", values)
            if change.cameras and len(change.xyz):
                self.ledger.put_meta("ground", float(np.median(change.xyz[:, 2])))
            self._tell(member, reason=change.reason)
        reached("photo refined")
        self.canvas.ground = float(self.ledger.meta("ground", 0.0))
        if member.state == "refined":
            self.placing.learn(member)
            self._since_closing += 1
            if before > LOOP:
                self._loop = member.id
            self._find_lost(member)
        self.placing.indexed(member)
        if self.settings.deterministic and (job := self._due(idle=False)) is not None:
            self._take_over(close(job))

    def _moved(self, moved: dict[int, Pose], camera_of: dict[int, str]) -> None:
        for i, pose in moved.items():
            other = self.members.by_id[i]
            other.pose, other.camera = pose, camera_of.get(i, other.camera)
            if other.state != "superseded":
                other.state = "refined"
            self.members.save(other, reason="")
            self.placing.indexed(other)
            if other.state == "refined" and (
                i not in self._drawn or self.canvas.moved(other, self._drawn[i])
            ):
                self._show(other)

    def _distance(self, member: Member, change: Change) -> int:
        """Steps along known links between the photos that this one links; more than LOOP = it closes a loop."""
        ends = [i for key, k in change.links.items() if k is not None for i in key if i != member.id]
        if len(ends) < 2:
            return 0
        reached, rim = {ends[0]}, {ends[0]}
        for step in range(LOOP + 1):
            if set(ends) <= reached:
                return step
            rim = {j for i in rim for j in self.members.by_id[i].links} - reached
            reached |= rim
        return LOOP + 1

    def _find_lost(self, member: Member) -> None:
        """Photos that wait for links are compared with every photo that settles."""
        for lost in [m for m in self._lost if m.photo.band == member.photo.band][-2:]:
            links = self.placing.compared(lost, [member.id])
            if any(k is not None for k in links.values()):
                self._lost.remove(lost)
                lost.tried = False
                lost.pose = None
                self._untried.append(lost)

    # -- drawing ----------------------------------------------------------------------------------------------

    def _show(self, member: Member, queue: dict[Address, None] | None = None) -> None:
        queue = self._dirty if queue is None else queue
        self._to_draw.add(member.id)
        queue.update(dict.fromkeys(self.canvas.place(member, self.members.camera(member))))

    def _draw(self, queue: dict[Address, None], rule: str) -> Update:
        """Some of the dirty tiles; when no more are, what was drawn is written down and told."""
        some = list(queue)[:DRAWN_AT_ONCE]
        written = self.canvas.draw(some, rule)
        for address in some:
            queue.pop(address, None)
            if not rule:
                self._dirty.pop(address, None)
                self._later.setdefault(address)
        self._fresh.setdefault(rule, []).extend(some)
        tiles = len(written)
        if not queue:
            tiles += self._told(rule)
        return Update(what="drawn", tiles=tiles)

    def _told(self, rule: str) -> int:
        """The coarser levels, and the news for those who look on."""
        raised = self.canvas.finish()
        shown = [] if rule else [i for i in self._to_draw if not self._waits(i)]
        with self.ledger.change():
            for i in shown:
                self._drawn_now(self.members.by_id[i])
            self._tell_tiles(self._fresh.pop(rule, []), rule)
        reached("drawing told")
        self._to_draw.difference_update(shown)
        return raised

    def _waits(self, number: int) -> bool:
        """Whether tiles of a photo are still to be drawn."""
        tiles = self.canvas.tiles_of(number)
        return any(a in self._dirty or a in self._urgent for a in tiles)

    def _drawn_now(self, member: Member) -> None:
        if member.pose is None or member.state == "superseded":
            self.ledger.set_photo(member.id, footprint="")
            return
        ring, at = self._place_of(member)
        self.ledger.set_photo(member.id, footprint={"ring": ring, "at": at, "pose": pose_record(member.pose)})
        self._drawn[member.id] = member.pose
        self._tell(member, ring=ring, at=at)

    def _place_of(self, member: Member) -> tuple[list[list[float]], list[float]]:
        """Footprint and centre in degrees."""
        assert member.pose is not None
        outline = self.canvas.outline(member.id)
        ring = [] if outline is None else self.members.lonlat(outline)
        return ring, self.members.lonlat(member.pose.map_C[None, :2])[0]

    def _tell(self, member: Member, **more: Any) -> None:
        photo = member.photo
        said = {"id": member.id, "name": photo.name, "source": member.source, "state": member.state,
                "time": photo.time.isoformat() if photo.time else None}  # fmt: skip
        self.ledger.tell("photo", {**said, **more})

    def _tell_tiles(self, addresses: Iterable[Address], rule: str) -> None:
        by_layer: dict[str, list[tuple[float, float, float, float]]] = {}
        for a in addresses:
            by_layer.setdefault(a.layer + rule, []).append(a.grid(self.canvas.gsd).bounds)
        for layer, boxes in by_layer.items():
            box = np.array(boxes)
            corners = np.array([[box[:, 0].min(), box[:, 1].min()], [box[:, 2].max(), box[:, 3].max()]])
            low, high = self.members.lonlat(corners)
            self.ledger.tell("tiles", {"layer": layer, "bounds": [*low, *high], "count": len(boxes)})

    # -- behind the scenes ------------------------------------------------------------------------------------

    def _behind(self) -> Update | None:
        if self.settings.deterministic or self.closing.busy:
            return None
        job = self._due(idle=True)
        if job is None:
            return None
        self.closing.start(job)
        return Update(what="noted", text=f"{len(job.ids)} photos are adjusted together in the background")

    def _due(self, *, idle: bool) -> Job | None:
        """The block, or part of one, that should be adjusted as a whole now."""
        if not self.settings.reposition or self._since_closing == 0:
            return None
        best = max(self.members.blocks.values(), key=len, default=set())
        root = self._loop if self._loop is not None else (max(best) if best else 0)
        block = self.members.block(root) if root in self.members.by_id else best
        grown = len(block) >= GROWTH * self._closed_at.get(self.members.block_of.get(root, 0), 2)
        quiet = idle and time.monotonic() - self._last_arrival > QUIET_S
        if len(block) < 3 or not (grown or self._loop is not None or quiet):
            return None
        ids, held = sorted(block), frozenset[int]()
        if len(block) > CLOSING:
            if not idle and self._loop is None and self._since_closing < PART // 4:
                return None
            ids, held = self._around(root)
        swept = quiet and not held and len(ids) <= SWEEPING
        return self._job(ids, held, self.members.block_of.get(root, root), len(block), sweep=swept)

    def _around(self, root: int) -> tuple[list[int], frozenset[int]]:
        """The photos nearest along links, and the ring of those beyond, which are held."""
        reached: dict[int, None] = {root: None}
        queue = deque([root])
        while queue and len(reached) < 2 * PART:
            for j in sorted(self.members.by_id[queue.popleft()].links):
                if j not in reached and self.members.by_id[j].pose is not None:
                    reached[j] = None
                    queue.append(j)
        ids = list(reached)
        return sorted(ids), frozenset(ids[PART:])

    def _job(self, ids: list[int], held: frozenset[int], block: int, size: int, *, sweep: bool) -> Job | None:
        members = [self.members.by_id[i] for i in ids]
        frame = self.members.frame
        if frame is None or any(m.prior is None for m in members):
            return None
        self._closed_at[block], self._since_closing, self._loop = size, 0, None
        self.ledger.put_meta("closed_at", {str(k): v for k, v in self._closed_at.items()})
        cameras: dict[str, Camera] = {}
        for m in members:
            cameras[m.camera or m.photo.camera_key] = self.members.camera(m)
        return Job(
            ids=tuple(ids), held=held, photos=tuple(m.photo for m in members),
            priors=tuple(m.prior for m in members if m.prior is not None), frame=frame,
            poses={m.id: m.pose for m in members if m.pose is not None}, cameras=cameras,
            camera_of={m.id: m.camera or m.photo.camera_key for m in members},
            ground=self.canvas.ground, folder=self.folder, store=self.folder / STORE, methods=self.methods, sweep=sweep,
        )  # fmt: skip

    def _take_over(self, done: Closed) -> Update:
        """New poses of a whole block; what was placed since follows its neighbours and is settled again."""
        if not done.poses:
            return Update(what="noted", text=f"a block could not be adjusted as a whole: {done.problem}")
        before = {i: self.members.by_id[i].pose for i in done.poses}
        steps = {i: p.map_C - old.map_C for i, p in done.poses.items() if (old := before[i]) is not None}
        block = self.members.block(next(iter(done.poses)))
        since = (
            []
            if len(done.ids) < len(done.poses)
            else sorted(block - set(done.ids))
            if len(block) <= CLOSING
            else []
        )
        touched = self.heights.add(done.xyz, anew=True)
        with self.ledger.change() as db:
            self.members.save_cameras(done.cameras)
            self._moved(done.poses, done.camera_of)
            for i in since:
                self._follow(self.members.by_id[i], steps)
            db.executemany(
                "insert or replace into height values (?, ?, ?)",
                [(c, r, self.heights.z[c, r]) for c, r in sorted(touched)],
            )
            if len(done.xyz) and done.cameras:
                self.ledger.put_meta("ground", float(np.median(done.xyz[:, 2])))
            text = f"{len(done.poses)} photos were adjusted together"
            self.ledger.tell("note", {"text": text})
        reached("block closed")
        self.canvas.ground = float(self.ledger.meta("ground", 0.0))
        if done.cameras:  # heights and calibrations changed: all of the block looks different
            for i in done.poses:
                if self.members.by_id[i].state == "refined":
                    self._show(self.members.by_id[i])
        return Update(what="closed", moved=tuple(done.poses), text=text)

    def _follow(self, member: Member, steps: dict[int, np.ndarray]) -> None:
        near = [steps[j] for j in member.links if j in steps]
        if member.pose is None or not near:
            return
        step = np.median(np.array(near), axis=0)
        pose = Pose(cam_R_map=member.pose.cam_R_map, map_C=member.pose.map_C + step)
        self._moved({member.id: pose}, {member.id: member.camera})
        if member not in self._untried:
            member.tried = False
            self._untried.append(member)

    def close(self) -> None:
        """Ends; what is written stays."""
        self.closing.stop()
        self.tiles.close()
        self.ledger.close()


def _equal(a: Pose, b: Pose | None) -> bool:
    return b is not None and bool((a.map_C == b.map_C).all() and (a.cam_R_map == b.cam_R_map).all())


__all__ = ["Accepted", "LiveMap", "Refused", "Update"]
