"""Long computations that tell how far they are, and that can be left."""

import threading
import time

import pytest

from skyquilt.alignment.progress import STEPS, AdjustmentSteps
from skyquilt.engine.clock import CountedParts, apart
from skyquilt.engine.kept import Keep
from skyquilt.engine.workers import Ahead, Telling, Threads


def all_of(steps):
    """What a generator of steps yields and returns."""
    yielded = []
    while True:
        try:
            yielded.append(next(steps))
        except StopIteration as stop:
            return yielded, stop.value


@pytest.mark.slow
def test_parts_are_told_while_the_work_goes_on():
    """Each is seen before the next one begins."""
    seen = threading.Event()

    def work(tell):
        for part in ("a", "b", "c"):
            seen.clear()
            tell(part)
            assert seen.wait(10), part
        return 7

    steps, yielded = apart(work, lambda part: ("abc".index(part), 3, part)), []
    try:
        while True:
            yielded.append(next(steps))
            if len(yielded) > 1:
                seen.set()
    except StopIteration as stop:
        assert stop.value == 7
    assert yielded == [(0, 1), (0, 3, "a"), (1, 3, "b"), (2, 3, "c"), (3, 3)]


def test_an_error_is_that_of_the_work():
    def work(tell):
        tell("a")
        raise ZeroDivisionError("by nobody")

    with pytest.raises(ZeroDivisionError, match="by nobody"):
        all_of(apart(work, lambda part: (0, 1)))


@pytest.mark.parametrize("how", ["closed", "interrupted"])
def test_work_that_nobody_waits_for_ends_with_its_part(how):
    begun, done = threading.Event(), []

    def work(tell):
        try:
            for part in range(10_000):
                tell(str(part))
                begun.set()
                time.sleep(0.01)
                done.append(part)
        finally:
            done.append("ended")

    steps = apart(work, lambda part: (0, 1))
    next(steps)
    next(steps)
    assert begun.wait(5)
    if how == "closed":
        steps.close()
        assert done[-1] == "ended"
    else:
        with pytest.raises(KeyboardInterrupt):
            steps.throw(KeyboardInterrupt())
    deadline = time.monotonic() + 10
    while done[-1:] != ["ended"] and time.monotonic() < deadline:
        time.sleep(0.01)
    assert done[-1] == "ended" and len(done) < 1000


def test_a_keep_tells_the_names_of_its_parts():
    heard = []
    keep = Keep(told=heard.append)
    assert keep.within("rough").within("free")("3", lambda: 5) == 5
    keep.tell("outcome")
    assert heard == ["rough free 3", "outcome"]


def test_adjustments_are_counted_by_their_parts():
    step = AdjustmentSteps()
    n = len(STEPS)
    names = ["start", "tracks", "rough fixed 0", "rough free 12", "sharp 65536", "fine 2.5 0"]
    found = [step(f"[3, 8] {name}") for name in names]
    assert [f[:2] for f in found] == [(0, n), (1, n), (2, n), (2, n), (3, n), (4, n)]
    assert found[2][2] == "rough adjustment, 1" and found[3][2] == "rough adjustment, 13"
    assert found[4][2] == "tie points refined"
    again = [step(f"turned 0 [] {name}") for name in ("start", "rough fixed 0", "outcome")]
    assert [f[:2] for f in again] == [(n, 2 * n), (n + 2, 2 * n), (2 * n - 1, 2 * n)]
    assert again[1][2] == "rough adjustment, 1, adjustment 2"


def test_counted_parts_add_up_over_their_series():
    step = CountedParts()
    names = ["0 0", "coarse heights 1 of 2", "coarse heights 2 of 2", "(0, 1) coarse 0 512"]
    names += ["(0, 1) fine heights 1 of 3", "fine 0 512", "(0, 9) fine heights 3 of 3"]
    assert [step(name) for name in names] == [
        (0, 1, ""),
        (0, 2, "coarse heights"),
        (1, 2, "coarse heights"),
        (1, 2, "coarse heights"),
        (2, 5, "fine heights"),
        (2, 5, "fine heights"),
        (4, 5, "fine heights"),
    ]


@pytest.mark.parametrize("number", [1, 3])
def test_results_that_are_waited_for_are_told_and_can_be_left(number):
    heard = []
    telling = Telling(Threads(number), heard.append, "photos")
    assert list(telling.each(abs, iter([-1, -2, -3]))) == [1, 2, 3]
    assert heard == ["photos 1 of 3", "photos 2 of 3", "photos 3 of 3"]

    def left(part):
        if part == "photos 2 of 3":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(Telling(Threads(number), left, "photos").each(abs, [-1, -2, -3]))


def test_what_is_computed_ahead_is_told_when_it_is_waited_for():
    heard = []
    ahead = Ahead(Threads(2), abs, [("a", -1), ("b", -2), ("c", -3)], heard.append, "pairs")
    assert ahead.take("a", -1) == 1
    assert ahead.take("c", -3) == 3  # b is passed over
    assert ahead.take("d", -4) == 4  # made here
    assert heard == ["pairs 1 of 3", "pairs 2 of 3", "pairs 3 of 3"]
