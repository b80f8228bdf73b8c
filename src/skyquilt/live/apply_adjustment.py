"""Applies the result of a block adjustment to the map."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from skyquilt.live.background_adjustment import BlockAdjustment
from skyquilt.live.events import Update
from skyquilt.live.ledger import hit
from skyquilt.live.members import Member, about_record
from skyquilt.live.refinement import Refinement
from skyquilt.live.settings import CLOSING, YOUNG
from skyquilt.model.poses import Pose

OUTDATED = 0.5
"""Cells of heights by which a result lies elsewhere than its photos do now."""
OUTGROWN = 2.0
"""A result tells less than its photos do now where their block has so many times as many."""

FEWEST_TOLD, TOLD = 10, "adjustments told"
"""Photos of a block from which the warnings of its adjustments are told, as those of fewer soon
change; and the name in the ledger of what was told.
"""
VALUES = r"[0-9][0-9.]*(e\+?[0-9]+)?|\([^()]*\)"
"""What differs between warnings that are the same: figures, names of photos."""


class ApplyAdjustment:
    """Stores the new poses of a block. Photos that were placed during the job turn and move with
    their neighbours and are refined again.
    """

    def __init__(self, refinement: Refinement) -> None:
        self.refinement, self.members, self.ledger = (
            refinement,
            refinement.members,
            refinement.ledger,
        )
        self.schedule, self.redraw, self.queues = (
            refinement.schedule,
            refinement.redraw,
            refinement.queues,
        )

    def apply(self, done: BlockAdjustment) -> Update:
        """Applies the result in one transaction, unless it is out of date."""
        if not done.poses:
            return self._failed(done.problem)
        if self._outdated(done):
            return self._failed("all of it has been adjusted with more photos since")
        moved = {
            i: (old, new)
            for i, new in done.poses.items()
            if (old := self.members.by_id[i].pose) is not None
        }
        since = self._since(done)
        text = f"{len(done.poses)} photos were adjusted together"
        self.schedule.ended()
        with self.ledger.change():
            self.members.save_cameras(done.cameras)
            self.refinement.heights(done.xyz, done.poses, known=bool(done.cameras), together=True)
            self.refinement.move(done.poses, done.camera_of)
            self.refinement.put_back(self._left(done))
            self._follow(since, moved)
            self.schedule.write(self.ledger)
            self.ledger.tell("note", {"text": text})
            if len(done.ids) >= FEWEST_TOLD:
                self.ledger.tell_new(done.notes, TOLD, VALUES)
        hit("block closed")
        for i in self.redraw.canvas.level(done.exposure) if done.exposure.gains else ():
            self.redraw.altered(self.members.by_id[i])
        if done.cameras:  # heights and calibrations changed: redraw the whole block
            self._show(done)
        return Update(what="closed", moved=tuple(done.poses), text=text)

    def _outdated(self, done: BlockAdjustment) -> bool:
        """Whether all its photos have been adjusted since the job began, together with others that
        it did not know, and lie elsewhere now, or rest on far more than the job had. In a block
        that is adjusted with every photo, those that joined would move all of them again at once.
        """
        now = [self.members.by_id[i].pose for i in done.poses]
        if not all(_differs(p, done.before.get(i)) for i, p in zip(done.poses, now, strict=True)):
            return False
        had, has = len(done.ids), len(self.members.block(next(iter(done.poses))))
        if has > had and (has <= YOUNG or has > OUTGROWN * had):
            return True
        off = [
            np.linalg.norm(p.map_C - new.map_C)
            for new, p in zip(done.poses.values(), now, strict=True)
            if p is not None
        ]
        cell = self.refinement.local_pose.metadata.heights.cell
        return bool(off) and float(np.median(off)) > OUTDATED * cell

    def _left(self, done: BlockAdjustment) -> dict[int, str]:
        """Photos that the job could not hold, and that nothing has moved since it began."""
        return {
            i: why
            for i, why in done.rejected.items()
            if not _differs(self.members.by_id[i].pose, done.before.get(i))
        }

    def _failed(self, problem: str) -> Update:
        self.schedule.ended()
        with self.ledger.change():
            self.schedule.write(self.ledger)
        return Update(what="noted", text=f"a block could not be adjusted as a whole: {problem}")

    def _since(self, done: BlockAdjustment) -> list[Member]:
        """Photos that have joined the block since the job began; none where that was one on a part
        of a large block.
        """
        block = self.members.block(next(iter(done.poses)))
        if len(block) > CLOSING and not done.cameras:
            return []
        return [self.members.by_id[i] for i in sorted(block - set(done.ids))]

    def _show(self, done: BlockAdjustment) -> None:
        for i in done.poses:
            if self.members.by_id[i].state == "refined":
                self.redraw.changed(self.members.by_id[i])

    def _follow(self, since: list[Member], moved: dict[int, tuple[Pose, Pose]]) -> None:
        """Carries photos along with those that they are linked with, or that are themselves carried
        along; `moved`: former and new poses. On a line, those placed last are linked with others
        that came since alone, and would stay behind.
        """
        known, left = dict(moved), [m for m in since if m.pose is not None]
        while left:
            near = {m.id: [known[j] for j in sorted(m.links) if j in known] for m in left}
            now = {
                m.id: (m.pose, carried(m.pose, near[m.id])) for m in left if m.pose and near[m.id]
            }
            if not now:
                return
            known |= now
            for member in left:
                if member.id in now:
                    self._try_again(member, now[member.id][1])
            left = [m for m in left if m.id not in now]

    def _try_again(self, member: Member, pose: Pose) -> None:
        """Moves a photo, and refines it again."""
        self.refinement.move({member.id: pose}, {member.id: member.camera})
        if member not in self.queues.untried:
            member.tried = 0
            self.members.save(member, about=about_record(member, ""))
            self.queues.untried.append(member)


def carried(pose: Pose, near: Sequence[tuple[Pose, Pose]]) -> Pose:
    """A pose that turns and moves as some others have, by their former and new poses."""
    turns = np.array([new.cam_R_map.T @ old.cam_R_map for old, new in near])
    turn = Rotation.from_matrix(turns).mean().as_matrix()
    places = [new.map_C + turn @ (pose.map_C - old.map_C) for old, new in near]
    return replace(pose, cam_R_map=pose.cam_R_map @ turn.T, map_C=np.median(places, axis=0))


def _differs(pose: Pose | None, before: Pose | None) -> bool:
    if pose is None or before is None:
        return pose is not before
    return not (
        np.array_equal(pose.map_C, before.map_C)
        and np.array_equal(pose.cam_R_map, before.cam_R_map)
    )
