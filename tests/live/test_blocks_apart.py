"""Blocks of linked photos that stand apart, as far as their positions err, and meet."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.live import members
from skyquilt.live.live_map import LiveMap
from skyquilt.live.local_pose import LocalPose
from skyquilt.live.settings import YOUNG, LiveSettings
from skyquilt.model.features import Link
from skyquilt.simulate.settings import Control, Reporting, Route
from tests.live.conftest import fed, made

EAST_DEG = 25.0 / 70_000
"""Longitude of 25 m, about, where flights are simulated."""


def link(a, b, matches):
    index = np.arange(matches)
    return Link(a=a, b=b, index_a=index, index_b=index, b_S_a=1.0)


def test_links_with_a_block_that_lies_elsewhere_are_believed():
    """Photos 1 and 2 are one block, 3 to 5 another one, by which the new photo 9 was placed."""
    block_of = {1: 1, 2: 1, 3: 3, 4: 3, 5: 3, 9: 9}
    pose = SimpleNamespace(members=SimpleNamespace(block_of=block_of))
    ids = [1, 2, 3, 4, 5, 9]
    own = [link(k, 5, n) for k, n in enumerate((40, 20, 90, 90, 90))]
    wrong = LocalPose._wrong(pose, own, 5, ids, {(0, 5), (1, 5), (4, 5)})
    assert wrong == [(2, 9), (5, 9)]  # of few matches; beside others of its own block


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """Eighteen photos in one line: the first six and the last six do not overlap."""
    return made(
        tmp_path_factory,
        "line",
        seed=12,
        route=Route(pattern="strip", photos=18),
        reporting=Reporting(gps_noise=0.3),
        control=Control(points=0, checks=0),
    )


def _displace(monkeypatch, displaced, east_deg):
    """Positions of these photos are off by as much."""
    read = members.read_photo

    def elsewhere(path, *, name, **more):
        photo = read(path, name=name, **more)
        if name not in displaced:
            return photo
        there = replace(photo.position, longitude_deg=photo.position.longitude_deg + east_deg)
        return replace(photo, position=there)

    monkeypatch.setattr(members, "read_photo", elsewhere)


@pytest.mark.long
@pytest.mark.slow
def test_blocks_that_lie_apart_become_one_where_they_meet(line, tmp_path, monkeypatch):
    """The positions of the last six are displaced. Links with these contradicted those with the
    others, and were dropped: the map stayed torn.
    """
    names = [p.name for p in line.photos]
    _displace(monkeypatch, set(names[-6:]), EAST_DEG)
    live = LiveMap(tmp_path / "out", LiveSettings(features=600))
    fed(live, [*line.photos[:6], *line.photos[-6:]])
    assert len(live.members.block(1)) == 6
    assert len(live.members.block(7)) == 6 > YOUNG - 6
    fed(live, line.photos[6:-6])
    assert len(live.members.block(1)) == len(names)
    origin = live.members.frame.origin
    off = np.array([
        (m.pose.map_C[:2] + origin) - line.centre(m.photo.name)[:2]
        for m in live.members.on_map()
    ])  # fmt: skip
    off = off[np.argsort([m.photo.name for m in live.members.on_map()])]
    assert np.linalg.norm(np.diff(off, axis=0), axis=1).max() < 0.6  # from photo to photo
    live.close()


@pytest.mark.slow
def test_photos_of_other_blocks_are_compared_when_no_photos_arrive(flight, tmp_path):
    live = fed(LiveMap(tmp_path / "out", LiveSettings(features=600)), flight.photos)
    assert len(live.members.block(1)) == 6
    with live.ledger.change() as db:  # as if only photos of the own block had been near
        for a, b in live.ledger.rows("select a, b from link where body is not null"):
            if (a in (1, 2)) != (b in (1, 2)):
                db.execute("delete from link where a = ? and b = ?", (a, b))
                live.members.parted(a, b)
    assert sorted(map(len, live.members.blocks.values())) == [2, 4]
    live.refinement.move({}, {})
    for _ in live.drain_all():
        pass
    assert len(live.members.block(1)) == 6
    live.close()


@pytest.mark.slow
@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4, 5), (0, 4, 1, 5, 2, 3)])
def test_photos_whose_positions_are_far_off_are_found(flight, order, tmp_path, monkeypatch):
    """A receiver jumped by 500 m: nothing is near there, and photos were compared with none."""
    names = [p.name for p in flight.photos]
    _displace(monkeypatch, set(names[2:4]), 20 * EAST_DEG)
    live = fed(
        LiveMap(tmp_path / "out", LiveSettings(features=600)), [flight.photos[k] for k in order]
    )
    assert len(live.members.block(1)) == len(names)
    off = np.array([
        (m.pose.map_C[:2] + live.members.frame.origin) - flight.centre(m.photo.name)[:2]
        for m in live.members.on_map()
    ])  # fmt: skip
    assert len(off) == len(names)
    assert np.linalg.norm(off, axis=1).max() < 25.0
    live.close()
