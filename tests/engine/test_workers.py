import threading
import time

import pytest

from skyquilt.engine.workers import Ahead, Threads
from skyquilt.settings import RunningSettings


@pytest.mark.parametrize("jobs", [0, 1, 2, 7])
def test_results_come_in_order(jobs):
    def work(item):
        time.sleep(0.002 * (item % 3))
        return item * item

    assert list(Threads(jobs).each(work, range(40))) == [i * i for i in range(40)]


def test_no_items():
    assert list(Threads(3).each(str, [])) == []


def test_it_never_runs_far_ahead():
    begun = []

    def work(item):
        begun.append(item)
        return item

    results = Threads(2).each(work, iter(range(1000)))
    next(results)
    time.sleep(0.05)
    assert len(begun) <= 6
    results.close()


@pytest.mark.parametrize("jobs", [1, 3])
def test_an_exception_arrives_in_its_place_and_stops_the_rest(jobs):
    begun = []

    def work(item):
        begun.append(item)
        if item == 5:
            raise KeyError("five")
        return item

    got = []
    with pytest.raises(KeyError, match="five"):
        for result in Threads(jobs).each(work, range(500)):
            got.append(result)
    assert got == [0, 1, 2, 3, 4]
    assert len(begun) < 20


def test_an_interrupt_waits_only_for_what_is_under_way():
    begun = []

    def work(item):
        begun.append(item)
        time.sleep(0.1)
        return item

    results = Threads(2).each(work, range(100))
    next(results)
    at = time.perf_counter()
    with pytest.raises(KeyboardInterrupt):
        results.throw(KeyboardInterrupt)
    assert time.perf_counter() - at < 0.4
    count = len(begun)
    time.sleep(0.15)
    assert len(begun) == count
    assert not [t for t in threading.enumerate() if t.name.startswith("ThreadPoolExecutor")]


def test_an_abandoned_generator_leaves_no_threads():
    results = Threads(3).each(lambda item: item, range(100))
    next(results)
    del results
    assert not [t for t in threading.enumerate() if t.name.startswith("ThreadPoolExecutor")]


def test_a_run_takes_no_more_threads_than_its_memory_bears(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    assert RunningSettings().threads == 11  # of 1.2 GB, 0.06 each beside 0.5
    assert RunningSettings(memory_gb=8.0).threads == 64
    assert RunningSettings(memory_gb=0.5).threads == 1
    assert RunningSettings(jobs=32).threads == 32  # as asked
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    assert RunningSettings().threads == 2


@pytest.mark.parametrize("jobs", [1, 3])
def test_results_taken_ahead_are_those_of_their_names(jobs):
    """Whatever is asked for: the next ones, some left out, one again, one that was never told."""
    made = []

    def work(item):
        made.append(item)
        return -item

    ahead = Ahead(Threads(jobs), work, [(f"n{i % 5}", i) for i in range(10)])
    assert [ahead.take("n0", 0), ahead.take("n3", 3), ahead.take("n4", 4)] == [0, -3, -4]
    assert ahead.take("n1", 6) == -6
    assert ahead.take("other", 77) == -77
    assert ahead.take("n4", 9) == -9
    assert ahead.take("n0", 0) == 0
    assert sorted(made) == sorted([*range(10), 77, 0])


def test_work_ahead_goes_on_while_the_caller_is_busy():
    begun = []

    def work(item):
        begun.append(item)
        return item

    ahead = Ahead(Threads(2), work, [(i, i) for i in range(50)])
    assert ahead.take(0, 0) == 0
    time.sleep(0.05)
    assert 2 <= len(begun) <= 6
