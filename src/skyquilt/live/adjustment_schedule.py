"""Decides when a block of photos, or a large part of one, is adjusted as a whole."""

import time
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from skyquilt.live.background_adjustment import AdjustmentJob
from skyquilt.live.ledger import Ledger
from skyquilt.live.members import Members
from skyquilt.live.settings import CLOSING, GROWTH, PART, SWEEPING, WHOLE, YOUNG, LiveSettings
from skyquilt.model.camera import Camera
from skyquilt.workflows.methods import Methods

QUIET_S = 2.0
"""If no photo has arrived for this long, a block is adjusted even if it has grown little."""
PAUSE, LONGEST_PAUSE_S = 3.0, 30.0
"""A large block is, as a whole, if none has for so many times as long as is usual between photos,
or for the second.
"""
KEY = "schedule"


@dataclass(kw_only=True)
class Schedule:
    """The state on which the decision depends. It is stored in the same transaction as each change
    to it, so that a restart decides the same.
    """

    closed_at: dict[int, int] = field(default_factory=dict)
    """Number of photos that each block had when it was last adjusted as a whole, by block name."""
    thorough_at: dict[int, int] = field(default_factory=dict)
    """The same of the last time when no photos arrived, so that it was adjusted thoroughly."""
    since: int = 0
    """Number of photos refined since a block was last adjusted."""
    loop: int | None = None
    """A photo that closed a loop which has not been adjusted yet."""
    checked: bool = True
    """Whether a decision was made since the last photo was refined. Used in deterministic mode
    only.
    """
    under_way: dict[str, Any] | None = None
    """Copy of this state from the start of the background job. After a restart it is used again,
    since the job counts as not done until its result is applied.
    """

    @classmethod
    def read(cls, ledger: Ledger) -> "Schedule":
        """Reads the state that was last stored."""
        found = ledger.meta(KEY) or {}
        closed, thorough = (
            {int(k): int(v) for k, v in found.get(key, {}).items()}
            for key in ("closed_at", "thorough_at")
        )
        return cls(
            closed_at=closed,
            thorough_at=thorough,
            since=int(found.get("since", 0)),
            loop=found.get("loop"),
            checked=bool(found.get("checked", True)),
        )

    def write(self, ledger: Ledger) -> None:
        """Stores the state (inside a transaction)."""
        record = asdict(self)
        began = record.pop("under_way")
        if began is not None:
            record["since"] += began["since"]
            record["loop"] = record["loop"] if record["loop"] is not None else began["loop"]
            for key in ("closed_at", "thorough_at"):
                record[key] = began[key]
        ledger.put_meta(KEY, record)

    def refined(self, photo: int, *, loop: bool) -> None:
        """Notes that a photo was refined; `loop`: whether its links close a loop."""
        self.since, self.checked = self.since + 1, False
        if loop:
            self.loop = photo

    def begun(self, block: int, size: int, *, thorough: bool, part: bool = False) -> None:
        """Notes that a job begins on a block of `size` photos; `part`: on a part of it, and it will
        be adjusted as a whole later.
        """
        before = {"closed_at": dict(self.closed_at), "thorough_at": dict(self.thorough_at)}
        self.under_way = {"since": self.since, "loop": self.loop, **before}
        self.since, self.loop = 0, None
        if not part:
            self.closed_at[block] = size
        if thorough:
            self.thorough_at[block] = size

    def given_up(self, sizes: Mapping[int, int]) -> None:
        """Notes that nothing is due on blocks of these sizes until the next photo."""
        self.closed_at, self.thorough_at = dict(sizes), dict(sizes)
        self.since, self.loop = 0, None

    def ended(self) -> None:
        """Notes that the result of the job is about to be stored."""
        self.under_way, self.checked = None, True


class Blocks:
    """Chooses the next adjustment job."""

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
        self._gaps: deque[float] = deque(maxlen=15)

    def arrived(self) -> None:
        """Notes that a photo arrives."""
        now = time.monotonic()
        self._gaps.append(now - self.last_arrival)
        self.last_arrival = now

    @property
    def quiet(self) -> bool:
        """Whether no photo has arrived for a while."""
        return time.monotonic() - self.last_arrival > QUIET_S

    @property
    def paused(self) -> bool:
        """Whether none has for long, as photos arrive."""
        usual = sorted(self._gaps)[len(self._gaps) // 2] if self._gaps else 0.0
        pause = min(max(QUIET_S, PAUSE * usual), LONGEST_PAUSE_S)
        return time.monotonic() - self.last_arrival > pause

    def due(self, ground: float, *, idle: bool) -> AdjustmentJob | None:
        """The block, or part of a block, that should be adjusted as a whole now; None where none is
        due. `ground`: height of the ground in m.
        """
        quiet, paused = idle and self.quiet, idle and self.paused
        if not self.settings.reposition or not (quiet or self.schedule.since):
            return None
        thorough = quiet or self.settings.deterministic
        # smaller ones were adjusted so with the newest of their photos
        least = 3 if thorough else YOUNG + 1
        root = self._root(least) if self.schedule.since else self._unfinished(paused)
        block = self.members.block(root) if root in self.members.by_id else set[int]()
        name = self.members.block_of.get(root, root)
        grown = len(block) >= GROWTH * self.schedule.closed_at.get(name, 2)
        if len(block) < least or not (grown or self.schedule.loop is not None or quiet):
            return None
        ids, held = sorted(block), frozenset[int]()
        large = len(block) > WHOLE or (len(block) > CLOSING and not (grown or paused))
        if large:
            if not idle and self.schedule.loop is None and self.schedule.since < PART // 4:
                return None
            ids, held = self._around(root)
        sweep = quiet and not held and len(ids) <= SWEEPING
        job = self._job(ids, held, ground, thorough=thorough, sweep=sweep)
        if job is not None:
            part = large and len(block) <= WHOLE
            self.schedule.begun(name, len(block), thorough=quiet and not held, part=part)
        return job

    def _root(self, least: int) -> int:
        """A photo of the block to adjust: the one that closed a loop, otherwise the newest photo of
        the block that has grown most, of those with at least so many photos; 0 where there is none.
        """
        if self.schedule.loop is not None:
            return self.schedule.loop
        closed = self.schedule.closed_at
        grown = max(
            (b for b in self._on_map() if len(b[1]) >= least),
            key=lambda b: (len(b[1]) / closed.get(b[0], 2), len(b[1]), -b[0]),
            default=(0, {0}),
        )
        return max(grown[1])

    def _on_map(self) -> list[tuple[int, set[int]]]:
        """Names and photos of the blocks that have a photo on the map. Nothing tells where the
        others belong.
        """
        known = self.members.by_id
        return [
            (name, block)
            for name, block in self.members.blocks.items()
            if any(known[i].pose is not None for i in block)
        ]

    def _unfinished(self, paused: bool) -> int:
        """The newest photo of a block that was not adjusted thoroughly as it is now; 0 where there
        is none. Large blocks only count where photos pause; those beyond are adjusted in parts as
        they grow.
        """
        most = WHOLE if paused else CLOSING
        for name, block in self._on_map():
            size = len(block)
            if 3 <= size <= most and self.schedule.thorough_at.get(name) != size:
                return max(block)
        return 0

    def _around(self, root: int) -> tuple[list[int], frozenset[int]]:
        """The photos that can be reached by the fewest links, and the ring of photos around them,
        which are held fixed.
        """
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
        self, ids: list[int], held: frozenset[int], ground: float, *, thorough: bool, sweep: bool
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
            thorough=thorough,
            sweep=sweep,
            most_view_deg=self.settings.max_view_angle,
        )
