"""Blurred photos of a growing map: they are drawn only where no other photo shows the ground.

As on the map at the end (`ortho.sharpness`), the detail of pictures is compared where they show the
same ground: here at the features that link two photos, so that a photo costs as much as it has
links, however large the map is.
"""

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.blank import Blank, whole_picture
from skyquilt.live.doubled import tell_doubled
from skyquilt.live.links import LiveLinks
from skyquilt.live.members import Member
from skyquilt.model.features import Link
from skyquilt.model.photo import Photo
from skyquilt.ortho.sharpness import BLURRED, FEWEST_CELLS, blurred_note
from skyquilt.outside import whole

FEWEST_LINKS = 2
"""Fewest photos against which one is judged: of two that differ, the other may be the sharper."""
SHARP_SHARE = 0.75
"""Quantile of the linked photos that counts as sharp: one of four is not blurred. Against it, 5 px
of motion take 1.2 to 1.7 off the logarithm of detail, sharp photos lie up to 0.9 below.
"""
MOST_TURNED_DEG, MOST_LARGER = 30.0, 1.3
"""Angle by which two photos that are compared are turned against one another at most, half a turn
aside, and how much larger one of them shows the ground at most: detail differs by up to 1.1, by 1.9
beyond.
"""
KEY, NOTED = "blurred", "blurred noted"
"""Names in the ledger of the blurred photos, and of how many were noted last."""
MOST = 10**9
"""Largest number of a photo."""


class LiveBlur:
    """Which photos are blurred."""

    def __init__(self, live_links: LiveLinks) -> None:
        """Reads what was known before a restart."""
        self.live_links, self.members = live_links, live_links.members
        said = self.members.ledger.meta(KEY)
        known = (whole(v, 1, MOST) for v in (said if isinstance(said, list) else []))
        self.blurred = {v for v in known if v is not None}
        self._pairs: dict[tuple[int, int], NDArray[np.float64] | None] = {}

    def of(self, number: int) -> Blank | None:
        """All of a photo if it is blurred."""
        photo = self.members.by_id[number].photo
        return whole_picture((photo.width, photo.height)) if number in self.blurred else None

    def look(self, member: Member) -> list[Member]:
        """Judges a photo that has new links, and those that it is linked with; returns those whose
        verdict is another than before (inside a transaction of the ledger).
        """
        changed = [i for i in sorted({member.id, *member.links}) if self._judged(i)]
        if changed:
            ledger = self.members.ledger
            ledger.put_meta(KEY, sorted(self.blurred))
            names = [self.members.by_id[i].photo.name for i in sorted(self.blurred)]
            note = blurred_note(names) if names else ""
            tell_doubled(
                ledger, NOTED, len(names), lambda: [note if len(names) < 2 else f"So far {note}"]
            )
        return [self.members.by_id[i] for i in changed]

    def _judged(self, number: int) -> bool:
        """Whether the verdict on a photo has changed."""
        own = self.members.by_id[number]
        below = [
            off
            for j in sorted(own.links)
            if self.members.by_id[j].photo.camera_key == own.photo.camera_key
            and (off := self._lacks(number, j)) is not None
        ]
        if len(below) < FEWEST_LINKS:
            return False
        now = bool(np.quantile(np.array(below), SHARP_SHARE, axis=0).max() > BLURRED)
        before = number in self.blurred
        self.blurred.symmetric_difference_update({number} if now != before else ())
        return now != before

    def _lacks(self, number: int, other: int) -> NDArray[np.float64] | None:
        """(2,) logarithm of the detail of another photo over that of this one, along x and y, where
        both show the same ground; None where too little tells it.
        """
        a, b = sorted((number, other))
        if (a, b) not in self._pairs:
            self._pairs[a, b] = self._compared(a, b)
        off = self._pairs[a, b]
        return off if off is None or number == a else -off

    def _compared(self, a: int, b: int) -> NDArray[np.float64] | None:
        link = self.live_links.link(a, b)
        if link is None or not _alike(link):
            return None
        matched = {link.a: link.index_a, link.b: link.index_b}  # a photo that waited is its first
        shown = [self._detail(i, matched[i]) for i in (a, b)]
        off = shown[1] - shown[0]
        off = off[np.isfinite(off).all(1)]
        return np.asarray(np.median(off, axis=0)) if len(off) >= FEWEST_CELLS else None

    def _detail(self, number: int, chosen: NDArray[np.integer]) -> NDArray[np.float64]:
        """(k, 2) detail of a photo in the cells of some of its features."""
        photo, px = self.members.by_id[number].photo, self.live_links.features(number).px[chosen]
        detail = self.live_links.detail(number)
        return np.asarray(detail[_cells(px, photo, detail.shape[:2])][:, :2], np.float64)


def _alike(link: Link) -> bool:
    """Whether two photos show the ground in about the same direction and size: along an axis of the
    one lies other detail than along that of the other, where they are turned, and it is larger
    where one looks from farther away, as photos around a place do.
    """
    turned = abs((np.degrees(np.angle(link.b_S_a)) + 90) % 180 - 90)
    return bool(turned <= MOST_TURNED_DEG and abs(np.log(abs(link.b_S_a))) <= np.log(MOST_LARGER))


def _cells(
    px: NDArray[np.floating], photo: Photo, cells: tuple[int, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns (k,) of the cells in which pixels (k, 2) of a photo lie."""
    size = np.array([photo.width, photo.height])
    most = np.array(cells[::-1]) - 1
    column, row = np.clip(np.floor((px + 0.5) / size * (most + 1)), 0, most).astype(np.int64).T
    return row, column
