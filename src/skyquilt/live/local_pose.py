"""The pose of a photo from its links: an adjustment with a bounded number of neighbours."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.determined import AGAINST, elsewhere_reason, lies_elsewhere
from skyquilt.alignment.local_adjustment import AdjustedWindow, LocalAdjustment, Window
from skyquilt.alignment.nothing_shown import ONE_TONE
from skyquilt.alignment.oblique import axes_apart_deg
from skyquilt.errors import AlignmentError, UnreadablePhotoError
from skyquilt.live.background_adjustment import QUICK
from skyquilt.live.drone_metadata import Metadata
from skyquilt.live.kept_frame import in_frame_of
from skyquilt.live.links import LiveLinks
from skyquilt.live.members import Member, Members
from skyquilt.live.neighbours import Neighbours
from skyquilt.live.settings import YOUNG, LiveSettings
from skyquilt.model.camera import Camera
from skyquilt.model.features import Link
from skyquilt.model.poses import Alignment, Pose

RING = 8
"""Number of photos held fixed around those that may move."""
MOVING = 2
"""Number of linked photos that are adjusted together with a new one."""
STRAY_HIGH, STRAY_DEG = 0.02, 2.0
"""Share of the flying height, and angle in degrees, by which a new photo may move a neighbour; more
is no correction of what stood there, but a neighbour that little holds.
"""
ELSEWHERE_HIGH = 0.2
"""Share of the flying height by which a photo was found beside the place where it was sought, from
which other photos are near it.
"""
NO_MAP = "no photo has a position so far, and too few overlap for a map without a place"
MISLED = (
    "by its matches the photos around it would lie elsewhere than their positions: they are of"
    " places that look alike"
)
FEWEST_TOLD, WORSE, WORSE_HIGH = 3, 3.0, 0.1
"""Photos of the map whose positions tell that; how many times further from them they would lie, in
the mean, than before, and than positions err; and by which share of the flying height.
"""
NOT_ON_MAP = "it overlaps other photos, but none that is on the map"


@dataclass(frozen=True, kw_only=True, eq=False)
class Change:
    """Result of refining one photo."""

    moved: dict[int, Pose]
    """New poses, by photo."""
    cameras: dict[str, Camera]
    """New calibrations."""
    camera_of: dict[int, str]
    """Name of the calibration of each moved photo."""
    links: dict[tuple[int, int], Link | None]
    """Pairs compared; None = they do not match."""
    xyz: NDArray[np.float64]
    """(P, 3) ground points in m."""
    reason: str = ""
    """Why the links do not determine the photo's pose; empty if they do."""
    observations: int = 0
    """Tie points of the photo; 0 = not told."""
    rejected: dict[int, str] = field(default_factory=dict)
    """Other photos that an adjustment of the whole block could not hold, with reasons."""


class LocalPose:
    """Refines the poses of single photos; writes nothing."""

    def __init__(
        self,
        members: Members,
        metadata: Metadata,
        neighbours: Neighbours,
        live_links: LiveLinks,
        settings: LiveSettings,
    ) -> None:
        self.members, self.settings = members, settings
        self.metadata, self.neighbours, self.live_links = metadata, neighbours, live_links
        self.adjust_locally, self.young = LocalAdjustment(), QUICK

    def refine(
        self, member: Member, more: Mapping[tuple[int, int], Link | None] = MappingProxyType({})
    ) -> Change:
        """Compares a photo with its neighbours and adjusts it together with them and with what it
        was compared with besides (`more`); writes nothing.

        Raises:
            UnreadablePhotoError: it has no links, and is black or white all over.
        """
        links = self.live_links.compared(member, self.neighbours.of(member, member.pose))
        links |= more
        links |= self._strangers(member, member.pose, links)
        lost = member.pose is None or not any(links.values())
        if lost and member.pose is not None:  # its position may be far off
            near = [i for i in self.neighbours.taken_next(member) if (i, member.id) not in links]
            links |= self.live_links.compared(member, near)
        good = {key: k for key, k in links.items() if k is not None}
        if not good:
            if self.live_links.shows_nothing(member.id, compared=bool(links)):
                raise UnreadablePhotoError(ONE_TONE)
            why = "it matches none of its neighbours" if links else "there is no photo near it yet"
            return _unmoved(links, why)
        if self.members.frame is None:
            return _unmoved(links, NO_MAP)
        change = self._joined(member, links, good)
        found = change.moved.get(member.id)
        if found is None or not (lost or self._elsewhere(member.pose, found)):
            return change
        # it was compared with those taken before it, or near a place that is not its own: now its
        # place tells which others it overlaps
        near = [i for i in self.neighbours.of(member, found) if (i, member.id) not in links]
        more = self.live_links.compared(member, near)
        more |= self._strangers(member, found, links | more)
        good |= {key: k for key, k in more.items() if k is not None}
        links |= more
        joined = self._joined(member, links, good) if any(more.values()) else change
        return joined if member.id in joined.moved else change

    def _elsewhere(self, pose: Pose | None, found: Pose) -> bool:
        """Whether a photo was found so far from where it stood that others are near it."""
        if pose is None:
            return True
        high = max(float(found.map_C[2]) - self.metadata.ground_at(found.map_C), 1.0)
        return float(np.hypot(*(found.map_C - pose.map_C)[:2])) > ELSEWHERE_HIGH * high

    def _strangers(
        self, member: Member, pose: Pose | None, links: Mapping[tuple[int, int], Link | None]
    ) -> dict[tuple[int, int], Link | None]:
        """A photo compared with the nearest of blocks that it is not linked with: where two blocks
        meet, the nearest photos are those of one of them, and the other would stay apart.
        """
        if pose is None:
            return {}
        met = [i for key, k in links.items() if k is not None for i in key]
        known = {i for key in links for i in key}
        near = self.neighbours.strangers(member, pose, met)
        return self.live_links.compared(member, [i for i in near if i not in known])

    def _joined(
        self,
        member: Member,
        links: dict[tuple[int, int], Link | None],
        good: dict[tuple[int, int], Link],
    ) -> Change:
        change = self._pose_by(member, links, good)
        why = self._misled(member, change)
        return _unmoved(links | dict.fromkeys(good, None), why) if why else change

    def _misled(self, member: Member, change: Change) -> str:
        """Why the photo's matches are taken for ones of places that look alike: few of them place
        it elsewhere than its position, or they move those on the map away from positions with which
        they agreed. Empty if they are believed.
        """
        told = [
            (m.prior, m.pose, pose)
            for i, pose in change.moved.items()
            if i != member.id
            and (m := self.members.by_id[i]).pose is not None
            and np.isfinite(m.prior.map_C[:2]).all()
        ]
        if len(told) < FEWEST_TOLD:
            return ""
        priors, old, new = zip(*told, strict=True)
        place = np.array([p.map_C[:2] for p in priors])
        before, after = (np.array([p.map_C[:2] for p in poses]) - place for poses in (old, new))
        was, now = (float(np.linalg.norm(d, axis=1).mean()) for d in (before, after))
        usual = max(was, float(np.median([p.sigma_C[0] for p in priors])))
        middle = np.mean([p.map_C for p in new], axis=0)
        high = max(float(middle[2]) - self.metadata.ground_at(middle), 1.0)
        if now > WORSE * usual and now - was > WORSE_HIGH * high:
            return MISLED
        own = change.moved.get(member.id)
        if own is None or not 0 < change.observations < AGAINST:
            return ""
        off = (own.map_C - member.prior.map_C)[:2] - np.median(after, axis=0)
        away, sigma = np.linalg.norm(off), np.maximum(usual, member.prior.sigma_C[0])
        if not lies_elsewhere(np.asarray(away), sigma, np.asarray(high)):  # also without a position
            return ""
        return elsewhere_reason(change.observations, float(away))

    def _pose_by(
        self,
        member: Member,
        links: dict[tuple[int, int], Link | None],
        good: dict[tuple[int, int], Link],
    ) -> Change:
        whole = {member.id}
        for a, _ in good:
            whole |= self.members.block(a)
        if all(self.members.by_id[i].pose is None for i in whole):
            return _unmoved(links, NOT_ON_MAP)
        if self.settings.reposition and len(whole) <= YOUNG:
            done = self.bundled(sorted(whole), good)
            if done is not None:
                ids = sorted(whole)
                rejected = {ids[k]: why for k, why in done.rejected.items()}
                return Change(
                    moved={ids[k]: p for k, p in done.poses.items()},
                    cameras=dict(done.cameras),
                    camera_of={ids[k]: done.camera_of[k] for k in done.poses},
                    links=links,
                    xyz=done.ties.xyz,
                    reason=rejected.pop(member.id, ""),
                    rejected=rejected,
                    observations=int((done.ties.photo == ids.index(member.id)).sum()),
                )
        return self._adjusted_locally(member, links, good)

    def bundled(
        self, ids: Sequence[int], more: Mapping[tuple[int, int], Link] = MappingProxyType({})
    ) -> Alignment | None:
        """Adjusts a small block as a whole, in the map's frame; `more`: links that are not stored
        yet. None where it fails.
        """
        where = {i: k for k, i in enumerate(ids)}
        known = [k for k in self.live_links.links_among(ids) if (k.a, k.b) not in more]
        links = [_renumbered(k, where) for k in [*known, *more.values()]]
        members = [self.members.by_id[i] for i in ids]
        assert self.members.frame is not None
        try:
            done = self.young(
                [m.photo for m in members],
                self.members.frame,
                [m.prior for m in members],
                [self.live_links.features(i) for i in ids],
                links,
            )
        except (AlignmentError, np.linalg.LinAlgError, ValueError):
            return None
        before = {where[m.id]: m.pose for m in members if m.pose is not None}
        if not self.members.placeless or not before:
            return done
        return in_frame_of(done, before, float(self.members.ledger.meta("ground", 0.0)))

    def _adjusted_locally(
        self,
        member: Member,
        links: dict[tuple[int, int], Link | None],
        good: dict[tuple[int, int], Link],
    ) -> Change:
        """Adjusts a photo that joins a larger block together with its neighbours; all photos around
        them are held fixed. Neighbours that stand where their metadata put them, so that nothing
        could rest on them, move first.
        """
        direct = sorted({a for a, _ in good if self.members.by_id[a].pose is not None})
        by_strength = sorted(direct, key=lambda a: (self._adjusted(a), -len(good[a, member.id]), a))
        moving = set(by_strength[:MOVING]) if self.settings.reposition else set()
        ring = {j for i in moving for j in self.members.by_id[i].links if self._adjusted(j)}
        ring -= {member.id, *direct}
        kept = sorted(ring, key=lambda j: (-len(self.members.by_id[j].links & moving), j))[:RING]
        ids = sorted({member.id, *direct, *kept})
        held = frozenset(ids) - moving - {member.id}
        # links with photos that have no pose, as those that wait, tell nothing here
        usable = [k for (a, _), k in good.items() if a in direct]
        asked = self.window(member, ids, held, usable)
        done = self.adjust_locally(asked)
        if isinstance(done, AdjustedWindow) and self._strays(
            {ids[k]: p for k, p in done.poses.items() if ids[k] != member.id}
        ):  # little holds a neighbour where the two meet, and it stood better
            stood = frozenset(k for k in moving if self._adjusted(k))
            done = self.adjust_locally(self.window(member, ids, held | stood, usable))
        if not isinstance(done, AdjustedWindow):
            return _unmoved(links, done.reason)
        own = [k for k in asked.links if asked.new in (k.a, k.b)]
        for key in self._wrong(own, asked.new, ids, done.dropped):
            links[key] = None
        moved = {ids[k]: p for k, p in done.poses.items()}
        camera_of = {i: self.members.by_id[i].camera for i in moved} | {member.id: done.camera}
        return Change(
            moved=moved,
            cameras={},
            camera_of=camera_of,
            links=links,
            xyz=done.xyz,
            observations=done.observations,
        )

    def _wrong(
        self,
        own: Sequence[Link],
        new: int,
        ids: Sequence[int],
        dropped: Collection[tuple[int, int]],
    ) -> list[tuple[int, int]]:
        """Those of the links of a photo (`new`: its place in `ids`) that contradict the others, and
        are not believed. Blocks that only their positions place lie as far apart as these err: what
        leads from one to another by enough matches contradicts nothing, and an adjustment of both
        as a whole is due.
        """
        of = {(k.a, k.b): self.members.block_of[ids[k.other(new)]] for k in own}
        kept = {block for key, block in of.items() if key not in dropped}
        return [
            (ids[k.a], ids[k.b])
            for k in own
            if (k.a, k.b) in dropped and (len(k.index_a) < AGAINST or of[k.a, k.b] in kept)
        ]

    def _adjusted(self, photo: int) -> bool:
        """Whether a photo stands where an adjustment put it."""
        member = self.members.by_id[photo]
        return member.pose is not None and member.state != "placed"

    def _strays(self, moved: Mapping[int, Pose]) -> bool:
        """Whether one photo makes others leave the poses in which they were adjusted before, with
        more neighbours than it brings.
        """
        for i, pose in moved.items():
            stood = self.members.by_id[i].pose
            if stood is None or not self._adjusted(i):
                continue
            high = max(float(stood.map_C[2]) - self.metadata.ground_at(stood.map_C), 1.0)
            away = float(np.linalg.norm(pose.map_C - stood.map_C))
            turned = axes_apart_deg(pose.cam_R_map, stood.cam_R_map)
            if away > STRAY_HIGH * high or turned > STRAY_DEG:
                return True
        return False

    def window(
        self, member: Member, ids: Sequence[int], held: frozenset[int], more: Sequence[Link]
    ) -> Window:
        """The local adjustment of these photos; `more`: links that are not stored yet."""
        where = {i: k for k, i in enumerate(ids)}
        members = [self.members.by_id[i] for i in ids]
        known = {(k.a, k.b) for k in more}
        free = set(ids) - held  # links between two held photos have no effect
        links = [
            *(k for k in self.live_links.links_among(ids, free) if (k.a, k.b) not in known),
            *more,
        ]
        placed = {where[m.id]: m.pose for m in members if m.pose is not None and m.id != member.id}
        cameras: dict[str, Camera] = {}
        for m in members:
            cameras[m.photo.camera_key] = self.members.cameras.get(
                m.photo.camera_key
            ) or self.members.camera(m)
            if m.camera:
                cameras[m.camera] = self.members.camera(m)
        at = (
            member.pose.map_C
            if member.pose is not None
            else members[0].pose.map_C
            if members[0].pose
            else np.zeros(3)
        )
        return Window(
            photos=[m.photo for m in members],
            priors=[m.prior for m in members],
            features=[self.live_links.features(i) for i in ids],
            links=[_renumbered(k, where) for k in links],
            poses=placed,
            cameras=cameras,
            camera_of={where[m.id]: m.camera for m in members},
            new=where[member.id],
            held=frozenset(where[i] for i in held),
            ground=self.metadata.ground_at(at),
            sigma_xy=self.metadata.scatter(),
        )


def _unmoved(links: dict[tuple[int, int], Link | None], reason: str) -> Change:
    """No pose, and why."""
    return Change(
        moved={}, cameras={}, camera_of={}, links=links, xyz=np.zeros((0, 3)), reason=reason
    )


def _renumbered(link: Link, where: dict[int, int]) -> Link:
    return Link(
        a=where[link.a],
        b=where[link.b],
        index_a=link.index_a,
        index_b=link.index_b,
        b_S_a=link.b_S_a,
    )
