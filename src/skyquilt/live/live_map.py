"""The live map: photos arrive in any order, and the map is updated with each photo.

Start reading at `LiveMap.work`: it does one unit of work at a time, the most urgent first. Before
the next unit begins, everything that must survive is in the ledger, the tile store and the folder
of photos. A restart reads these and continues.
"""

import sqlite3
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from skyquilt.engine.error_log import NAME as ERRORS
from skyquilt.engine.error_log import log_error
from skyquilt.engine.folder import make_folder
from skyquilt.engine.free_memory import give_back
from skyquilt.engine.lock import FolderLock
from skyquilt.engine.pixel_cache import PixelCache
from skyquilt.engine.store import Store
from skyquilt.errors import OutputError, UnreadablePhotoError, UsageError
from skyquilt.live.adjustment_schedule import Blocks, Schedule
from skyquilt.live.apply_adjustment import ApplyAdjustment
from skyquilt.live.background_adjustment import BackgroundAdjustment, adjust_block
from skyquilt.live.blur import LiveBlur
from skyquilt.live.drone_metadata import Metadata
from skyquilt.live.events import MapEvents, Update
from skyquilt.live.failures import MemberFailedError, concerning, of_the_system
from skyquilt.live.inbox import Inbox
from skyquilt.live.initial_pose import CLIMBED, FALSE, InitialPose
from skyquilt.live.ledger import DAMAGED, Ledger
from skyquilt.live.links import LiveLinks
from skyquilt.live.local_pose import LocalPose
from skyquilt.live.loose import LivePlaced
from skyquilt.live.members import Members, Queues
from skyquilt.live.neighbours import Neighbours
from skyquilt.live.photo_intake import OTHER_BAND, Intake, Refused
from skyquilt.live.placeless import Placeless
from skyquilt.live.redraw_queue import RedrawQueue
from skyquilt.live.refinement import Refinement
from skyquilt.live.settings import LiveSettings
from skyquilt.live.tile_drawing import Canvas
from skyquilt.live.veils import LiveVeils
from skyquilt.model import features, poses
from skyquilt.ortho.height_cells import HeightCells
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import rejected
from skyquilt.raster.tile_store import TileStore
from skyquilt.settings import MosaicSettings
from skyquilt.typed import as_path, instance
from skyquilt.workflows.methods import methods_for
from skyquilt.workflows.photo_features import PhotoFeatures

PHOTOS, TILES, FINISHED = "photos", "tiles.db", "finished"
"""Names of the accepted photos, the map's tiles and the final map in the survey's folder."""
LOCK = "live.lock"
"""Name of the file that one live map holds."""
STORE = Path(FINISHED) / ".skyquilt" / "store"
FULL_BYTES = 120_000_000
"""Bytes of full-size photos kept in memory."""
TOGETHER = 4
"""Number of waiting photos that are placed before they are drawn. Drawing them together is faster,
since they share tiles.
"""
MOST_FAILURES = 5
"""Number of failures in a row, of steps that concern no single photo, after which the map ends."""
TIDY = 4
"""Freed memory is returned to the system after this number of photos."""


class LiveMap:
    """A live survey, open for writing. Only one process may write to a survey's folder at a
    time.
    """

    def __init__(self, folder: Path, settings: LiveSettings | None = None) -> None:
        """Opens the folder, or continues an earlier run.

        Raises:
            OutputError: it cannot be written, or another live map works there. UsageError: it was
                started with other settings.
        """
        cv2.setNumThreads(1)
        self.folder = as_path("folder", folder)
        self.settings = instance("settings", settings, LiveSettings)
        make_folder(self.folder)
        self.lock = FolderLock(self.folder, LOCK, "live map")
        self.ledger = Ledger(self.folder, write=True)
        self._same_settings()
        self.inbox = Inbox(self.ledger, self.folder / PHOTOS, most_bytes=self.settings.most_bytes)
        self.intake = Intake(self.ledger, self.inbox, self.settings)
        self.tiles = TileStore(self.folder / TILES, write=True)
        self.methods = methods_for(MosaicSettings(features=self.settings.features))
        registry = {c.__name__: c for c in (PhotoFeatures, features.Features, poses.Pose)}
        store = self.folder / STORE
        self.store = Store(folder=store, registry=registry, within=self.folder)
        self.store.tidy()
        self.background = BackgroundAdjustment()
        self._room = TOGETHER
        self._failures = 0
        try:
            self._reload()
        except (*DAMAGED, sqlite3.Error) as error:
            log_error(self.folder, "opening the survey", error)
            raise self.ledger.damaged(f"{type(error).__name__}; see {ERRORS}") from error

    def _same_settings(self) -> None:
        known, asked = self.ledger.meta("settings"), self.settings.shaping()
        if known is None:
            self.ledger.put_meta("settings", asked)
        elif differing := ", ".join(k for k in asked if known.get(k, asked[k]) != asked[k]):
            raise UsageError(
                f"{self.folder} was started with other settings ({differing}); use the same, or"
                " another folder"
            )

    def _reload(self) -> None:
        """`_load`, without photos on which it fails; repeated where a full disk interrupted it."""
        self._torn = True
        while self._torn:
            try:
                self._load()
                self._torn = False
            except MemberFailedError as error:
                self._refuse(error)

    def _load(self) -> None:
        """Rebuilds the state in memory from the durable files, at start and after a failed
        write.
        """
        self.members = Members(self.ledger, self.inbox, self.settings)
        self.queues = Queues(self.members.by_id.values())
        self.schedule = Schedule.read(self.ledger)
        self.full = PixelCache(read=self._pixels, budget_bytes=FULL_BYTES)
        self.heights = HeightCells(cell=float(self.ledger.meta("cell", 2.0)))
        known = np.array(self.ledger.rows("select * from height"), np.float64).reshape(-1, 3)
        self.heights.put(known[:, :2].astype(np.int64), known[:, 2])
        metadata = Metadata(self.members, self.heights, self.settings)
        neighbours = Neighbours(self.members, metadata)
        self.live_links = LiveLinks(self.members, self.methods, self.store, self.full)
        blur = LiveBlur(self.live_links)
        veils = LiveVeils(self.live_links, self.heights, blur.blurred)
        local_pose = LocalPose(self.members, metadata, neighbours, self.live_links, self.settings)
        self.canvas = Canvas(
            self.tiles,
            self.heights,
            self.full,
            self.members.by_id,
            self.store,
            self.settings.max_view_angle,
            self.live_links.marks.alike,
            (blur.of, veils.of, LivePlaced(self.members).of),
        )
        self.canvas.gsd = float(self.ledger.meta("gsd", 0.0))
        self.canvas.ground = float(self.ledger.meta("ground", 0.0))
        map_events = MapEvents(self.members, self.canvas)
        self.redraw = RedrawQueue(self.members, self.canvas, map_events)
        self.initial_pose = InitialPose(metadata, self.full, self.redraw, map_events, self.queues)
        self.refinement = Refinement(
            local_pose, self.redraw, map_events, self.queues, self.schedule, blur, veils
        )
        self.apply_adjustment = ApplyAdjustment(self.refinement)
        self.placeless = Placeless(initial_pose=self.initial_pose, refinement=self.refinement)
        store = self.folder / STORE
        self.blocks = Blocks(
            self.members, self.schedule, self.settings, self.folder, store, self.methods
        )

    def _pixels(self, number: int) -> Any:
        with concerning(number):
            return read_color(self.members.by_id[number].photo)

    # -- adding

    def add(self, path: Path, source: str = "") -> Update:
        """Accepts one photo and brings the map up to date with it."""
        done = self.intake.take_file(path, source or path.parent.name)
        if isinstance(done, Refused):
            return Update(what="refused", text=f"{done.name}: {done.reason}")
        text = "it was already received" if done.duplicate else done.kept
        last = Update(what="noted", photo=done.id, text=text)
        for update in self.drain():
            if update.photo == done.id and update.what != "drawn":
                last = update
        return last

    def drain(self) -> Iterator[Update]:
        """Works until only the result of background work is outstanding."""
        while (update := self.work()) is not None:
            yield update

    def drain_all(self) -> Iterator[Update]:
        """Works until nothing is left, including background adjustments."""
        while True:
            yield from self.drain()
            if not self.background.busy:
                return
            time.sleep(0.02)

    # -- working

    def work(self) -> Update | None:
        """Does the most urgent unit of work; None if there is none.

        Raises:
            OutputError: the disk is full, or the survey's folder gone. No accepted photo is lost,
                and the same unit is repeated when there is space, or the folder is back.
        """
        began = time.perf_counter()
        if self._torn:
            self._reload()
        try:
            self.queues.received.extend(self.members.take_up())
            update = self._next()
            self._failures = 0
        except MemberFailedError as error:
            update = self._set_aside(error)
        except Exception as error:
            self.background.stop()
            self._reload()
            if isinstance(error, OutputError):
                raise
            if system := of_the_system(error):
                raise system from error
            self.inbox.check()
            update = self._unexplained(error)
        if update is None:
            return None
        return Update(**{**asdict(update), "seconds": time.perf_counter() - began})

    def _set_aside(self, failed: MemberFailedError) -> Update:
        """Leaves a photo out on which a step failed, whatever the error: it is refused with the
        reason, the traceback goes to the log of errors, and the work continues without it.
        """
        member = self.members.by_id.get(failed.number)
        tiles = self.canvas.tiles_of(failed.number)
        text = self._refuse(failed)
        foreseen = isinstance(failed.__cause__, UnreadablePhotoError)
        if foreseen and member is not None and member.state == "received":
            member.state = "refused"  # nothing depends on it yet
            self.queues.received = deque(m for m in self.queues.received if m is not member)
        else:
            self.background.stop()
            self._reload()
            self.redraw.dirty |= {a: {failed.number} for a in tiles}
        return Update(what="refused", photo=failed.number, text=text)

    def _refuse(self, failed: MemberFailedError) -> str:
        """Stores that a photo is refused; returns its name and the reason.

        Raises:
            OutputError: the folder of all photos is gone.
        """
        try:
            self.inbox.check()
        except OutputError:
            self.background.stop()
            self._torn = True
            raise
        cause = failed.__cause__ if isinstance(failed.__cause__, Exception) else failed
        row = self.ledger.row("select name, source from photo where id = ?", failed.number)
        name, source = row if row is not None else (f"photo {failed.number}", "")
        reason = rejected(name, cause).reason
        if not isinstance(cause, UnreadablePhotoError):
            log_error(self.folder, f"photo {failed.number}, {name}: {reason}", cause)
        with self.ledger.change() as db:
            self.ledger.set_photo(
                failed.number, state="refused", reason=reason, pose=None, footprint=""
            )
            db.execute(
                "update link set body = null where a = ? or b = ?", (failed.number, failed.number)
            )
            said = {"id": failed.number, "name": name, "source": source, "state": "refused"}
            self.ledger.tell("photo", {**said, "time": None, "reason": reason})
        return f"{name}: {reason}"

    def _unexplained(self, error: Exception) -> Update:
        """Reports an error that concerns no single photo; raises it where it comes again and
        again.
        """
        self._failures += 1
        if self._failures > MOST_FAILURES:
            raise error
        log_error(self.folder, "a step of the live map", error)
        if self._failures > 1:  # perhaps an adjustment, which is due again with the next photo
            self.schedule.given_up({k: len(v) for k, v in self.members.blocks.items()})
            self.schedule.write(self.ledger)
        text = f"a step failed ({type(error).__name__}) and is repeated; see {ERRORS}"
        self.ledger.tell("note", {"text": text})
        return Update(what="noted", text=text)

    def _next(self) -> Update | None:
        if self.settings.deterministic:
            return self._drawn_first() or self._one_by_one() or self._drawn_last()
        return (
            (self._placed() if self._room else None)
            or self._drawn_first()
            or self._applied()
            or self._grown()
            or self._refined()
            or self._drawn_last()
            or self._behind()
        )

    def _one_by_one(self) -> Update | None:
        """Places and refines each photo and adjusts its block before the next photo is processed.

        Poses then depend only on the photos and their order, not on timing.
        """
        if not self.schedule.checked:
            job = self.blocks.due(self.canvas.ground, idle=False)
            if job is not None:
                return self.apply_adjustment.apply(adjust_block(job))
            self.schedule.checked = True
        return self._refined() or self._placed()

    def _placed(self) -> Update | None:
        if not self.queues.received:
            return None
        self._room = max(0, self._room - 1)
        self.blocks.arrived()
        first = self.queues.received[0]
        if first.id % TIDY == 0:
            give_back()
        again = None
        if self.ledger.meta(OTHER_BAND):
            again = self.initial_pose.other_band
        elif self.initial_pose.elsewhere(first):
            again = partial(self.initial_pose.begin_again, first)
        elif self.initial_pose.from_higher(first):
            again = partial(self.initial_pose.begin_again, first, CLIMBED)
        elif self.initial_pose.from_false_height(first):
            again = partial(self.initial_pose.begin_again, first, FALSE)
        if again is not None:
            self.background.stop()
            update = again()
            self._reload()
            return update
        with concerning(first.id):
            return self.initial_pose.place(first)

    def _refined(self) -> Update | None:
        """Refines a photo in two units of work, so that a photo that arrives in between need not
        wait for both.
        """
        if (update := self.placeless.look()) is not None:
            if self.placeless.over:
                self.background.stop()
                self._reload()
            return update
        if (member := self.queues.next_untried()) is None:
            return None
        with concerning(member.id):
            if member.state != "superseded" and not self.live_links.has_features(member.id):
                self.live_links.features(member.id)
                return Update(what="noted", photo=member.id)
            self.placeless.due = True
            return self.refinement.refine(member)

    def _drawn_first(self) -> Update | None:
        """Draws photos in order of arrival: a photo that arrives while others wait to be drawn is
        placed after them.
        """
        update = self.redraw.draw(self.redraw.urgent) if self.redraw.urgent else None
        self._room = 0 if self.redraw.urgent else TOGETHER
        return update

    def _drawn_last(self) -> Update | None:
        if self.redraw.pending:
            return self.redraw.take_note()
        if self.redraw.dirty:
            return self.redraw.draw_moved()
        return self.redraw.draw_newest() if self.redraw.later else None

    def _applied(self) -> Update | None:
        done = self.background.outcome()
        return None if done is None else self.apply_adjustment.apply(done)

    def _grown(self) -> Update | None:
        """Starts the adjustment of a block that has grown. Where photos come faster than they are
        refined and drawn, there is never nothing else to do, and lines would bend ever further.
        """
        return None if self.background.busy else self._adjusted(idle=False)

    def _behind(self) -> Update | None:
        """Looks for what else can be adjusted or linked, where nothing else is to do."""
        if self.background.busy:
            return None
        if self.blocks.quiet and (update := self.refinement.rejoined()) is not None:
            return update
        return self._adjusted(idle=True)

    def _adjusted(self, *, idle: bool) -> Update | None:
        """Starts the adjustment of a block in a separate process, if one is due."""
        job = self.blocks.due(self.canvas.ground, idle=idle)
        if job is None:
            return None
        self.background.start(job)
        return Update(
            what="noted", text=f"{len(job.ids)} photos are adjusted together in the background"
        )

    def close(self) -> None:
        """Ends the work; everything written is kept."""
        self.background.stop()
        self.tiles.close()
        self.ledger.close()
        self.lock.close()
