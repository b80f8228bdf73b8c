"""Notes about photos that come one after the other: at the first, and whenever there are twice as
many. What is doubted of heights as they come.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, replace
from itertools import islice

from skyquilt.live.ledger import Ledger
from skyquilt.model.photo import GeoPosition, Photo
from skyquilt.outside import whole
from skyquilt.photos.implausible_positions import (
    ground_notes,
    raised,
    unraised,
    with_one_sign,
    without_zero_heights,
)

MOST_NOTED = 10**9
"""Most photos that a note counts."""
GROUNDED = "heights at zero"
"""Name in the ledger of the number of cameras that a note named last for that."""
MENDED = "heights mended"
"""Name in the ledger of the number of photos that a note named last for heights of zero or of the
other sign.
"""
LOOKED_BACK = 300
"""Photos by which it is told whether heights are false, and of a camera, whether positions are
rounded or repeat the one before.
"""
GROUNDED_PHOTOS = 5
"""So many photos of a camera tell that its heights above take-off stay at zero; fewer may have been
taken before it flew.
"""


def tell_doubled(ledger: Ledger, key: str, count: int, notes: Callable[[], Iterable[str]]) -> None:
    """Tells notes about `count` photos if these are twice as many as when it was told last; that
    number is kept under a name in the ledger.
    """
    noted = whole(ledger.meta(key, 0), 0, MOST_NOTED) or 0
    if count < max(1, 2 * noted):
        return
    with ledger.change():
        ledger.put_meta(key, count)
        for note in notes():
            ledger.tell("note", {"text": note})


class DoubtedHeights:
    """What is doubted of heights so far: those above take-off of cameras that tell none but zero
    (`without_ground_heights`); those above sea level or the ellipsoid of zero among others, and of
    the other sign (`without_zero_heights`, `with_one_sign`).
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._count = Counter[str]()
        self._raised = set[str]()
        self._changed = dict[int, GeoPosition | None]()

    def doubted(self, number: int, photo: Photo) -> Photo:
        """The photo of this number with the heights that are believed."""
        photo = replace(photo, position=self._changed.get(number, photo.position))
        return photo if photo.camera_key in self._raised else unraised(photo)

    def look(self, latest: Mapping[int, Photo], new: int) -> tuple[set[str], set[int]]:
        """Cameras (`camera_key`) whose heights above take-off are believed from now on, and those
        of the latest photos, of which so many are new and come first, whose other heights are
        believed otherwise now; notes what is doubted.
        """
        return self._risen(list(islice(latest.values(), new))), self._mended(latest)

    def _risen(self, new: Sequence[Photo]) -> set[str]:
        """Cameras (`camera_key`) that tell another height above take-off with these photos, and
        none before; notes those of which many photos told zero.
        """
        risen = {p.camera_key for p in new if raised(p)} - self._raised
        self._raised |= risen
        self._count.update(p.camera_key for p in new if p.above_takeoff_m is not None)
        low = {k: n for k, n in self._count.items() if k not in self._raised}
        if many := {k: n for k, n in low.items() if n >= GROUNDED_PHOTOS}:
            notes = [f"So far: {note}" for note in ground_notes(self._count, many)]
            tell_doubled(self._ledger, GROUNDED, len(many), lambda: notes)
        return risen

    def _mended(self, latest: Mapping[int, Photo]) -> set[int]:
        """Those of the latest photos whose heights of zero, or signs, are taken otherwise now."""
        numbers = sorted(latest)
        photos = [latest[i] for i in numbers]
        mended, zero = without_zero_heights(photos)
        mended, signs = with_one_sign(mended)
        before = {i: self._changed.pop(i) for i in numbers if i in self._changed}
        now = {
            i: new.position
            for i, old, new in zip(numbers, photos, mended, strict=True)
            if new is not old
        }
        self._changed |= now
        notes = [f"So far: {note}" for note in (*zero, *signs)]
        tell_doubled(self._ledger, MENDED, len(now), lambda: notes)
        same = {i for i in before.keys() & now if _values(before[i]) == _values(now[i])}
        return (before.keys() | now.keys()) - same


def _values(position: GeoPosition | None) -> tuple[object, ...] | None:
    return astuple(position) if position else None
