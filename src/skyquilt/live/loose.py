"""Photos that stand by their metadata though they were compared with others, or that an adjustment
of all could not hold: they may show no ground (a lens cap, a hand, a thermal camera's closed
shutter) or lie elsewhere, so they are drawn only where no other photo shows the ground. The map at
the end leaves most of them out.
"""

from skyquilt.imaging.blank import Blank, whole_picture
from skyquilt.live.members import Member, Members


def is_loose(member: Member) -> bool:
    """Whether a photo is one of these."""
    return member.tried > 0 and member.state == "placed"


class LivePlaced:
    """What is drawn badly of photos, by how they are placed."""

    def __init__(self, members: Members) -> None:
        self.members = members

    def of(self, number: int) -> Blank | None:
        """All of a photo that is loose."""
        member = self.members.by_id[number]
        size = member.photo.width, member.photo.height
        return whole_picture(size) if is_loose(member) else None
