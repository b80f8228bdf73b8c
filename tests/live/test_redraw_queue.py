"""Which tiles are drawn again when photos move."""

import json
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.live import redraw_queue
from skyquilt.live.members import Member, pose_record
from skyquilt.live.redraw_queue import RedrawQueue
from skyquilt.model.poses import Pose
from skyquilt.raster.tile_store import Address

SIDE_M = 10.0


def pose(x):
    return Pose(cam_R_map=np.diag([1.0, -1.0, -1.0]), map_C=np.array([x, 0.0, 50.0]))


class Tiles:
    """A row of tiles that tell where they show the photo, which is as wide as one."""

    gsd = 0.1

    def __init__(self):
        self.shown, self.now = {}, {}

    def place(self, member, camera):
        before = self.tiles_of(member.id)
        self.now[member.id] = float(member.pose.map_C[0])
        return {*before, *self.tiles_of(member.id)}

    def remove(self, number):
        before = set(self.tiles_of(number))
        self.now.pop(number, None)
        return before

    def tiles_of(self, number):
        x = self.now.get(number)
        return () if x is None else tuple(Address("visible", 0, 0, k) for k in _columns(x))

    def outline(self, number):
        return np.array([[self.now[number], 0.0]])

    def moved(self, member, drawn):
        return bool(np.abs(member.pose.map_C - drawn.map_C).max() > self.gsd)

    def draw(self, dirty, rule=""):
        for a in dirty:
            at = {i: x for i, x in self.now.items() if a.col in _columns(x)}
            self.shown[a.col] = at
        return list(dirty)

    def owed(self):
        return []

    def finish(self, rule=""):
        return 0

    def is_white(self, number):
        return False

    def remarked(self, camera):
        return False


def _columns(x):
    return range(int(x // SIDE_M), int((x + SIDE_M) // SIDE_M) + 1)


class Survey:
    """One photo, of which the ledger may know where it was drawn."""

    def __init__(self, x, drawn=None):
        self.member = Member(
            id=1, photo=SimpleNamespace(camera_key="one"), source="", state="refined", pose=pose(x)
        )
        self.tiles = Tiles()
        for k in _columns(drawn) if drawn is not None else ():
            self.tiles.shown[k] = {1: drawn}
        footprint = json.dumps({"pose": pose_record(pose(drawn))}) if drawn is not None else ""
        ledger = SimpleNamespace(
            rows=lambda query: [(1, footprint)] if footprint else [],
            set_photo=lambda *a, **k: None,
            change=_nothing,
        )
        members = SimpleNamespace(
            by_id={1: self.member},
            ledger=ledger,
            on_map=lambda: [self.member],
            camera=lambda m: None,
        )
        self.told = list[int]()
        """Photos of which it was told where they are drawn."""
        events = SimpleNamespace(
            place=lambda m: ([], None),
            photo=lambda m, **k: self.told.append(m.id),
            tiles=lambda t: None,
        )
        self.queue = RedrawQueue(members, self.tiles, events)

    def to(self, x):
        self.member.pose = pose(x)
        self.queue.moved(self.member)
        while self.queue.pending:
            self.queue.take_note()

    def rest(self):
        while self.queue.dirty:
            self.queue.draw(self.queue.dirty)

    def wrong(self):
        """Tiles that show the photo elsewhere than it lies, or not where it does."""
        x = float(self.member.pose.map_C[0])
        right = {k: {1: x} for k in _columns(x)}
        return {
            k
            for k in {*self.tiles.shown, *right}
            if self.tiles.shown.get(k, {}) != right.get(k, {})
        }


@contextmanager
def _nothing():
    yield None


@pytest.mark.parametrize("away", [30.0, 300.0])
def test_a_photo_that_comes_back_before_all_was_drawn_leaves_nothing_behind(away, monkeypatch):
    """Half of its tiles had been drawn when it moved back to where it was drawn last."""
    monkeypatch.setattr(redraw_queue, "DRAWN_AT_ONCE", 1)
    survey = Survey(5.0)
    survey.rest()
    assert not survey.wrong()
    for steps in range(1, 4):
        survey.to(5.0 + away)
        for _ in range(steps):
            survey.queue.draw(survey.queue.dirty)
        survey.to(5.0)
        survey.rest()
        assert not survey.wrong(), steps


def test_after_a_restart_a_photo_leaves_the_place_where_it_was_drawn():
    survey = Survey(95.0, drawn=5.0)
    survey.rest()
    assert not survey.wrong()


def test_what_lies_where_it_was_drawn_is_not_drawn_again():
    survey = Survey(5.0)
    survey.rest()
    survey.queue.changed(survey.member)
    while survey.queue.pending:
        survey.queue.take_note()
    assert not survey.queue.dirty
    assert not Survey(5.0, drawn=5.0).queue.dirty


@pytest.mark.parametrize("how", ["altered", "changed"])
def test_a_new_photo_that_looks_different_before_it_is_drawn_is_drawn_once_and_told_at_once(how):
    """It waited for its neighbours, and what stood by its metadata counts as found by them now."""
    survey = Survey(5.0)
    queue, member = survey.queue, survey.member
    queue.dirty.clear()
    queue.held.add(1)
    getattr(queue, how)(member)
    assert not queue.urgent and not queue.pending
    queue.show(member)
    getattr(queue, how)(member)
    queue.draw(queue.urgent)
    assert survey.told == [1]
    assert not (survey.wrong() or queue.urgent or queue.dirty or queue.pending)
