"""Smoke, fog and haze on a growing map: what they veil is drawn only where no other photo shows the
ground.

As on the map at the end (`ortho.veiled`), here among a photo and those around it, so that a photo
costs as much however large the map is.
"""

import json
from collections.abc import Collection
from typing import Any

import numpy as np

from skyquilt.imaging.blank import Blank, joined
from skyquilt.imaging.nodes import View
from skyquilt.imaging.views import footprint
from skyquilt.live.doubled import tell_doubled
from skyquilt.live.ledger import DAMAGED
from skyquilt.live.links import LiveLinks
from skyquilt.live.members import Member
from skyquilt.live.tile_drawing import layer_of
from skyquilt.model.photo import Photo
from skyquilt.ortho.height_cells import HeightCells
from skyquilt.ortho.spoilt import overexposed
from skyquilt.ortho.tie_surface import level
from skyquilt.ortho.veiled import FEWEST_VIEWS, cells_of, veiled_note, veiled_parts
from skyquilt.outside import whole

KEY, NOTED = "veil ", "veils noted"
"""Names in the ledger of the veil of a photo, before its number, and of how many were noted."""
SURE_SHARE = 0.07
"""Share of a picture that the first one must surely show through a veil, among photos that it is
linked with. Where these are not well placed yet, what stands beside a place seems to veil it: of
75 photos of `caliterra` up to 0.049, and 0.118 among those that are linked with these, too; over
fires 0.064 and 0.087.
"""
NEAREST = 20
"""Most photos that are compared."""
MORE = 0.02
"""Share of a picture by which its veil must have grown to be drawn again."""
AROUND = 5
"""Cells around the photos' places in which the height of the ground is looked for."""
MOST = 10**9
"""Largest number of a photo."""


class LiveVeils:
    """Which parts of photos are veiled."""

    def __init__(
        self, live_links: LiveLinks, heights: HeightCells, blurred: Collection[int]
    ) -> None:
        """Reads what was known before a restart. `blurred`: photos that are, now and later."""
        self.live_links, self.members, self.heights = live_links, live_links.members, heights
        self._blurred = blurred
        kept = self.members.ledger.rows("select key, value from meta where key glob ?", f"{KEY}*")
        found = {whole(key.removeprefix(KEY), 1, MOST): value for key, value in kept}
        self._veils = dict[int, Blank]()
        for member in self.members.by_id.values():
            veil = _veil_from(found.get(member.id), member.photo)
            if veil is not None:
                self._veils[member.id] = veil

    def of(self, number: int) -> Blank | None:
        """The veiled part of a photo; None where it has none."""
        return self._veils.get(number)

    def look(self, member: Member) -> list[Member]:
        """Judges a photo that has new links and those around it: what was seen as veiled once stays
        so. Returns those of which clearly less is shown than before (inside a transaction of the
        ledger).
        """
        ledger, new = self.members.ledger, list[int]()
        for i, veil in sorted(self._found(member).items()):
            before = self._veils.get(i)
            both = veil if before is None else joined(before, veil)
            if before is not None and _share(both) < _share(before) + MORE:
                continue
            room = np.round(np.clip(both.room, -1, 1).astype(np.float64), 2)
            self._veils[i] = Blank(room=room.astype(np.float32), size=both.size)
            ledger.put_meta(f"{KEY}{i}", room.ravel().tolist())
            new.append(i)
        if new:
            tell_doubled(ledger, NOTED, len(self._veils), self._notes)
        return [self.members.by_id[i] for i in new]

    def _notes(self) -> list[str]:
        """What is told of all veils so far."""
        by_id = self.members.by_id
        names = [by_id[i].photo.name for i in sorted(self._veils) if not self._spoilt(i)]
        return [f"So far: {veiled_note(names)}"] if names else []

    def _spoilt(self, number: int) -> bool:
        """Whether a photo lacks contrast for another reason, which is told besides."""
        if number in self._blurred:
            return True
        photo = self.members.by_id[number].photo
        size = photo.width, photo.height
        white = overexposed(self.live_links.thumbnail(number), size)
        return white is not None

    def _found(self, member: Member) -> dict[int, Blank]:
        """What is veiled in a photo and those around it, by their numbers: until there is a veil,
        those that it is linked with.
        """
        if self._veils:
            return self._veiled(self._around(member, rings=2), least=0.0)
        return self._veiled(self._around(member, rings=1), least=SURE_SHARE)

    def _veiled(self, alike: list[Member], least: float) -> dict[int, Blank]:
        """What is veiled in some photos of one layer, by their numbers; `least` as in
        `veiled_parts`.
        """
        if len(alike) < FEWEST_VIEWS:
            return {}
        known = np.concatenate([m.pose.map_C[None, :2] for m in alike if m.pose is not None])
        around = AROUND * self.heights.cell
        ground = self.heights.median((*known.min(0) - around, *known.max(0) + around))
        if ground is None:
            return {}
        thumbnails = {m.id: self.live_links.thumbnail(m.id) for m in alike}
        views = [
            v
            for m in alike
            if thumbnails[m.id].dtype == np.uint8
            and m.photo.band == "visible"
            and (v := self._view(m, ground)) is not None
        ]
        if len(views) < FEWEST_VIEWS:
            return {}
        outline = np.concatenate([v.footprint for v in views])
        xy = self.heights.places((*outline.min(0), *outline.max(0)))
        if not len(xy):
            return {}
        z = self.heights.at(np.floor(xy / self.heights.cell).astype(np.int64))
        xyz = np.column_stack([xy, z])
        marks = {m.id: self.live_links.marks.shown(m.photo.camera_key) for m in alike}
        fixed = {i: mark for i, mark in marks.items() if mark is not None}
        spoilt = [v.photo for v in views if least and self._spoilt(v.photo)]
        return veiled_parts(views, xyz, thumbnails, fixed, least=least, spoilt=spoilt)

    def _around(self, member: Member, rings: int) -> list[Member]:
        """A photo and the nearest that are linked with it, of two rings also those that are linked
        with these.
        """
        known, near = self.members.by_id, {member.id}
        for _ in range(rings):
            near |= {j for i in near for j in known[i].links}
        alike = [
            m
            for i in sorted(near)
            if (m := known[i]).pose is not None and layer_of(m) == layer_of(member)
        ]
        if member.pose is not None:
            own = member.pose.map_C
            alike.sort(key=lambda m: float(np.linalg.norm(m.pose.map_C - own)) if m.pose else 0.0)
        return alike[:NEAREST]

    def _view(self, member: Member, ground: float) -> View | None:
        """A photo's view of level ground at a height in m; None where it sees none."""
        assert member.pose is not None
        camera = self.members.camera(member)
        outline = footprint(camera, member.pose, level(ground))
        if not len(outline):
            return None
        return View(photo=member.id, camera=camera, pose=member.pose, footprint=outline)


def _share(veil: Blank) -> float:
    """Share of a picture that is veiled."""
    return float((veil.room < 0).mean())


def _veil_from(said: Any, photo: Photo) -> Blank | None:
    """The veil of a photo as the ledger holds it; None where there is none, or it is damaged."""
    rows, columns = cells_of(photo.width, photo.height)
    try:
        room = np.array(json.loads(said), np.float32).reshape(rows, columns)
    except DAMAGED:
        return None
    return Blank(room=room, size=(photo.width, photo.height)) if np.isfinite(room).all() else None
