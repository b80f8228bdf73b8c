"""The first step for a photo: its metadata place it on the map at once."""

import json
from bisect import bisect_right
from dataclasses import asdict
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.pixel_cache import PixelCache
from skyquilt.live.adjustment_schedule import KEY as SCHEDULE
from skyquilt.live.drone_metadata import Metadata
from skyquilt.live.events import MapEvents, Update
from skyquilt.live.ledger import hit
from skyquilt.live.members import FAR_M, GROUNDED, MOST_M, Member, Queues, about_record
from skyquilt.live.photo_intake import BAND, OTHER_BAND, of_other_band
from skyquilt.live.redraw_queue import RedrawQueue
from skyquilt.model.photo import Photo
from skyquilt.ortho.ground import round_gsd
from skyquilt.outside import real, whole
from skyquilt.photos.implausible_positions import on_sphere, raised

FEW = 10
"""A map with at most so many photos is begun again where more of them lie elsewhere."""
AT_ONCE = 3
"""A photo whose metadata are worth little is linked before it is drawn, unless more photos than so
many wait for that.
"""
BEGAN, NO_PLACE = "begun at", "no place told"
"""Names in the ledger: the photo around which the map was begun again; whether it was said that no
photo has a position.
"""
NOWHERE = (
    "no photo has a position so far: the map begins with the first that has one, or, without a"
    " place, with four that overlap; the final map (--finish, or the button) needs none"
)
ABOVE_M, GROUND_M, LOWEST_M = 50.0, 3.0, 5.0
"""Assumed flying height in m where the metadata do not contain one; height above take-off below
which a photo was taken on the ground; least one by which the map's pixel is chosen.
"""
HIGHER = 2.0
"""A map of few photos is begun again where more of them were taken so many times higher."""
CLIMBED = (
    "the first photos were taken on the way up: the map is begun again with larger pixels, for"
    " those from higher up"
)

BEGAN_M, FALSE_M = "begun at height", 10.0
"""Name in the ledger of the height that the photo told with which the map began; where that photo
tells another one by now, further from it in m, the height proved false.
"""
FALSE = "the first photo told a false height: the map is begun again with the heights of the others"


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
        self._raised = set[str]()

    def place(self, member: Member) -> Update:
        """Places the photo, which is the first in the queue of received photos."""
        warning, first = "", self._first(member)
        if self.members.frame is None and first.photo.position is not None:
            warning = self.metadata.frame_from(first)
        if self.members.frame is not None and self.canvas.gsd == 0:
            self._begin(first, warning)
        why = self.members.far_note(member.photo)
        previews = self._previews(member)
        pose = known = next((m.pose for m in reversed(previews) if m.pose is not None), None)
        if known is None and self.members.on_ground(member):
            why = GROUNDED
        elif known is None:
            pose = self.metadata.first(member)
        grounded = self._grounded(member)
        self.pixels(member.id)
        with self.ledger.change():
            for other in grounded:
                self._off(other, keep=True, reason=GROUNDED)
            member.pose, member.state = pose, "waiting" if pose is None else "placed"
            self.members.save(member, reason=why)
            if self.members.frame is None and not self.ledger.meta(NO_PLACE):
                self.ledger.put_meta(NO_PLACE, True)
                self.ledger.tell("note", {"text": f"{NOWHERE}."})
                warning = NOWHERE
            for preview in previews:
                preview.state = "superseded"
                self.members.save(preview)
                self.map_events.superseded(preview)
            self.map_events.photo(member, **({"reason": why} if why else {}))
        hit("photo placed")
        for gone in (*previews, *grounded):
            self.redraw.gone(gone.id)
        self.queues.lost += [m for m in grounded if m.tried]
        self.queues.received.popleft()
        self.queues.untried.append(member)
        if pose is not None:
            few = len(self.queues.received) + self.queues.unrefined <= AT_ONCE
            if few and known is None and self.metadata.loose(member, pose):
                self.redraw.held.add(member.id)
            else:
                self.redraw.show(member)
        return Update(what=member.state, photo=member.id, text=warning or why)

    def _grounded(self, member: Member) -> list[Member]:
        """Photos of the same camera that are drawn as if from the air, being linked with none, and
        prove to have been taken on the ground, since this one was not.
        """
        camera = member.photo.camera_key
        if not raised(member.photo) or camera in self._raised:
            return []
        self._raised.add(camera)
        return [
            m
            for m in self.members.on_map()
            if m.state == "placed" and m.photo.camera_key == camera and self.members.on_ground(m)
        ]

    def elsewhere(self, member: Member) -> bool:
        """Whether the map began in the wrong place, with a photo that was left on the card, say:
        more photos up to this one lie near it than near the map, which has few. Only a later photo
        than the one around which it was begun again can tell so once more.
        """
        if self.members.distance_m(member.photo) <= FAR_M or member.id <= self._begun_at():
            return False
        begun = bisect_right(self.members.near, member.id)
        if begun > FEW:
            return False
        known = (
            m.photo
            for m in reversed(self.members.by_id.values())
            if m.id <= member.id and m.state != "refused" and m.photo.position is not None
        )
        xyz = on_sphere(list(islice(known, 2 * FEW + 1)))
        return int((np.linalg.norm(xyz - xyz[0], axis=1) <= FAR_M).sum()) > begun

    def from_higher(self, member: Member) -> bool:
        """Whether the map began with a photo of the climb: more photos up to this one were taken so
        much higher that its pixels are far too fine for them, and it has few.
        """
        if bisect_right(self.members.near, member.id) > FEW or member.id <= self._begun_at():
            return False
        known = [
            m
            for m in self.members.by_id.values()
            if m.id <= member.id
            and m.state in ("received", "placed", "refined")
            and m.photo.position is not None
        ]
        least = HIGHER * _above_m(self._first(known[0]).photo) if known else np.inf
        higher = [m for m in known if _above_m(m.photo) > least]
        return member in higher and 2 * len(higher) > len(known)

    def from_false_height(self, member: Member) -> bool:
        """Whether the map, which has few photos, began at the height of a photo that is not
        believed any more, and this one tells a height.
        """
        frame, z = self.members.frame, float(member.prior.map_C[2])
        if frame is None or frame.vertical_datum == "takeoff" or not np.isfinite(z):
            return False
        near = self.members.near[: bisect_right(self.members.near, member.id)]
        if not near[:-1] or len(near) > FEW or member.id <= self._begun_at():
            return False
        first = self._first(self.members.by_id[near[0]]).prior.map_C[2]
        began = real(self.ledger.meta(BEGAN_M), -MOST_M, MOST_M)
        return began is not None and abs((first if np.isfinite(first) else z) - began) > FALSE_M

    def _first(self, member: Member) -> Member:
        """The photo with which the map begins: the one around which it is begun again, or this
        one.
        """
        around = self.members.by_id.get(self._begun_at())
        return member if around is None or around.state == "refused" else around

    def _begun_at(self) -> int:
        return whole(self.ledger.meta(BEGAN), 0) or 0

    def begin_again(self, member: Member | None, text: str = "") -> Update:
        """Takes everything off the map and puts all photos back into the queue, for a map around
        this one; without one, they wait with their links for a map without a place. Until the
        change is stored, a restart begins with it again; what is in memory must be read anew
        afterwards. `text` says why, if not because most photos lie in another place.
        """
        if not text and member is not None:
            far = self.members.distance_m(member.photo) / 1000
            text = (
                f"most photos lie {far:.0f} km from where the map began: it is begun again around"
                " them"
            )
        self.redraw.clear()
        with self.ledger.change():
            self._all_off(keep=member is None)
            if member is not None:
                self.ledger.put_meta(BEGAN, member.id)
            self.ledger.tell("note", {"text": f"{text}."})
        hit("map begun again")
        return Update(what="noted", photo=member.id if member is not None else None, text=text)

    def other_band(self) -> Update:
        """As `begin_again`, for a map of the band that it shall show from now on
        (`photo_intake.OTHER_BAND`): files of it that were kept are received, and those of others
        kept.
        """
        self.redraw.clear()
        with self.ledger.change() as db:
            self._all_off(keep=False)
            db.execute("delete from meta where key in (?, ?)", (BEGAN, OTHER_BAND))
            shown = str(self.ledger.meta(BAND))
            for number, name, source, state, band in self.ledger.rows(
                "select photo.id, photo.name, source, state, band.name from photo join band on"
                " photo = id where state in ('received', 'kept') order by id"
            ):
                reason = of_other_band(band, shown)
                now = "kept" if reason else "received"
                if now != state:
                    self.ledger.set_photo(number, state=now, reason=reason)
                    said = {"id": number, "name": name, "source": source, "state": now}
                    self.ledger.tell("photo", {**said, "reason": reason})
            more = f"files of the band {shown}, of which there are more"
            text = f"the map is begun again with the {more if shown else 'photos in colours'}"
            self.ledger.tell("note", {"text": f"{text} (--band)."})
        hit("map begun again")
        return Update(what="noted", text=text)

    def _all_off(self, *, keep: bool) -> None:
        """Takes all photos off the map and forgets what it is (inside a transaction); with `keep`
        they stay compared.
        """
        with self.ledger.change() as db:
            for table in ("height", "camera", "link")[: 2 if keep else None]:
                db.execute(f"delete from {table}")
            for key in ("frame", "gsd", "cell", "ground", SCHEDULE):
                db.execute("delete from meta where key = ?", (key,))
            for m in self.members.by_id.values():
                self._off(m, keep=keep)

    def _off(self, member: Member, *, keep: bool, reason: str = "") -> None:
        """Takes a photo off the map (inside a transaction); with `keep` it stays compared."""
        placed = member.state != "received"  # others still know the previews that they replace
        if member.state in ("placed", "refined", "waiting"):
            member.state = "waiting" if keep else "received"
            said = {"reason": reason} if reason else {}
            self.map_events.photo(member, ring=[], at=None, **said)
        if member.state in ("received", "superseded", "waiting"):
            member.pose, member.camera, member.learned = None, "", None
            about = {"about": about_record(member, "") if keep else {}} if placed else {}
            self.members.save(member, footprint="", reason=reason, **about)

    def _previews(self, member: Member) -> list[Member]:
        """What arrived of the same shot before this photo and gives way to it, the oldest first:
        previews, and the file before it was written anew.
        """
        row = self.ledger.row("select about from photo where id = ?", member.id)
        about = json.loads(row[0]) if row is not None and row[0] else {}
        known = (self.members.by_id.get(i) for i in about.get("preview", ()))
        return [m for m in known if m is not None and m.state not in ("superseded", "refused")]

    def _begin(self, member: Member, warning: str) -> None:
        """Fixes the map's frame and pixel size for the whole survey, with a warning, if any."""
        prior, photo, frame = member.prior, member.photo, self.members.frame
        assert frame is not None
        above = _above_m(photo)
        asked = self.metadata.settings.gsd_cm
        gsd = asked / 100 if asked else round_gsd(3 * above / photo.focal.px)
        ground = 0.0 if frame.vertical_datum == "takeoff" else float(prior.map_C[2]) - above
        ground = ground if np.isfinite(ground) else 0.0
        with self.ledger.change():
            self.ledger.put_meta(BEGAN_M, float(np.nan_to_num(prior.map_C[2])))
        self.fix(gsd, above, ground, warning)

    def fix(self, gsd: float, above: float, ground: float, warning: str) -> None:
        """Fixes the map's frame and its pixel size in m (`gsd`), with photos taken `above` a ground
        of this height in m; tells a warning, if any.
        """
        frame = self.members.frame
        assert frame is not None
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


def _above_m(photo: Photo) -> float:
    """Height in m above the ground at which a photo was taken, as far as it tells."""
    told = photo.above_takeoff_m
    return max(told, LOWEST_M) if told is not None and told >= GROUND_M else ABOVE_M
