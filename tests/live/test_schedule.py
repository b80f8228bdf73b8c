"""Which block is adjusted as a whole next."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.live.adjustment_schedule import QUIET_S, Blocks, Schedule
from skyquilt.live.apply_adjustment import ApplyAdjustment
from skyquilt.live.background_adjustment import BlockAdjustment
from skyquilt.live.settings import CLOSING, GROWTH, PART, SWEEPING, WHOLE, YOUNG, LiveSettings
from skyquilt.model.poses import Pose
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.methods import methods_for


def blocks_of(*sizes, closed=(), since=1, loop=None, waiting=0):
    """Blocks of so many photos, each a chain, and what `due` would work on: (photos, held). Those
    of the last `waiting` blocks are not on the map.
    """
    sets, by_id, first = {}, {}, 1
    for size in sizes:
        sets[first] = set(range(first, first + size))
        pose = None if len(sets) > len(sizes) - waiting else object()
        for i in sets[first]:
            by_id[i] = SimpleNamespace(links={i - 1, i + 1} & sets[first], pose=pose)
        first += size
    block_of = {i: name for name, ids in sets.items() for i in ids}
    members = SimpleNamespace(
        blocks=sets, by_id=by_id, block_of=block_of, block=lambda i: sets[block_of[i]]
    )
    schedule = Schedule(closed_at=dict(zip(sets, closed, strict=False)), since=since, loop=loop)
    parts = methods_for(MosaicSettings())
    blocks = Blocks(members, schedule, LiveSettings(), Path(), Path(), parts)
    blocks._job = lambda ids, held, ground, **how: (ids, held)
    return blocks


def test_every_block_is_bundled_as_it_grows_not_only_the_largest():
    blocks = blocks_of(13, 12, 7, closed=(10, 9, 6))
    ids, held = blocks.due(0.0, idle=False)
    assert (
        ids == list(range(14, 26)) and not held
    )  # grown by 12 / 9; the largest by 13 / 10, just as due
    assert blocks.schedule.closed_at == {1: 10, 14: 12, 26: 6}
    blocks.schedule.since = 1
    assert blocks.due(0.0, idle=False)[0] == list(range(1, 14))
    blocks.schedule.since = 1
    assert blocks.due(0.0, idle=False) is None  # 7 photos where there were 6
    assert 7 / 6 < GROWTH


def test_when_no_photos_arrive_all_blocks_are_adjusted_thoroughly_once():
    blocks = blocks_of(13, 12, SWEEPING + 1, 2, closed=(10, 12, SWEEPING + 1))
    asked = []
    blocks._job = lambda ids, held, ground, thorough, sweep: (
        asked.append((min(ids), thorough, sweep)) or (ids, held)
    )
    assert blocks.due(0.0, idle=False)[0] == list(range(1, 14))  # it has grown
    assert blocks.due(0.0, idle=True) is None  # photos have just arrived
    blocks.last_arrival -= QUIET_S + 1
    while blocks.due(0.0, idle=True) is not None:
        pass
    assert asked == [(1, False, False), (1, True, True), (14, True, True), (26, True, False)]
    blocks.schedule.thorough_at.clear()
    blocks.schedule.given_up({k: len(v) for k, v in blocks.members.blocks.items()})
    assert blocks.due(0.0, idle=True) is None


def test_what_was_thorough_is_known_after_a_restart_but_not_what_was_under_way():
    kept = {}
    ledger = SimpleNamespace(meta=kept.get, put_meta=kept.__setitem__)
    schedule = Schedule.read(ledger)
    schedule.begun(1, 13, thorough=True)
    schedule.ended()
    schedule.begun(14, 12, thorough=True)
    schedule.write(ledger)
    assert Schedule.read(ledger).thorough_at == {1: 13}


def test_small_blocks_are_adjusted_with_every_photo_and_wait_for_quiet():
    blocks = blocks_of(YOUNG, closed=(3,))
    assert blocks.due(0.0, idle=False) is None
    blocks.last_arrival -= QUIET_S + 1
    assert blocks.due(0.0, idle=False) is None
    assert blocks.due(0.0, idle=True)[0] == list(range(1, YOUNG + 1))
    larger = blocks_of(YOUNG, YOUNG + 1, closed=(3, 5))  # the smaller one has grown more
    assert larger.due(0.0, idle=False)[0] == list(range(YOUNG + 1, 2 * YOUNG + 2))


def test_blocks_of_which_no_photo_is_on_the_map_are_not_adjusted():
    blocks = blocks_of(14, 19, closed=(3,), waiting=1)
    assert blocks.due(0.0, idle=False)[0] == list(range(1, 15))
    blocks.last_arrival -= QUIET_S + 1
    assert blocks.due(0.0, idle=True)[0] == list(range(1, 15))
    assert blocks.due(0.0, idle=True) is None


@pytest.mark.parametrize(
    ("size", "closed", "in_part"),
    [
        (CLOSING, 100, False),
        (CLOSING + 1, 100, False),
        (CLOSING + 1, CLOSING, True),  # a loop is closed, and it has hardly grown
        (WHOLE, CLOSING, False),
        (WHOLE + 1, 100, True),
    ],
)
def test_of_a_large_block_a_part_is_adjusted_around_its_newest_photo(size, closed, in_part):
    loop = size if size == CLOSING + 1 else None
    blocks = blocks_of(size, closed=(closed,), since=PART, loop=loop)
    ids, held = blocks.due(0.0, idle=False)
    moving = set(ids) - held
    if in_part:
        assert len(moving) == PART and size in moving and max(held) == size - PART
    else:
        assert ids == list(range(1, size + 1)) and not held
    whole_later = in_part and size <= WHOLE
    assert blocks.schedule.closed_at == {1: closed if whole_later else size}


def test_a_large_block_is_adjusted_as_a_whole_once_when_photos_pause():
    blocks = blocks_of(CLOSING + 1, closed=(CLOSING,), since=0)
    now = blocks.last_arrival
    blocks._gaps.extend([5.0] * 9)  # photos that arrive every 5 s
    blocks.last_arrival = now - QUIET_S - 1
    assert blocks.due(0.0, idle=True) is None
    blocks.last_arrival = now - 16.0
    assert blocks.due(0.0, idle=True) == (list(range(1, CLOSING + 2)), frozenset())
    assert blocks.due(0.0, idle=True) is None
    large = blocks_of(WHOLE + 1, closed=(CLOSING,), since=0)
    large.last_arrival = -1e9
    assert large.due(0.0, idle=True) is None


def test_a_loop_comes_first():
    blocks = blocks_of(13, 12, closed=(13, 3), loop=5)
    assert blocks.due(0.0, idle=False)[0] == list(range(1, 14))
    assert blocks.schedule.loop is None


@pytest.mark.parametrize(
    ("since", "cell", "block", "dropped"),
    [
        ("none", 2.0, 3, False),
        ("one", 2.0, 3, False),
        ("all", 2.0, 3, True),
        ("all", 20.0, 3, False),
        ("all", 20.0, 4, True),  # it would be adjusted again at once
        ("all", 20.0, YOUNG + 1, True),
        ("one", 20.0, YOUNG + 1, False),
    ],
)
def test_what_was_adjusted_anew_in_the_meantime_is_not_put_back(since, cell, block, dropped):
    """A job on three photos ends when so many have been adjusted together: it would move them by
    4 m.
    """

    def pose(x):
        return Pose(cam_R_map=np.diag([1.0, -1.0, -1.0]), map_C=np.array([x, 0.0, 50.0]))

    before = {i: pose(10.0 * i) for i in (1, 2, 3)}
    now = {"none": (), "one": (2,), "all": (1, 2, 3)}[since]
    by_id = {i: SimpleNamespace(pose=pose(10.0 * i + (i in now))) for i in before}
    by_id |= {i: SimpleNamespace(pose=None, links=()) for i in range(4, block + 1)}
    done = BlockAdjustment(
        ids=(1, 2, 3),
        poses={i: pose(10.0 * i + 5) for i in before},
        cameras={},
        camera_of={},
        xyz=np.zeros((0, 3)),
        before=before,
    )
    stored = []
    schedule = Schedule(since=4)
    schedule.begun(1, 3, thorough=False)
    refinement = SimpleNamespace(
        members=SimpleNamespace(
            by_id=by_id, block=lambda i: set(range(1, block + 1)), save_cameras=lambda cameras: None
        ),
        ledger=SimpleNamespace(change=nullcontext, put_meta=lambda *a: None, tell=lambda *a: None),
        schedule=schedule,
        local_pose=SimpleNamespace(metadata=SimpleNamespace(heights=SimpleNamespace(cell=cell))),
        redraw=None,
        queues=None,
        heights=lambda *a, **k: None,
        move=lambda poses, camera_of: stored.append(poses),
        put_back=lambda rejected: None,
    )
    update = ApplyAdjustment(refinement).apply(done)
    assert bool(stored) != dropped
    assert update.what == ("noted" if dropped else "closed")
    assert schedule.under_way is None
