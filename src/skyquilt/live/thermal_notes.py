"""What is told of thermal photos while a map grows: their units, and whether their palettes differ.

The same sentences as of whole flights, but none twice for other numbers alone. They are looked for
whenever the photos have grown by a fifth: that costs more the more there are.
"""

from skyquilt.live.doubled import MOST_NOTED
from skyquilt.live.links import LiveLinks
from skyquilt.live.members import Member
from skyquilt.model.photo import evenly
from skyquilt.ortho.palettes import palette_notes
from skyquilt.outside import whole
from skyquilt.photos.thermal import UNREAD
from skyquilt.photos.thermal_units import unit_notes

NOTED, TOLD = "thermal noted", "thermal told"
"""Names in the ledger of the number of thermal photos at the last look, and of what was told."""
VALUES = r"[0-9]+|as [^ ]+ \(|, as .*?:"
"""What differs between notes that are the same."""
FEWEST, GROWN = 2, 1.2
"""Photos from which these are looked for, and the growth after which they are again."""
LOOKED_AT = 24
"""Photos whose palettes are compared, spread evenly over the flight."""


class ThermalNotes:
    """Tells what users of a thermal map must know."""

    def __init__(self, live_links: LiveLinks) -> None:
        self.live_links, self.members = live_links, live_links.members

    def look(self, member: Member) -> None:
        """Tells what there is to tell, with a photo that was just compared (inside a transaction of
        the ledger).
        """
        if not _is_told_of(member):
            return
        known = [
            m
            for m in self.members.by_id.values()
            if m.tried and m.state != "refused" and _is_told_of(m)
        ]
        ledger = self.members.ledger
        noted = whole(ledger.meta(NOTED, 0), 0, MOST_NOTED) or 0
        if len(known) < max(FEWEST, GROWN * noted):
            return
        ledger.put_meta(NOTED, len(known))
        notes = (*unit_notes([m.photo for m in known]), *self._palettes(known))
        ledger.tell_new(notes, TOLD, VALUES)

    def _palettes(self, known: list[Member]) -> tuple[str, ...]:
        own = [m for m in known if m.photo.band == "thermal" and not m.photo.unit]
        some = [own[k] for k in evenly(len(own), LOOKED_AT)]
        thumbnails = {k: self.live_links.thumbnail(m.id) for k, m in enumerate(some)}
        return palette_notes([m.photo for m in some], thumbnails)


def _is_told_of(member: Member) -> bool:
    photo = member.photo
    return photo.band == "thermal" or photo.dtype != "uint8" or UNREAD in photo.notes
