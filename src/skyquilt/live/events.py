"""Events for viewers. Each event is a row of the ledger, written in the same transaction as the
change that it reports. `Update` is what one unit of work reports to its caller.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from skyquilt.live.members import Member, Members
from skyquilt.live.tile_drawing import Canvas
from skyquilt.raster.tile_store import Address


@dataclass(frozen=True, kw_only=True)
class Update:
    """Describes one unit of work that was done."""

    what: str
    """placed, waiting, refined, loose, refused, drawn, closed or noted."""
    photo: int | None = None
    """The photo concerned."""
    moved: tuple[int, ...] = ()
    """Photos that have moved."""
    tiles: int = 0
    """Tiles written."""
    text: str = ""
    """A message for the user; may be empty."""
    seconds: float = 0.0
    """Duration in s."""


MOST_BOXES = 24
"""Largest number of boxes with which a change of the map is reported."""


class MapEvents:
    """Reports changes of photos and of tiles."""

    def __init__(self, members: Members, canvas: Canvas) -> None:
        self.members, self.ledger, self.canvas = members, members.ledger, canvas

    def photo(self, member: Member, **more: Any) -> None:
        """Reports the state of a photo; `more`: further fields."""
        photo = member.photo
        said = {
            "id": member.id,
            "name": photo.name,
            "source": member.source,
            "state": member.state,
            "time": photo.time.isoformat() if photo.time else None,
        }
        self.ledger.tell("photo", {**said, **more})

    def superseded(self, member: Member) -> None:
        """Reports that a preview was replaced by the full photo."""
        self.ledger.tell(
            "photo", {"id": member.id, "name": member.photo.name, "state": "superseded"}
        )

    def place(self, member: Member) -> tuple[list[list[float]], list[float] | None]:
        """Footprint and centre of a photo on the map, in degrees; none where the map has no
        place.
        """
        assert member.pose is not None
        if self.members.placeless:
            return [], None
        outline = self.canvas.outline(member.id)
        ring = [] if outline is None else self.members.lonlat(outline)
        return ring, self.members.lonlat(member.pose.map_C[None, :2])[0]

    def tiles(self, addresses: Iterable[Address]) -> None:
        """Reports where the map has changed, per layer: the overall bounding box, and smaller
        boxes, so that viewers need not fetch unchanged tiles again.
        """
        by_layer: dict[str, set[Address]] = {}
        for a in addresses:
            by_layer.setdefault(a.layer, set()).add(a)
        for layer, changed in by_layer.items():
            boxes = [self._degrees(a) for a in sorted(_gathered(changed))]
            low, high = np.min(boxes, axis=0).tolist(), np.max(boxes, axis=0).tolist()
            whole = [low[0], low[1], high[2], high[3]]
            said = {"layer": layer, "bounds": whole, "boxes": boxes, "count": len(changed)}
            if self.members.placeless:
                said["placeless"] = True
            self.ledger.tell("tiles", said)

    def _degrees(self, address: Address) -> list[float]:
        """West, south, east, north in degrees of all corners of a tile."""
        west, south, east, north = address.grid(self.canvas.gsd).bounds
        corners = np.array([[west, south], [west, north], [east, south], [east, north]])
        found = np.array(self.members.lonlat(corners))
        return [*found.min(0).tolist(), *found.max(0).tolist()]


def _gathered(changed: set[Address]) -> set[Address]:
    """Covers the same area with few tiles: coarser ones if there are many."""
    while len(changed) > MOST_BOXES:
        changed = {a.parent for a in changed}
    return changed
