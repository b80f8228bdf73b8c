"""What all pictures of a camera in a growing survey show at the same place: a burnt-in text, a
logo, dirt on the lens. Such marks connect no photos, and are drawn only where nothing else shows
the ground. Rims that show nothing (black corners, a frame) are not drawn.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.blank import LOOKED_AT, Blank, Mask, around, blank_rim, marked
from skyquilt.imaging.grey import to_grey8
from skyquilt.live.members import Member, Members
from skyquilt.matching.fixed_marks import FindFixedMarks, FixedMarks
from skyquilt.model.features import Features
from skyquilt.model.photo import evenly
from skyquilt.outside import whole

LOOKED = "marks"
"""Name in the ledger of the number of photos in which marks were looked for, by camera."""
MOST = 10**9
"""Most of them."""


class LiveMarks:
    """The marks that the photos of each camera show, looked for whenever there are twice as many of
    them. What was found once stays. After a restart the same photos are looked at again.
    """

    def __init__(
        self,
        members: Members,
        features: Callable[[int], Features],
        thumbnail: Callable[[int], NDArray[Any]],
    ) -> None:
        """`features`, and a `thumbnail` (h, w[, bands]), of a photo by its number."""
        self.members, self.features, self.thumbnail = members, features, thumbnail
        self.find = FindFixedMarks()
        self.known = FixedMarks()
        self._looked = dict[str, int]()
        self._shown = dict[str, tuple[Mask, Blank]]()
        self._rims = dict[str, Blank]()

    def look(self, camera: str) -> bool:
        """Looks for marks in the photos of a camera (`camera_key`) that were compared so far, if it
        is time; whether links may rest on marks that were not known when they were found.
        """
        own = self._compared(camera)
        looked = self._looked.get(camera, 0)
        if len(own) < max(self.find.fewest, 2 * looked):
            return False
        told, news = self._told(camera), False
        for count in _doublings(self.find.fewest, len(own)):
            if count > looked:
                news |= self._found(camera, own[:count]) and count > told
                self._looked[camera] = count
        self._see_rim(camera, own[: self._looked[camera]])
        return news

    def alike(self, camera: str) -> tuple[Blank | None, Blank | None]:
        """Where photos of a camera show marks, and where nothing; the same objects until more
        photos tell.
        """
        return self.shown(camera), self._rims.get(camera)

    def _see_rim(self, camera: str, photos: list[Member]) -> None:
        """Notes where none of these photos of a camera shows anything."""
        some = [photos[k] for k in evenly(len(photos), LOOKED_AT)]
        mask = blank_rim([to_grey8(self.thumbnail(m.id)) for m in some])
        if mask is None:
            self._rims.pop(camera, None)
        else:
            self._rims[camera] = around(mask, (some[0].photo.width, some[0].photo.height))

    def shown(self, camera: str) -> Blank | None:
        """Where photos of a camera show marks; the same object until others are found."""
        mask = self.known.masks.get(camera)
        if mask is None:
            return None
        if camera not in self._shown or not np.array_equal(self._shown[camera][0], mask):
            self._shown[camera] = mask, marked(mask, self.known.cell_px[camera])
        return self._shown[camera][1]

    def _told(self, camera: str) -> int:
        """In how many photos of a camera marks were looked for when its links were compared
        again.
        """
        said = self.members.ledger.meta(LOOKED)
        return whole(said.get(camera), 0, MOST) or 0 if isinstance(said, dict) else 0

    def keep(self, camera: str) -> None:
        """Stores that links of a camera rest on what is known, and tells it the first time (inside
        a transaction of the ledger).
        """
        if not self._told(camera):
            for note in replace(self.known, masks={camera: self.known.masks[camera]}).notes:
                self.members.ledger.tell("note", {"text": note})
        self.members.ledger.put_meta(LOOKED, self._looked)

    def _compared(self, camera: str) -> list[Member]:
        """Photos of a camera in the order in which they were compared."""
        own = (m for m in self.members.by_id.values() if m.photo.camera_key == camera)
        return sorted((m for m in own if m.tried and m.state != "refused"), key=lambda m: m.tried)

    def _found(self, camera: str, photos: list[Member]) -> bool:
        """Whether some of these photos show marks that were not known."""
        some = [photos[k] for k in evenly(len(photos), self.find.looked_at)]
        sizes = [(m.photo.width, m.photo.height) for m in some]
        found = self.find([self.features(m.id) for m in some], [camera] * len(some), sizes)
        mask, known = found.masks.get(camera), self.known.masks.get(camera)
        if mask is None:
            return False
        both = mask if known is None else known | mask
        self.known = replace(
            self.known,
            masks={**self.known.masks, camera: both},
            cell_px={**self.known.cell_px, **found.cell_px},
        )
        return known is None or bool((both & ~known).any())


def _doublings(first: int, most: int) -> Iterator[int]:
    """first, 2 first, 4 first ... up to `most`."""
    while first <= most:
        yield first
        first *= 2
