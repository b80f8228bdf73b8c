"""What those who look on are told: each sentence is a row of the ledger, in the transaction of what it tells."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from skyquilt.pipelines.live.drawing import Canvas
from skyquilt.pipelines.live.state import Member, Members
from skyquilt.raster.tile_store import Address


class News:
    """Of photos and of tiles."""

    def __init__(self, members: Members, canvas: Canvas) -> None:
        self.members, self.ledger, self.canvas = members, members.ledger, canvas

    def photo(self, member: Member, **more: Any) -> None:
        """The state of a photo, and `more` of it."""
        photo = member.photo
        said = {"id": member.id, "name": photo.name, "source": member.source, "state": member.state,
                "time": photo.time.isoformat() if photo.time else None}  # fmt: skip
        self.ledger.tell("photo", {**said, **more})

    def superseded(self, member: Member) -> None:
        """A preview that has given way."""
        self.ledger.tell("photo", {"id": member.id, "name": member.photo.name, "state": "superseded"})

    def place(self, member: Member) -> tuple[list[list[float]], list[float]]:
        """Footprint and centre of a photo on the map, in degrees."""
        assert member.pose is not None
        outline = self.canvas.outline(member.id)
        ring = [] if outline is None else self.members.lonlat(outline)
        return ring, self.members.lonlat(member.pose.map_C[None, :2])[0]

    def tiles(self, addresses: Iterable[Address], rule: str) -> None:
        """Where the map has changed, by layer."""
        by_layer: dict[str, list[tuple[float, float, float, float]]] = {}
        for a in addresses:
            by_layer.setdefault(a.layer + rule, []).append(a.grid(self.canvas.gsd).bounds)
        for layer, boxes in by_layer.items():
            box = np.array(boxes)
            corners = np.array([[box[:, 0].min(), box[:, 1].min()], [box[:, 2].max(), box[:, 3].max()]])
            low, high = self.members.lonlat(corners)
            self.ledger.tell("tiles", {"layer": layer, "bounds": [*low, *high], "count": len(boxes)})
