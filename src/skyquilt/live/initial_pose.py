"""The first step for a photo: its metadata place it on the map at once."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.pixel_cache import PixelCache
from skyquilt.live.drone_metadata import Metadata
from skyquilt.live.events import MapEvents, Update
from skyquilt.live.ledger import hit
from skyquilt.live.members import Member, Queues
from skyquilt.live.redraw_queue import RedrawQueue
from skyquilt.ortho.ground import round_gsd

ABOVE_M = 50.0
"""Assumed flying height in m where the metadata do not contain one."""


class InitialPose:
    """Places received photos from their metadata; photos without a position wait."""

    def __init__(
        self,
        metadata: Metadata,
        pixels: PixelCache[NDArray[Any]],
        redraw: RedrawQueue,
        map_events: MapEvents,
        queues: Queues,
    ) -> None:
        self.metadata, self.pixels = metadata, pixels
        self.redraw, self.map_events, self.queues = redraw, map_events, queues
        self.members, self.canvas = metadata.members, redraw.canvas
        self.ledger = metadata.members.ledger

    def place(self, member: Member) -> Update:
        """Places the photo, which is the first in the queue of received photos."""
        warning = ""
        if self.members.frame is None and member.photo.position is not None:
            warning = self.metadata.frame_from(member)
        if self.members.frame is not None and self.canvas.gsd == 0:
            self._begin(member, warning)
        preview = self._preview(member)
        known = preview.pose if preview is not None else None
        pose = known if known is not None else self.metadata.first(member)
        self.pixels(member.id)
        with self.ledger.change():
            member.pose, member.state = pose, "waiting" if pose is None else "placed"
            self.members.save(member)
            if preview is not None:
                preview.state = "superseded"
                self.members.save(preview)
                self.map_events.superseded(preview)
            self.map_events.photo(member)
        hit("photo placed")
        if preview is not None:
            self.redraw.gone(preview.id)
        self.queues.received.popleft()
        self.queues.untried.append(member)
        if pose is not None:
            self.redraw.show(member)
        return Update(what=member.state, photo=member.id, text=warning)

    def _preview(self, member: Member) -> Member | None:
        """The preview of the same shot that arrived before this photo; None if there is none."""
        row = self.ledger.row("select about from photo where id = ?", member.id)
        about = json.loads(row[0]) if row is not None and row[0] else {}
        known = (self.members.by_id[i] for i in about.get("preview", ()) if i in self.members.by_id)
        return next(known, None)

    def _begin(self, member: Member, warning: str) -> None:
        """Fixes the map's frame and pixel size for the whole survey, with a warning, if any."""
        prior, photo, frame = member.prior, member.photo, self.members.frame
        assert frame is not None
        takeoff = frame.vertical_datum == "takeoff"
        pose = self.metadata.first(member)
        above = max(float(pose.map_C[2]), 5.0) if takeoff and pose is not None else ABOVE_M
        asked = self.metadata.settings.gsd_cm
        gsd = asked / 100 if asked else round_gsd(3 * above / photo.focal.px)
        ground = 0.0 if takeoff else float(prior.map_C[2]) - above
        ground = ground if np.isfinite(ground) else 0.0
        cell = max(0.04 * above, 4 * gsd)
        self.canvas.gsd, self.canvas.ground, self.metadata.heights.cell = gsd, ground, cell
        with self.ledger.change():
            self.ledger.put_meta("frame", asdict(frame))
            self.ledger.put_meta("gsd", gsd)
            self.ledger.put_meta("cell", cell)
            self.ledger.put_meta("ground", ground)
            self.ledger.tell("map", {"crs": frame.crs, "gsd": gsd})
            if warning:
                self.ledger.tell("note", {"text": warning})
