"""The second step for a photo: it is linked to its neighbours and its pose is refined."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.determined import STATED_DEG
from skyquilt.alignment.oblique import FAR_OFF, tilt_deg, turned_deg
from skyquilt.geometry.neighbours import nearest
from skyquilt.live.adjustment_schedule import Schedule
from skyquilt.live.blur import LiveBlur
from skyquilt.live.events import MapEvents, Update
from skyquilt.live.ledger import hit
from skyquilt.live.links import link_bytes
from skyquilt.live.local_pose import Change, LocalPose
from skyquilt.live.loose import is_loose
from skyquilt.live.members import GROUNDED, Member, Queues, about_record
from skyquilt.live.redraw_queue import RedrawQueue
from skyquilt.live.settings import WHOLE
from skyquilt.live.thermal_notes import ThermalNotes
from skyquilt.live.veils import LiveVeils
from skyquilt.model.features import Link
from skyquilt.model.poses import Pose
from skyquilt.ortho.tie_surface import without_outliers

LOOP = 12
"""A new link closes a loop if its photos were more than this number of links apart."""
MOST_ASIDE, LEAST_BELOW, MOST_BELOW = 4.0, 0.1, 5.0
"""Ground lies this far beside the nearest photo at most, and this far below it at least and at
most, all in flying heights.
"""
ASIDE_DEG = 15.0
"""Tilt of a photo that looks aside: the photos nearest to one are not those that show the same."""
MOST_COMPARED = 24
"""Number of others with which a photo was compared, from which it is taken to match none."""
LOST = 2
"""Number of photos without links, those that came next before or after it, with which a refined
photo is compared.
"""


class Refinement:
    """Refines a photo and stores all its changes in one transaction: links, poses, heights, learned
    corrections and the adjustment schedule.
    """

    def __init__(
        self,
        local_pose: LocalPose,
        redraw: RedrawQueue,
        map_events: MapEvents,
        queues: Queues,
        schedule: Schedule,
        blur: LiveBlur,
        veils: LiveVeils,
    ) -> None:
        self.local_pose, self.redraw, self.map_events = local_pose, redraw, map_events
        self.queues, self.schedule = queues, schedule
        self.members, self.ledger = local_pose.members, local_pose.members.ledger
        self.blur, self.veils = blur, veils
        self.thermal_notes = ThermalNotes(blur.live_links)
        self._pairs = self._apart()
        self._rejoining: dict[int, dict[tuple[int, int], Link | None]] = {}
        self._tried = max((m.tried for m in self.members.by_id.values()), default=0)

    def refine(self, member: Member) -> Update:
        """Refines the photo, which is in the queue of photos to be compared."""
        if member.state == "superseded":
            self.queues.untried.remove(member)
            return Update(what="noted", photo=member.id)
        change = self.local_pose.refine(member, self._rejoining.pop(member.id, {}))
        found = self._found(member, change)
        turned = self._commit(member, change, found)
        if member.id in self.redraw.held:  # it is linked with none: by its metadata then
            self.redraw.show(member)
        elif turned:
            self.redraw.moved(member)
        self.queues.untried.remove(member)
        self._requeue(member, found)
        alone = "waiting" if self.members.frame is None else "loose"
        return Update(
            what="refined" if member.state == "refined" else alone,
            photo=member.id,
            moved=tuple(change.moved),
            text=change.reason,
        )

    def _commit(self, member: Member, change: Change, found: list[Member]) -> bool:
        """Stores what was found; returns whether the photo, linked with none and without a heading,
        stands otherwise by what those before it tell of the direction of flight.
        """
        far = self._distance(member, change) > LOOP
        for a, b in (key for key, k in change.links.items() if k is not None):
            self.members.joined(a, b)
        self._tried += 1
        with self.ledger.change():
            links = [
                (a, b, None if k is None else link_bytes(k)) for (a, b), k in change.links.items()
            ]
            self.ledger.put_links(links)
            self.members.save_cameras(change.cameras)
            member.tried = self._tried
            whole = bool(change.cameras)
            ground = without_outliers(change.xyz)
            self.heights(ground, change.moved, known=whole, together=whole)
            self.move(change.moved, change.camera_of)
            self.put_back(change.rejected)
            if member.state == "refined":
                self._learn(member, loop=far)
            turned = member.state == "placed" and self._headed(member)
            why = change.reason
            if why and member.state == "waiting" and self.members.on_ground(member):
                why = GROUNDED
            if why and (note := self.members.far_note(member.photo)):
                why = f"{why}; {note}"
            self.members.save(member, about=about_record(member, why), reason=why)
            for lost in found:
                self._again(lost)
            self.schedule.write(self.ledger)
            self.map_events.photo(member, reason=why)
            altered = {m.id: m for m in (*self.blur.look(member), *self.veils.look(member))}
            altered |= {member.id: member} if is_loose(member) else {}
            self.thermal_notes.look(member)
        hit("photo refined")
        for other in altered.values():
            self.redraw.altered(other)
        self.local_pose.neighbours.indexed(member)
        return turned

    def _headed(self, member: Member) -> bool:
        """Gives a photo that reports no heading the one by the direction of flight; whether that is
        another one.
        """
        if np.isfinite(member.prior.yaw_deg) or member.pose is None:
            return False
        pose = self.local_pose.metadata.first(member)
        if pose is None or np.allclose(pose.cam_R_map, member.pose.cam_R_map):
            return False
        member.pose = pose
        return True

    def _learn(self, member: Member, *, loop: bool) -> None:
        self.local_pose.metadata.learn(member)
        self.schedule.refined(member.id, loop=loop)

    def _again(self, lost: Member) -> None:
        """Stores that a photo is to be compared again."""
        lost.tried, lost.again = 0, self._tried
        self.members.save(lost, about=about_record(lost, ""))

    def begun_with(self, poses: dict[int, Pose], camera_of: dict[int, str]) -> list[Member]:
        """Stores the poses of the photos with which a map without a place begins (inside a
        transaction); those that are linked with them are compared again, see `take_back`.
        """
        for i, pose in poses.items():
            member = self.members.by_id[i]
            member.pose, member.camera, member.state = pose, camera_of[i], "refined"
            self._learn(member, loop=False)
            self.members.save(member, about=about_record(member, ""), reason="")
            self.map_events.photo(member)
        linked = {j for i in poses for j in self.members.by_id[i].links} - poses.keys()
        found = [m for m in self.queues.lost if m.id in linked]
        for lost in found:
            self._again(lost)
        self.schedule.write(self.ledger)
        return found

    def take_back(self, found: Iterable[Member]) -> None:
        """Puts photos that `begun_with` returned back into the queue, and forgets those that found
        a pose.
        """
        for lost in found:
            self.queues.lost.remove(lost)
            self.queues.untried.append(lost)
        self.queues.lost = [m for m in self.queues.lost if m.state == "waiting"]

    def move(self, moved: dict[int, Pose], camera_of: dict[int, str]) -> None:
        """Stores new poses of photos (inside a transaction of the ledger)."""
        self._pairs = self._apart()
        for i, pose in moved.items():
            member = self.members.by_id[i]
            loose = is_loose(member)
            member.pose, member.camera = pose, camera_of.get(i, member.camera)
            if member.state != "superseded":
                member.state = "refined"
            self.members.save(member, reason="")
            self.local_pose.neighbours.indexed(member)
            if member.state == "refined":
                self.redraw.moved(member)
                if loose:
                    self.redraw.altered(member)

    def put_back(self, rejected: Mapping[int, str]) -> None:
        """Photos that an adjustment of their whole block could not hold hang on too little: they
        count as loose, so others are drawn in their place (inside a transaction). Those that lie
        or look elsewhere than they report stand where their metadata put them again: the pose that
        they had rests on matches or on a start that the others prove wrong. `rejected`: why each
        was not held.
        """
        for i, why in rejected.items():
            member = self.members.by_id[i]
            first = self.local_pose.metadata.first(member)
            if member.state != "refined" or member.pose is None or first is None:
                continue
            away = np.hypot(*(member.pose.map_C - first.map_C)[:2])
            if (
                turned_deg(member.pose, member.prior) > STATED_DEG
                or away > FAR_OFF * member.prior.sigma_C[0]
            ):
                member.pose = first
            member.state, member.learned = "placed", None
            self.members.save(member, about=about_record(member, why), reason=why)
            self.map_events.photo(member, reason=why)
            self.local_pose.neighbours.indexed(member)
            self.redraw.altered(member)

    def heights(
        self,
        xyz: NDArray[np.float64],
        poses: Mapping[int, Pose],
        *,
        known: bool,
        together: bool = False,
    ) -> None:
        """Adds ground points (P, 3) in m of photos with these poses to the height cells (inside a
        transaction, before the photos are moved); `known`: they come from calibrated cameras;
        `together`: from an adjustment that tells all ground of these photos anew; what was taken
        for ground before, by matches on a text for instance, does not refuse it.
        """
        xyz = on_ground(xyz, poses, None if together else self.redraw.canvas.ground)
        cells = self.local_pose.metadata.heights
        if together and len(xyz):
            touched, z = cells.renew(xyz, *self._ground_of(poses, float(np.median(xyz[:, 2]))))
        else:
            touched, z = cells.add(xyz)
        with self.ledger.change() as db:
            values = [
                (c, r, height) for (c, r), height in zip(touched.tolist(), z.tolist(), strict=True)
            ]
            gone = [v[:2] for v in values if np.isnan(v[2])]
            db.executemany("delete from height where col = ? and row = ?", gone)
            db.executemany(
                "insert or replace into height values (?, ?, ?)",
                [v for v in values if not np.isnan(v[2])],
            )
            if known and len(xyz):
                ground = float(np.median(xyz[:, 2]))
                self.ledger.put_meta("ground", ground)
                self.redraw.canvas.ground = ground

    def _ground_of(
        self, poses: Mapping[int, Pose], ground: float
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Cells (k, 2) with heights below photos that are about to get these poses, over ground at
        about this height in m, nearest to them of all photos on the map; and whether their photo
        moves sideways by more than a cell.
        """
        cells = self.local_pose.metadata.heights
        shown = [m for m in self.members.on_map() if m.pose is not None]
        C = np.array([m.pose.map_C for m in shown if m.pose is not None]).reshape(-1, 3)
        own = np.array([m.id in poses for m in shown], bool)
        if not own.any():
            return np.zeros((0, 2), np.int64), np.zeros(0, bool)
        high = max(float(np.median(C[own, 2])) - ground, 1.0)
        low, top = C[own, :2].min(0) - MOST_ASIDE * high, C[own, :2].max(0) + MOST_ASIDE * high
        places = cells.places((low[0], low[1], top[0], top[1]))
        if not len(places):
            return np.zeros((0, 2), np.int64), np.zeros(0, bool)
        moved = np.array(
            [
                np.hypot(*(poses[m.id].map_C - c)[:2]) if m.id in poses else 0.0
                for m, c in zip(shown, C, strict=True)
            ]
        )
        at = nearest(C[:, :2], places, 1)[1][:, 0]
        mine = own[at]
        found = np.floor(places[mine] / cells.cell).astype(np.int64)
        return found, moved[at[mine]] > cells.cell

    def _distance(self, member: Member, change: Change) -> int:
        """Number of stored links on the shortest path between the photos that this one is linked
        to; more than LOOP = it closes a loop.
        """
        ends = [
            i for key, k in change.links.items() if k is not None for i in key if i != member.id
        ]
        if len(ends) < 2:
            return 0
        known, rim = {ends[0]}, {ends[0]}
        for step in range(LOOP + 1):
            if set(ends) <= known:
                return step
            rim = {j for i in rim for j in self.members.by_id[i].links} - known
            known |= rim
        return LOOP + 1

    def _found(self, member: Member, change: Change) -> list[Member]:
        """Photos without a pose so far that match this one."""
        if member.id not in change.moved and member.pose is None:
            return []
        partners = {i for key, k in change.links.items() if k is not None for i in key}
        partners |= member.links
        lost = [m for m in self.queues.lost if m.photo.band == member.photo.band]
        linked = [m for m in lost if m.id in partners and m.id not in change.moved]
        others = sorted(
            (m for m in lost if m.id not in partners), key=lambda m: (abs(m.id - member.id), -m.id)
        )[:LOST]
        return [*linked, *(m for m in others if self._links(m, member))]

    def rejoined(self) -> Update | None:
        """Compares a photo outside the largest block with one of another block near it, or taken
        next to it, where no photos arrive: later photos were compared with those that were nearest
        only. Where they match, it waits to be refined again, by that link, too, or it would be
        found again and again. So is one that looks aside and does not tell where with those around
        it: the block is adjusted anew with such links. None where there is no such photo.
        """
        pair = next(self._pairs, None)
        if pair is None:
            return None
        member, other = pair
        links = self.local_pose.live_links.compared(member, [other])
        if other in self.members.block(member.id):
            self._held_firmer(member, links)
            return Update(what="noted", photo=member.id)
        with self.ledger.change():
            if any(links.values()):
                self._again(member)
            else:
                self.ledger.put_links([(a, b, None) for a, b in links])
        if any(links.values()):
            self._rejoining[member.id] = links
            self.queues.untried.append(member)
        return Update(what="noted", photo=member.id)

    def _held_firmer(self, member: Member, links: dict[tuple[int, int], Link | None]) -> None:
        """Stores further links of a photo within its block, which is then adjusted anew."""
        with self.ledger.change():
            self.ledger.put_links(
                [(a, b, None if k is None else link_bytes(k)) for (a, b), k in links.items()]
            )
            for a, b in (key for key, k in links.items() if k is not None):
                self.members.joined(a, b)
                self.schedule.refined(member.id, loop=False)
            self.schedule.write(self.ledger)

    def _apart(self) -> Iterator[tuple[Member, int]]:
        """Photos on the map outside its largest block, each with one of another block near it with
        which it was not compared, and those that look aside and do not tell where, with ones beside
        them; to the end as long as no photo moves.
        """
        yield from self._others_near()
        if not self.local_pose.settings.reposition:
            return
        for member in list(self.members.on_map()):
            aside = member.state == "refined" and member.prior.sigma_tilt_deg > STATED_DEG
            if not aside or member.pose is None or tilt_deg(member.pose.cam_R_map) < ASIDE_DEG:
                continue
            if len(self.members.block(member.id)) <= WHOLE:
                for i in self.local_pose.neighbours.beside(member):
                    yield member, i

    def _others_near(self) -> Iterator[tuple[Member, int]]:
        """The former of `_apart`."""
        more = True
        while more:
            more = False
            largest = max(self.members.blocks.values(), key=len, default=set[int]())
            for member in list(self.members.on_map()):
                if member.id in largest or member.pose is None or not member.tried:
                    continue
                if self.ledger.compared_with(member.id) < MOST_COMPARED:
                    near = self.local_pose.neighbours
                    for i in near.strangers(member, member.pose) or near.taken_next(member):
                        more = True
                        yield member, i

    def _links(self, lost: Member, member: Member) -> bool:
        return any(
            k is not None for k in self.local_pose.live_links.compared(lost, [member.id]).values()
        )

    def _requeue(self, member: Member, found: Iterable[Member]) -> None:
        for lost in found:
            self.queues.lost.remove(lost)
            self.queues.untried.append(lost)
        if member.state == "waiting":
            self.queues.lost.append(member)


def on_ground(
    xyz: NDArray[np.float64], poses: Mapping[int, Pose], ground: float | None
) -> NDArray[np.float64]:
    """Those of some points (P, 3) in m that can be ground under photos with these poses, over
    ground at about this height in m (None: as far below them as the points are in the median); all
    of them where there are no poses. Rays that hardly converge, of matches on a text in the
    pictures or towards a horizon, meet above the cameras or far below and beside them.
    """
    if not poses or not len(xyz):
        return xyz
    C = np.array([pose.map_C for pose in poses.values()])
    away, at = nearest(C[:, :2], xyz[:, :2], 1)
    below = C[at[:, 0], 2] - xyz[:, 2]
    if ground is None:
        high = float(np.median(below[below > 0])) if (below > 0).any() else 1.0
    else:
        high = max(float(np.median(C[:, 2])) - ground, 1.0)
    below = below / high
    near = (away[:, 0] < MOST_ASIDE * high) & (below > LEAST_BELOW) & (below < MOST_BELOW)
    return np.asarray(xyz[near])
