"""Decides which tiles are drawn next, the most urgent first, and when drawn tiles are reported."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.live.doubled import tell_doubled
from skyquilt.live.events import MapEvents, Update
from skyquilt.live.failures import concerning
from skyquilt.live.ledger import DAMAGED, hit
from skyquilt.live.members import Member, Members, pose_from, pose_record
from skyquilt.live.tile_drawing import LEAST_MOVE, NEWEST, Canvas
from skyquilt.model.poses import Pose
from skyquilt.ortho.spoilt import overexposed_note
from skyquilt.raster.tile_store import Address

DRAWN_AT_ONCE = 12
"""Number of tiles drawn in one unit of work; twice as many for a new photo."""
NOTED_AT_ONCE = 8
"""Number of moved photos whose tiles are determined in one unit of work."""
WHITE = "overexposed"
"""Name in the ledger of the number of overexposed photos that were noted last."""
Queue = dict[Address, set[int]]
"""Tiles to draw, in order, with the photos that have changed on each."""


class RedrawQueue:
    """Queues of tiles that differ from the current poses and must be redrawn."""

    def __init__(self, members: Members, canvas: Canvas, map_events: MapEvents) -> None:
        """Keeps tiles that were drawn before; queues the tiles of photos that have moved since."""
        self.members, self.ledger, self.canvas, self.map_events = (
            members,
            members.ledger,
            canvas,
            map_events,
        )
        self.urgent: Queue = {}
        self.dirty: Queue = {}
        self.later: Queue = {a: set() for a in canvas.owed()}
        self.pending: dict[int, None] = {}
        self.held: set[int] = set()
        """Photos on the map that are drawn only after they are compared with their neighbours."""
        self._drawn: dict[int, Pose] = {}
        self._rims: dict[int, NDArray[np.float64]] = {}
        self._to_draw: set[int] = set()
        self._fresh: dict[str, list[Address]] = {}
        self._remarked: set[int] = set()
        self._astray: set[int] = set()
        """Photos that tiles may show elsewhere than where they were last reported."""
        self._take_up()

    def _take_up(self) -> None:
        rows = self.ledger.rows("select id, footprint from photo where footprint != ''")
        drawn = {int(i): _drawn(d) for i, d in rows}
        for member in self.members.on_map():
            pose, former = drawn.get(member.id), set[Address]()
            with concerning(member.id):
                if pose is not None and self.canvas.moved(member, pose):
                    self.canvas.place(replace(member, pose=pose), self.members.camera(member))
                    former = self.canvas.remove(member.id)
                addresses = former | self.canvas.place(member, self.members.camera(member))
            rim = self.canvas.outline(member.id)
            if pose is not None and rim is not None and not self.canvas.moved(member, pose):
                self._drawn[member.id], self._rims[member.id] = pose, rim
            else:
                self._to_draw.add(member.id)
                _add(self.dirty, addresses, member.id)

    def show(self, member: Member) -> None:
        """Queues the tiles of a new photo as urgent."""
        self._look_for_marks(member)
        self.held.discard(member.id)
        self._show(member)

    def _show(self, member: Member) -> None:
        self._to_draw.add(member.id)
        _add(self.urgent, self._placed(member), member.id)

    def _placed(self, member: Member) -> set[Address]:
        """Places a photo on the map; returns the tiles that may look different. Overexposed photos
        are noted whenever there are twice as many of them.
        """
        addresses = self.canvas.place(member, self.members.camera(member))
        if self.canvas.is_white(member.id):
            white = [self.members.by_id[i].photo.name for i in self.canvas.white()]
            note = overexposed_note(white)
            tell_doubled(
                self.ledger,
                WHITE,
                len(white),
                lambda: [note if len(white) < 2 else f"So far {note}"],
            )
        return addresses

    def _look_for_marks(self, member: Member) -> None:
        """Notes that all photos of a photo's camera look different if marks were found on them."""
        camera = member.photo.camera_key
        if self.canvas.remarked(camera):
            for other in self.members.on_map():
                if other.photo.camera_key == camera:
                    self.altered(other)

    def altered(self, member: Member) -> None:
        """Notes that another part of a photo is shown than before, wherever it lies."""
        if member.pose is not None and member.state != "superseded":
            if member.id in self._drawn:
                self._remarked.add(member.id)
            self.changed(member)

    def changed(self, member: Member) -> None:
        """Notes that a photo looks different; its tiles are determined later. One that was not
        drawn yet is drawn as it looks now; one that is held, as it looks then.
        """
        if member.id in self._drawn:
            self._to_draw.add(member.id)
            self.pending[member.id] = None
        elif member.id not in self.held:
            self._show(member)

    def moved(self, member: Member) -> None:
        """Notes that a photo has moved; it is drawn again if the change is visible, and at once if
        it was not drawn yet.
        """
        drawn = self._drawn.get(member.id)
        if drawn is None:
            self.show(member)
            return
        self._look_for_marks(member)
        if member.id in self._astray or self.canvas.moved(member, drawn):
            self.changed(member)

    def take_note(self) -> Update:
        """Finds the tiles of some of the changed photos."""
        some = list(self.pending)[:NOTED_AT_ONCE]
        for number in some:
            member = self.members.by_id[number]
            del self.pending[number]
            if member.state == "superseded":
                continue
            addresses = self._placed(member)
            remarked = number in self._remarked
            self._remarked.discard(number)
            if not remarked and number not in self._astray and self._looks_as_drawn(number):
                self._to_draw.discard(number)
            else:
                self._to_draw.add(number)
                self._astray.add(number)
                _add(self.dirty, addresses, number)
        return Update(what="noted")

    def _looks_as_drawn(self, number: int) -> bool:
        """Whether a photo's outline still lies where it was drawn. Changes of pose, lens and
        heights are largest at the image border.
        """
        rim, drawn = self.canvas.outline(number), self._rims.get(number)
        if rim is None or drawn is None or rim.shape != drawn.shape:
            return False
        return bool(np.abs(rim - drawn).max() < LEAST_MOVE * self.canvas.gsd)

    def gone(self, number: int) -> None:
        """Removes a photo."""
        self.held.discard(number)
        for known in (self.pending, self._drawn, self._rims):
            known.pop(number, None)
        _add(self.dirty, self.canvas.remove(number), number)

    def clear(self) -> None:
        """Takes all photos off the map, and draws every tile that showed one."""
        self.pending.clear()
        self._to_draw.clear()
        for member in self.members.on_map():
            self.gone(member.id)
        while self.urgent or self.dirty:
            self.draw(self.urgent or self.dirty)
        while self.later:
            self.draw_newest()

    def draw(self, queue: Queue, rule: str = "") -> Update:
        """Draws some of the queued tiles. When the queue is empty, what was drawn is stored and
        reported.
        """
        some = list(queue)[: DRAWN_AT_ONCE * (2 if queue is self.urgent else 1)]
        return self._drawn_some(queue, some, rule)

    def draw_moved(self) -> Update:
        """The same for photos that moved, followed by the newest-on-top layers while their images
        are still in memory.
        """
        ready = self._newest()
        if len(ready) >= DRAWN_AT_ONCE:
            return self._drawn_some(self.later, ready[:DRAWN_AT_ONCE], NEWEST)
        return self.draw(self.dirty)

    def draw_newest(self) -> Update:
        """The same for the layers that show the newest photo on top."""
        return self.draw(self.later, NEWEST)

    def _newest(self) -> list[Address]:
        return [a for a in self.later if a not in self.dirty]

    def _drawn_some(self, queue: Queue, some: Sequence[Address], rule: str) -> Update:
        parts = {a: queue[a] if rule else queue[a] | self.dirty.get(a, set()) for a in some}
        written = self.canvas.draw(parts, rule)
        for address, changed in parts.items():
            queue.pop(address, None)
            if not rule:
                self.dirty.pop(address, None)
                self.later.setdefault(address, set()).update(changed)
        self._fresh.setdefault(rule, []).extend(written)
        tiles = len(written)
        if not queue:
            tiles += self._told(rule)
        return Update(what="drawn", tiles=tiles)

    def _told(self, rule: str) -> int:
        """Draws the coarser levels and reports the changes to viewers."""
        raised = self.canvas.finish(rule)
        shown = [] if rule else [i for i in self._to_draw if not self._waits(i)]
        with self.ledger.change():
            for i in sorted(shown):
                self._drawn_now(self.members.by_id[i])
            self.map_events.tiles(self._fresh.pop(rule, []))
        hit("drawing told")
        self._to_draw.difference_update(shown)
        self._astray.difference_update(shown)
        return raised

    def _waits(self, number: int) -> bool:
        """Whether tiles of a photo still wait to be drawn."""
        return number in self.pending or any(
            a in self.dirty or a in self.urgent for a in self.canvas.tiles_of(number)
        )

    def _drawn_now(self, member: Member) -> None:
        if member.pose is None or member.state == "superseded":
            self.ledger.set_photo(member.id, footprint="")
            return
        ring, at = self.map_events.place(member)
        self.ledger.set_photo(
            member.id, footprint={"ring": ring, "at": at, "pose": pose_record(member.pose)}
        )
        self._drawn[member.id] = member.pose
        if (rim := self.canvas.outline(member.id)) is not None:
            self._rims[member.id] = rim
        self.map_events.photo(member, ring=ring, at=at)


def _add(queue: Queue, addresses: Iterable[Address], number: int) -> None:
    for address in addresses:
        queue.setdefault(address, set()).add(number)


def _drawn(footprint: str) -> Pose | None:
    """The pose with which a photo was drawn; None where it is not known, then it is drawn again."""
    try:
        return pose_from(json.loads(footprint)["pose"])
    except DAMAGED:
        return None
