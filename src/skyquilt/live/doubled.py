"""Notes about photos that come one after the other: at the first, and whenever there are twice as
many. What is doubted of heights above take-off as they come.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from skyquilt.live.ledger import Ledger
from skyquilt.model.photo import Photo
from skyquilt.outside import whole
from skyquilt.photos.implausible_positions import ground_notes, raised, unraised

MOST_NOTED = 10**9
"""Most photos that a note counts."""
GROUNDED = "heights at zero"
"""Name in the ledger of the number of cameras that a note named last for that."""
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


class Grounded:
    """The cameras whose heights above take-off stay at zero so far (`without_ground_heights`)."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._count = Counter[str]()
        self._raised = set[str]()

    def doubted(self, photo: Photo) -> Photo:
        """The photo, without the height above take-off where its camera tells none but zero."""
        return photo if photo.camera_key in self._raised else unraised(photo)

    def look(self, new: Sequence[Photo]) -> set[str]:
        """Cameras (`camera_key`) that tell another height with these photos, and none before; notes
        those of which many photos told zero.
        """
        risen = {p.camera_key for p in new if raised(p)} - self._raised
        self._raised |= risen
        self._count.update(p.camera_key for p in new if p.above_takeoff_m is not None)
        low = {k: n for k, n in self._count.items() if k not in self._raised}
        if many := {k: n for k, n in low.items() if n >= GROUNDED_PHOTOS}:
            notes = [f"So far: {note}" for note in ground_notes(self._count, many)]
            tell_doubled(self._ledger, GROUNDED, len(many), lambda: notes)
        return risen
