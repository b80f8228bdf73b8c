"""Chooses the photos with which a new one is compared, by a spatial index of camera positions."""

from bisect import bisect_left, insort
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.determined import STATED_DEG
from skyquilt.alignment.start import ground_of
from skyquilt.live.drone_metadata import Metadata
from skyquilt.live.members import ON_MAP, Member, Members
from skyquilt.live.settings import NEIGHBOURS
from skyquilt.model.poses import Pose
from skyquilt.photos.survey import capture_order

STRANGERS = 2
"""Photos of blocks that a photo is not linked with, with which it is compared besides."""
BESIDE = 12
"""Photos around one that looks aside and does not tell where, with which it is compared: as many as
on the map at the end.
"""
CELL_M = 30.0
"""Side of the cells of the index in m."""
GUESSED = 2
"""Number of photos that came next, with which one is compared that does not tell its tilt, where
fewer than so many seem near: taken to look down, it and the ground below it may be elsewhere.
"""


class Neighbours:
    """Spatial index of the photos that were compared before."""

    def __init__(self, members: Members, metadata: Metadata) -> None:
        self.members, self.metadata = members, metadata
        self._grid: dict[tuple[int, int], set[int]] = defaultdict(set)
        self._cell_of: dict[int, tuple[int, int]] = {}
        self._taken: dict[tuple[str, ...], list[tuple[Any, int]]] = defaultdict(list)
        """Photos of each drone in the order in which they were taken."""
        for member in members.on_map():
            if member.tried:
                self.indexed(member)

    def indexed(self, member: Member) -> None:
        """Adds a photo to the index, or updates its position."""
        if member.pose is None:
            return
        c, r = np.floor(member.pose.map_C[:2] / CELL_M).astype(int).tolist()
        old = self._cell_of.get(member.id)
        if old is not None and old != (c, r):
            self._grid[old].discard(member.id)
        if old is None:
            insort(self._taken[_taken_by(member)], (capture_order(member.photo), member.id))
        self._cell_of[member.id] = (c, r)
        self._grid[c, r].add(member.id)

    @staticmethod
    def aim(pose: Pose, ground: float) -> NDArray[np.float64]:
        """Ground point (2,) in m of the centre of a photo, on flat ground of that height."""
        ray = pose.cam_R_map[2]
        drop = (ground - pose.map_C[2]) / min(float(ray[2]), -0.3)
        return np.asarray(pose.map_C[:2] + ray[:2] * drop)

    def of(self, member: Member, pose: Pose | None, most: int = NEIGHBOURS) -> list[int]:
        """Photos of the same spectral band that were compared before, nearest first. If the
        position is unknown, and where hardly any is near a photo that does not tell where it looks:
        those that came next before or after it.
        """
        if pose is None:
            return self._latest(member, most)
        near = self._nearest(member, pose)[:most]
        if len(near) < GUESSED and member.prior.sigma_tilt_deg > STATED_DEG:
            near += [i for i in self._latest(member, GUESSED) if i not in near]
        return near

    def strangers(self, member: Member, pose: Pose, met: Iterable[int] = ()) -> list[int]:
        """The nearest photos, of those like the ones that `of` gives, in other blocks of linked
        photos than a photo at this pose and those that it has `met`. Those with which it was
        compared are left out.
        """
        block_of = self.members.block_of
        known = {block_of[member.id], *(block_of[i] for i in met)}
        if len(self.members.blocks) <= len(known):
            return []
        others = (
            i
            for i in self._nearest(member, pose)
            if block_of[i] not in known
            and len(self.members.block(i)) > 1
            and not self.members.ledger.compared(i, member.id)
        )
        return list(islice(others, STRANGERS))

    def taken_next(self, member: Member) -> list[int]:
        """The photos that its drone took next before and after one, if they belong to other blocks
        of linked photos: what is near by a position that is far off does not show the same. Those
        with which it was compared are left out.
        """
        own = self._taken[_taken_by(member)]
        at = bisect_left(own, (capture_order(member.photo), member.id))
        block, known = self.members.block(member.id), self.members.ledger.compared
        found = list[int]()
        for places in (range(at - 1, -1, -1), range(at, len(own))):
            ids = (own[k][1] for k in places)
            shown = (i for i in ids if i != member.id and self.members.by_id[i].state in ON_MAP)
            found += islice(shown, 1)
        return [i for i in found if i not in block and not known(i, member.id)]

    def beside(self, member: Member) -> list[int]:
        """The photos of its band taken nearest to one, by their places on the map, those left out
        with which it was compared. Where each looks is no matter: it may be found wrongly.
        """
        if member.pose is None:
            return []
        C = member.pose.map_C[:2]
        apart = sorted(
            (float(np.hypot(*(m.pose.map_C[:2] - C))), m.id)
            for m in self.members.on_map()
            if m.pose is not None and m.id != member.id and m.photo.band == member.photo.band
        )
        known = self.members.ledger.compared
        return [i for _, i in apart[:BESIDE] if not known(i, member.id)]

    def _nearest(self, member: Member, pose: Pose) -> list[int]:
        """The photos that may show the same as one at this pose, nearest first."""
        photo = member.photo
        ground = self.metadata.ground_at(pose.map_C)
        at = self.aim(pose, ground)
        above = max(float(pose.map_C[2]) - ground, self._told_above(member), 2.0)
        reach = (
            above * max(photo.width, photo.height) / photo.focal.px + 2 * self.metadata.scatter()
        )
        found = []
        for i in self._near(at, reach + above):
            other = self.members.by_id[i]
            if i == member.id or other.photo.band != photo.band or other.state == "superseded":
                continue
            apart = (
                np.inf
                if other.pose is None
                else float(np.hypot(*(self.aim(other.pose, ground) - at)))
            )
            if apart <= reach:
                found.append((apart, i))
        return [i for _, i in sorted(found)]

    def _told_above(self, member: Member) -> float:
        """Height in m above the place of take-off that a photo reports; 0 where it is not known.
        The ground of the first photos is known no better than their distances, of positions that
        err.
        """
        frame = self.members.frame
        above = member.prior.map_C[2] - ground_of(frame) if frame is not None else np.nan
        return float(above) if np.isfinite(above) else 0.0

    def _near(self, at: NDArray[Any], reach: float) -> list[int]:
        """Photos taken from above a square around a ground point. The search reaches beyond the
        photo's footprint, since oblique cameras are not above the ground that they see.
        """
        rings = int(np.ceil(reach / CELL_M))
        c, r = np.floor(at / CELL_M).astype(int).tolist()
        if (2 * rings + 1) ** 2 > len(self._grid):  # an absurd height must not cost absurd time
            near = (k for k in self._grid if max(abs(k[0] - c), abs(k[1] - r)) <= rings)
            return [i for k in sorted(near) for i in self._grid[k]]
        return [
            i
            for dc in range(-rings, rings + 1)
            for dr in range(-rings, rings + 1)
            for i in self._grid.get((c + dc, r + dr), ())
        ]

    def _latest(self, member: Member, most: int) -> list[int]:
        """Those on the map that the photo is linked with, then those that came nearest before or
        after it; while the map has no place, then others that wait, too: one begins with them, or
        they come to it together.
        """
        alone = self.members.frame is None or self.members.placeless
        on_map, waiting = list[tuple[bool, int]](), list[tuple[bool, int]]()
        linked = [self.members.by_id[i] for i in sorted(member.links)]
        for other in self._outward(member.id):
            if other.tried and other.photo.band == member.photo.band:
                found = other.source != member.source, other.id
                if other.pose is not None and len(on_map) < most:
                    on_map.append(found)
                elif alone and other.state == "waiting" and len(waiting) < most:
                    waiting.append(found)
            if len(on_map) >= most and (len(waiting) >= most or not alone):
                break
        near = [i for found in (on_map, waiting) for _, i in sorted(found, key=lambda f: f[0])]
        return list(dict.fromkeys([m.id for m in linked if m.pose is not None][:most] + near))

    def _outward(self, number: int) -> Iterator[Member]:
        """All photos but this one, those that were accepted next before or after it first."""
        known = self.members.by_id
        for apart in range(1, max(known, default=0) + 1):
            for i in (number - apart, number + apart):
                if i in known:
                    yield known[i]


def _taken_by(member: Member) -> tuple[str, ...]:
    """The drone and the camera of a photo, and what it shows."""
    return member.source, member.photo.camera_key, member.photo.band
