"""Photos that come faster than they are refined."""

from types import SimpleNamespace

import numpy as np
import pytest

from skyquilt.live import adjustment_schedule
from skyquilt.live.background_adjustment import adjust_block
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.simulate.settings import Control, Route
from tests.live.conftest import made


@pytest.fixture
def live(flight, tmp_path, monkeypatch):
    """A map of six photos; jobs are kept, not run."""
    monkeypatch.setattr(adjustment_schedule, "YOUNG", 2)
    live = LiveMap(tmp_path / "out", LiveSettings(features=200, gsd_cm=60.0))
    jobs = []
    live.background = SimpleNamespace(
        busy=False, start=jobs.append, outcome=lambda: None, stop=lambda: None, jobs=jobs
    )
    for path in flight.photos:
        live.intake.take_file(path, "drone")
    yield live
    live.close()


def worked(live, until):
    for _ in range(200):
        if until():
            return
        live.work()
    raise AssertionError("it did not happen")


@pytest.mark.slow
def test_a_block_that_grows_is_adjusted_while_photos_wait(live):
    worked(live, lambda: live.background.jobs)
    assert len(live.queues.untried) >= 2
    (job,) = live.background.jobs
    assert len(job.ids) == 3 and not job.thorough and not job.sweep


@pytest.mark.slow
def test_thoroughly_and_with_heights_when_no_photos_arrive(live):
    worked(live, lambda: _refined(live) == 6 and live.work() is None)
    live.blocks.last_arrival = -1e9
    worked(live, lambda: any(job.thorough for job in live.background.jobs))
    assert live.background.jobs[-1].sweep and len(live.background.jobs[-1].ids) == 6


def _refined(live):
    return sum(m.state == "refined" for m in live.members.by_id.values())


@pytest.mark.slow
def test_a_line_does_not_bend_while_photos_come_as_fast_as_possible(tmp_path_factory, tmp_path):
    """Photos come faster than they are refined: what ten of them tell of heading and scale must not
    be carried on to the end of the line.
    """
    line = made(
        tmp_path_factory,
        "overtaken",
        seed=106,
        route=Route(pattern="strip", photos=30),
        control=Control(points=0, checks=0),
    )
    live = LiveMap(tmp_path / "out", LiveSettings(gsd_cm=60.0))
    for path in line.photos:
        live.intake.take_file(path, "drone")
    live.background = Prompt()
    while _refined(live) < len(line.photos):
        live.work()
    assert live.background.thorough and not any(live.background.thorough)
    known = list(live.members.on_map())
    off = np.array([m.pose.map_C[:2] for m in known]) + live.members.frame.origin
    off -= [line.centre(m.photo.name)[:2] for m in known]
    far = np.linalg.norm(off - np.median(off, axis=0), axis=1)
    assert 0.02 < far.max() < 3.0  # 8 m where it is adjusted only when nothing else is to do
    assert not live.ledger.rows("select 1 from event where body like '%So far%'")
    live.close()


class Prompt:
    """Adjusts at once, however busy this machine is."""

    def __init__(self):
        self.done, self.thorough = [], []

    @property
    def busy(self):
        return bool(self.done)

    def start(self, job):
        self.thorough.append(job.thorough)
        self.done.append(adjust_block(job))

    def outcome(self):
        return self.done.pop() if self.done else None

    def stop(self):
        self.done.clear()
