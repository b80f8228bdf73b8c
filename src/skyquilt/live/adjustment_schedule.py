"""When a block, or a large part of one, is adjusted as a whole."""

import time
from collections import deque
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from skyquilt.live.background_adjustment import AdjustmentJob
from skyquilt.live.ledger import Ledger
from skyquilt.live.members import Members
from skyquilt.live.settings import CLOSING, GROWTH, PART, SWEEPING, LiveSettings
from skyquilt.model.camera import Camera
from skyquilt.workflows.methods import Methods

QUIET_S = 2.0
"""Without a new photo for so long, a block is bundled however little it has grown."""
KEY = "schedule"


@dataclass(kw_only=True)
class Schedule:
    """What it is decided by: written down with whatever changes it, so that a restart decides the
    same.
    """

    closed_at: dict[int, int] = field(default_factory=dict)
    """Photos that a block had when it was last adjusted as a whole, by its name."""
    since: int = 0
    """Photos refined since."""
    loop: int | None = None
    """A photo that closed a loop which nothing has adjusted yet."""
    checked: bool = True
    """Whether it has been decided on since the last photo was refined; where work is deterministic.
    """
    under_way: dict[str, Any] | None = None
    """What this was when the job in the background began: it counts as not done until its outcome
    is taken over.
    """

    @classmethod
    def read(cls, ledger: Ledger) -> "Schedule":
        """As it was written last."""
        found = ledger.meta(KEY) or {}
        closed = {int(k): int(v) for k, v in found.get("closed_at", {}).items()}
        return cls(
            closed_at=closed,
            since=int(found.get("since", 0)),
            loop=found.get("loop"),
            checked=bool(found.get("checked", True)),
        )

    def write(self, ledger: Ledger) -> None:
        """Writes it down (inside a transaction)."""
        record = asdict(self)
        began = record.pop("under_way")
        if began is not None:
            record["since"] += began["since"]
            record["loop"] = record["loop"] if record["loop"] is not None else began["loop"]
            record["closed_at"] = began["closed_at"]
        ledger.put_meta(KEY, record)

    def refined(self, photo: int, *, loop: bool) -> None:
        """A photo was refined; `loop`: its links close one."""
        self.since, self.checked = self.since + 1, False
        if loop:
            self.loop = photo

    def begun(self, block: int, size: int) -> None:
        """A job over a block of so many photos begins."""
        self.under_way = {"since": self.since, "loop": self.loop, "closed_at": dict(self.closed_at)}
        self.closed_at[block], self.since, self.loop = size, 0, None

    def ended(self) -> None:
        """Its outcome is about to be written."""
        self.under_way, self.checked = None, True


class Blocks:
    """Chooses the next job."""

    def __init__(
        self,
        members: Members,
        schedule: Schedule,
        settings: LiveSettings,
        folder: Path,
        store: Path,
        parts: Methods,
    ) -> None:
        self.members, self.schedule, self.settings = members, schedule, settings
        self.folder, self.store, self.methods = folder, store, parts
        self.last_arrival = time.monotonic()

    def due(self, ground: float, *, idle: bool) -> AdjustmentJob | None:
        """The block, or part of one, that should be adjusted as a whole now; `ground`: its height
        in m.
        """
        if not self.settings.reposition or self.schedule.since == 0:
            return None
        root = self._root()
        block = self.members.block(root) if root in self.members.by_id else set[int]()
        name = self.members.block_of.get(root, root)
        quiet = idle and time.monotonic() - self.last_arrival > QUIET_S
        grown = len(block) >= GROWTH * self.schedule.closed_at.get(name, 2)
        if len(block) < 3 or not (grown or self.schedule.loop is not None or quiet):
            return None
        ids, held = sorted(block), frozenset[int]()
        if len(block) > CLOSING:
            if not idle and self.schedule.loop is None and self.schedule.since < PART // 4:
                return None
            ids, held = self._around(root)
        job = self._job(ids, held, ground, sweep=quiet and not held and len(ids) <= SWEEPING)
        if job is not None:
            self.schedule.begun(name, len(block))
        return job

    def _root(self) -> int:
        """A photo of the block: the one that closed a loop, else the newest of the block that has
        grown most.
        """
        if self.schedule.loop is not None:
            return self.schedule.loop
        closed = self.schedule.closed_at
        grown = max(
            self.members.blocks.items(),
            key=lambda b: (len(b[1]) / closed.get(b[0], 2), len(b[1]), -b[0]),
            default=(0, {0}),
        )
        return max(grown[1])

    def _around(self, root: int) -> tuple[list[int], frozenset[int]]:
        """The photos nearest along links, and the ring of those beyond, which are held."""
        reached: dict[int, None] = {root: None}
        queue = deque([root])
        while queue and len(reached) < 2 * PART:
            for j in sorted(self.members.by_id[queue.popleft()].links):
                if j not in reached and self.members.by_id[j].pose is not None:
                    reached[j] = None
                    queue.append(j)
        ids = list(reached)
        return sorted(ids), frozenset(ids[PART:])

    def _job(
        self, ids: list[int], held: frozenset[int], ground: float, *, sweep: bool
    ) -> AdjustmentJob | None:
        members = [self.members.by_id[i] for i in ids]
        frame = self.members.frame
        if frame is None:
            return None
        cameras: dict[str, Camera] = {}
        for m in members:
            cameras[m.camera or m.photo.camera_key] = self.members.camera(m)
        return AdjustmentJob(
            ids=tuple(ids),
            held=held,
            photos=tuple(m.photo for m in members),
            priors=tuple(m.prior for m in members),
            frame=frame,
            poses={m.id: m.pose for m in members if m.pose is not None},
            cameras=cameras,
            camera_of={m.id: m.camera or m.photo.camera_key for m in members},
            ground=ground,
            folder=self.folder,
            store=self.store,
            methods=self.methods,
            sweep=sweep,
        )
