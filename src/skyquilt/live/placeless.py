"""A map without a place: it begins with photos that are linked with one another where none has a
position, and ends when photos with positions can tell the place.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from skyquilt.alignment.priors import choose_frame
from skyquilt.live.events import Update
from skyquilt.live.initial_pose import InitialPose
from skyquilt.live.ledger import hit
from skyquilt.live.refinement import Refinement
from skyquilt.live.settings import CLOSING
from skyquilt.model.poses import Alignment
from skyquilt.ortho.ground import round_gsd

FEWEST = 4
"""Linked photos without positions with which a map begins."""
MORE = 2
"""A map without a place is begun again around photos that are linked with one another, but not with
it, where they are more than so many times its own.
"""
PLACED = "a photo with a position belongs to the map: it is begun again with its place"
ELSEWHERE = "more photos have positions than the map without a place has: it is begun again"
LARGER = "most photos are not linked with those on the map: it is begun again around them"


@dataclass(kw_only=True, eq=False)
class Placeless:
    """Begins and ends maps without a place."""

    initial_pose: InitialPose
    """Places photos from their metadata."""
    refinement: Refinement
    """Links photos."""

    def __post_init__(self) -> None:
        self.members, self.ledger = self.refinement.members, self.refinement.ledger
        self.queues = self.refinement.queues
        self._tried: dict[int, int] = {}
        self._over = False
        self.due = True
        """Whether a photo was compared with others since this was looked at."""

    def look(self) -> Update | None:
        """Begins such a map, or ends it, if it is time. After the end (`over`) what is in memory
        must be read anew.
        """
        if not self.due:
            return None
        self.due = False
        return self._begun() if self.members.frame is None else self._ended()

    @property
    def over(self) -> bool:
        """Whether the map in memory was taken off."""
        return self._over

    def _ended(self) -> Update | None:
        """Takes the map without a place off where another one can begin; None where not."""
        if not self.members.placeless:
            return None
        known = [m for m in self.members.by_id.values() if m.photo.position is not None]
        shown = [m for m in known if m.state == "refined" and m.pose is not None]
        waiting = [m for m in known if m.state == "waiting" and m.tried]
        count = sum(1 for _ in self.members.on_map())
        around, text = None, ""
        if shown:
            around, text = shown[0], PLACED
        elif len(waiting) > count:
            around, text = waiting[0], ELSEWHERE
        elif len(self._largest()) > MORE * count:
            text = LARGER
        if not text:
            return None
        self._over = True
        return self.initial_pose.begin_again(around, text)

    def _largest(self) -> set[int]:
        """The largest block of linked photos of which none is on the map."""
        best = set[int]()
        for block in self.members.blocks.values():
            own = (self.members.by_id[i] for i in block)
            if len(block) > len(best) and all(m.state == "waiting" for m in own):
                best = block
        return best

    def _begun(self) -> Update | None:
        """Begins a map with linked photos where no photo has a position; None where they are too
        few so far, or do not fit one another.
        """
        block = self._largest()
        name = min(block, default=0)
        if len(block) < FEWEST or len(block) <= self._tried.get(name, 0):
            return None
        if any(m.photo.position is not None for m in self.queues.received):
            return None
        self._tried[name] = len(block)
        ids = self._near(block)
        frame = choose_frame([], None)
        self.members.set_frame(frame)
        done = self.refinement.local_pose.bundled(ids)
        if done is None or len(done.poses) < FEWEST or not len(done.ties.xyz):
            self.members.frame = None
            return None
        return self._begin(ids, done)

    def _near(self, block: set[int]) -> list[int]:
        """The photos of a block that its newest one reaches by the fewest links, ascending."""
        reached: dict[int, None] = {max(block): None}
        queue = deque(reached)
        while queue and len(reached) < CLOSING:
            for j in sorted(self.members.by_id[queue.popleft()].links):
                if j not in reached and len(reached) < CLOSING:
                    reached[j] = None
                    queue.append(j)
        return sorted(reached)

    def _begin(self, ids: list[int], done: Alignment) -> Update:
        new = {ids[k]: pose for k, pose in done.poses.items()}
        camera_of = {ids[k]: done.camera_of[k] for k in done.poses}
        ground = float(np.median(done.ties.xyz[:, 2]))
        above = max(float(np.median([p.map_C[2] for p in new.values()])) - ground, 1.0)
        focal = float(np.median([self.members.by_id[i].photo.focal.px for i in new]))
        asked = self.members.settings.gsd_cm
        headed = any(np.isfinite(self.members.by_id[i].prior.yaw_deg) for i in new)
        text = begins_without_place(headed=headed)
        with self.ledger.change():
            gsd = asked / 100 if asked else round_gsd(3 * above / focal)
            self.initial_pose.fix(gsd, above, ground, text)
            self.members.save_cameras(dict(done.cameras))
            self.refinement.heights(done.ties.xyz, new, known=True)
            found = self.refinement.begun_with(new, camera_of)
        hit("map begun without a place")
        self.refinement.take_back(found)
        for i in new:
            member = self.members.by_id[i]
            self.refinement.local_pose.neighbours.indexed(member)
            self.initial_pose.redraw.show(member)
        return Update(what="noted", moved=tuple(new), text=text)


def begins_without_place(*, headed: bool) -> str:
    """What is told of a map without a place; `headed`: photos report headings."""
    unknown = "its place and scale are" if headed else "its place, north and scale are"
    return (
        f"no photo has a position so far: the map begins with photos that overlap, and {unknown}"
        " not known; as soon as a photo with a position overlaps them, it is begun again with its"
        " place"
    )
