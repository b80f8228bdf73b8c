"""Results of adjustments of whole blocks: photos that they cannot hold, and their warnings."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.alignment.local_adjustment import AdjustedWindow
from skyquilt.geometry.frames import rotation_from_vector
from skyquilt.live import background_adjustment
from skyquilt.live.apply_adjustment import TOLD
from skyquilt.live.background_adjustment import BlockAdjustment
from skyquilt.live.live_map import LiveMap
from skyquilt.live.loose import is_loose
from skyquilt.live.settings import LiveSettings


@pytest.fixture(scope="module")
def four(flight, tmp_path_factory):
    """Four photos."""
    folder = tmp_path_factory.mktemp("live") / "out"
    live = LiveMap(folder, LiveSettings(features=600, deterministic=True))
    for path in flight.photos[:4]:
        live.add(path)
    yield live
    live.close()


@pytest.fixture
def live(four):
    """The same, as they stood before each test."""
    stood = [(m, m.pose, m.state, m.learned) for m in four.members.by_id.values()]
    yield four
    for member, pose, state, learned in stood:
        member.pose, member.state, member.learned = pose, state, learned


def turned(pose, degrees):
    R = rotation_from_vector(np.array([[np.radians(degrees), 0.0, 0.0]]))[0]
    return replace(pose, cam_R_map=R @ pose.cam_R_map)


def without(young, name):
    """An adjustment that does not hold a photo."""

    def adjusted(photos, *rest):
        done = young(photos, *rest)
        out = next(i for i, p in enumerate(photos) if p.name == name)
        poses = {i: p for i, p in done.poses.items() if i != out}
        return replace(done, poses=poses, rejected={out: "too few"})

    return adjusted


@pytest.mark.parametrize(("degrees", "back"), [(15.0, True), (0.0, False)])
def test_a_photo_that_looks_elsewhere_than_it_reports_goes_back(live, monkeypatch, degrees, back):
    """It kept the pose that it had from two photos, 19 degrees off, and counted as refined. Another
    keeps its pose, and yields to those that are held.
    """
    second, pose = live.members.by_id[2], live.refinement.local_pose
    second.pose = turned(second.pose, degrees)
    stood = second.pose
    monkeypatch.setattr(pose, "young", without(pose.young, second.photo.name))
    live.queues.untried.append(live.members.by_id[4])
    assert live.refinement.refine(live.members.by_id[4]).what == "refined"
    assert is_loose(second)
    kept = pose.metadata.first(second) if back else stood
    assert np.array_equal(second.pose.cam_R_map, kept.cam_R_map)
    stored = live.ledger.row("select state, reason from photo where id = 2")
    assert tuple(stored) == ("placed", "too few")


@pytest.mark.parametrize("since", [False, True])
def test_a_whole_adjustment_puts_back_what_nothing_has_moved_since(live, since):
    members, apply = live.members, live.apply_adjustment
    before = {i: turned(m.pose, 15.0) for i, m in members.by_id.items()}
    for i, m in members.by_id.items():
        m.pose = before[i]
    done = BlockAdjustment(
        ids=(1, 2, 3, 4),
        poses={i: before[i] for i in (1, 3, 4)},
        cameras={},
        camera_of={},
        xyz=np.zeros((0, 3)),
        before=before,
        rejected={2: "too few"},
    )
    if since:
        members.by_id[2].pose = turned(before[2], 1.0)
    apply.apply(done)
    assert members.by_id[2].state == ("refined" if since else "placed")


def test_neighbours_placed_by_their_metadata_move_and_hold_nothing(live, monkeypatch):
    local, members = live.refinement.local_pose, live.members
    members.by_id[1].state = "placed"
    asked = []

    def stop(window):
        asked.append(window)
        return SimpleNamespace(reason="that is enough")

    monkeypatch.setattr(local, "adjust_locally", stop)
    good = {(i, 4): local.live_links.link(i, 4) for i in (1, 2, 3)}
    local._adjusted_locally(members.by_id[4], dict(good), good)
    names = [p.name for p in asked[0].photos]
    first = members.by_id[1].photo.name
    assert names.index(first) not in asked[0].held
    assert asked[0].held


@pytest.mark.parametrize(
    ("step_m", "degrees", "held"), [(0.1, 0.5, 1), (3.0, 0.0, 3), (0.0, 5.0, 3)]
)
def test_a_photo_does_not_turn_its_neighbours_over(live, monkeypatch, step_m, degrees, held):
    """One that moved along was turned by 12 degrees, where two photos alone held it."""
    local, members = live.refinement.local_pose, live.members
    asked = []

    def adjusted(window):
        asked.append(len(window.held))
        free = [k for k in range(len(window.photos)) if k not in window.held]
        poses = {k: members.by_id[k + 1].pose for k in free}
        poses = {k: turned(replace(p, map_C=p.map_C + step_m), degrees) for k, p in poses.items()}
        return AdjustedWindow(
            poses=poses, camera="", observations=50, xyz=np.zeros((0, 3)), dropped=()
        )

    monkeypatch.setattr(local, "adjust_locally", adjusted)
    good = {(i, 4): local.live_links.link(i, 4) for i in (1, 2, 3)}
    change = local._adjusted_locally(members.by_id[4], dict(good), good)
    assert asked[-1] == held and len(change.moved) == 4 - held


@pytest.mark.parametrize(("photos", "times"), [(10, 1), (9, 0)])
def test_warnings_of_whole_adjustments_are_told_once(live, photos, times):
    members, apply = live.members, live.apply_adjustment
    poses = {i: m.pose for i, m in members.by_id.items()}
    number = live.ledger.row("select coalesce(max(seq), 0) from event")[0]
    live.ledger.put_meta(TOLD, [])
    for metres, names in ((15, "a.jpg, b.jpg"), (17.5, "c.jpg")):
        done = BlockAdjustment(
            ids=tuple(range(1, photos + 1)),
            poses=poses,
            cameras={},
            camera_of={},
            xyz=np.zeros((0, 3)),
            notes=(f"Positions lie {metres} m off ({names}).",),
        )
        apply.apply(done)
    said = [body for _, kind, body in live.ledger.told(number) if kind == "note"]
    assert sum("So far: Positions lie 15 m off (a.jpg, b.jpg)." in body for body in said) == times
    assert sum("Positions lie" in body for body in said) == times


def with_hole(young):
    """An adjustment of which one tie point, of a wrong match, lies a flying height too low."""

    def adjusted(*given):
        done = young(*given)
        xyz = done.ties.xyz.copy()
        hole = xyz[[0]] - [0.0, 0.0, np.median([p.map_C[2] for p in done.poses.values()])]
        return replace(done, ties=replace(done.ties, xyz=np.concatenate([xyz, hole])))

    return adjusted


@pytest.mark.parametrize("whole", [False, True])
def test_a_single_false_tie_point_tells_no_ground(live, monkeypatch, whole):
    """It drew a corner of a forest 60 m too low, as a lobe of smeared trees."""
    lowest = []
    monkeypatch.setattr(live.refinement, "heights", lambda xyz, *_, **__: lowest.append(xyz))
    if whole:
        job = live.blocks._job([1, 2, 3, 4], frozenset(), 0.0, thorough=False, sweep=False)
        monkeypatch.setattr(background_adjustment, "QUICK", with_hole(background_adjustment.QUICK))
        live.apply_adjustment.apply(background_adjustment.adjust_block(job))
    else:
        local = live.refinement.local_pose
        monkeypatch.setattr(local, "young", with_hole(local.young))
        live.queues.untried.append(live.members.by_id[4])
        live.refinement.refine(live.members.by_id[4])
    (xyz,) = lowest
    assert len(xyz) > 100 and np.ptp(xyz[:, 2]) < 30.0


def test_photos_that_are_not_refined_yet_come_before_those_that_are_once_more(live):
    """Photos came faster than they were refined: half of the time went to those that had only
    moved along with others.
    """
    queues, known = live.queues, live.members.by_id
    assert queues.next_untried() is None and queues.unrefined == 0
    queues.untried.extend([known[1], known[2], known[3]])
    assert queues.next_untried() is known[1] and queues.unrefined == 0
    known[2].state = known[3].state = "placed"
    assert queues.next_untried() is known[2] and queues.unrefined == 2
    asked = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            live.refinement, "refine", lambda m: asked.append(m) or queues.untried.remove(m)
        )
        for _ in range(6):
            live._refined()
    assert [m.id for m in asked] == [2, 3, 1]
