"""Time per stage, reported as events."""

import re
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from skyquilt.engine.free_memory import give_back_growth
from skyquilt.engine.store import Store
from skyquilt.engine.workers import HERE, Workers
from skyquilt.model.event import Event, StageFinished, StageProgress, StageStarted

T = TypeVar("T")
Step = tuple[int, int] | tuple[int, int, str]
"""Done, total, and what is done now."""
Steps = Generator[Step | Event, None, T]
"""Generator of a stage: yields steps or events, returns its result."""
HEARD_S = 0.25
"""How often in s a step is asked for that is computed apart."""


def result_of(steps: Generator[Any, None, T]) -> T:
    """What a generator of steps or events returns; what it yields is passed over."""
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            found: T = stop.value
            return found


class _Left(BaseException):
    """Ends a computation whose result nobody waits for."""


def apart(work: Callable[[Callable[[str], None]], T], step: Callable[[str], Step]) -> Steps[T]:
    """Computes in a thread of its own, and yields a step for each part that `work` names to what it
    is called with: one long computation tells how far it is, and Ctrl-C ends it at once.

    A generator that is closed early waits for the end of the part.
    """
    heard: deque[str] = deque()
    left = threading.Event()

    def tell(part: str) -> None:
        if left.is_set():
            raise _Left
        heard.append(part)

    last: Step = (0, 1)
    yield last
    pool = ThreadPoolExecutor(1, thread_name_prefix="apart")
    found = pool.submit(work, tell)
    waits = True
    try:
        while not found.done():
            wait([found], HEARD_S)
            while heard:
                last = step(heard.popleft())
                yield last
    except KeyboardInterrupt:
        waits = False
        raise
    finally:
        left.set()
        pool.shutdown(wait=waits)
    result = found.result()
    yield last[1], last[1]
    return result


_COUNTED = re.compile(r"([^\W\d][^\d]*?) ?([0-9]+) of ([0-9]+)$")


@dataclass(kw_only=True)
class CountedParts:
    """Counts parts that are named `heights 3 of 40`: the third of forty begins. Several series,
    told apart by their words, follow one another.
    """

    what: str = ""
    """The words of the last part."""
    at: tuple[int, int] = (0, 1)
    """Done and total of its series."""
    before: int = 0
    """Parts of earlier series."""

    def __call__(self, part: str) -> Step:
        """Done, total, and what is done now; a part without numbers changes nothing."""
        if found := _COUNTED.search(part):
            if found[1] != self.what and self.what:
                self.before += self.at[1]
            self.what, self.at = found[1], (int(found[2]) - 1, int(found[3]))
        return self.before + self.at[0], self.before + self.at[1], self.what


def _progress(stage: str, done: int, total: int, what: str = "") -> StageProgress:
    return StageProgress(stage=stage, done=done, total=total, what=what)


def cpu_seconds() -> float:
    """CPU time of this process in s."""
    return time.process_time()


def peak_memory_mb() -> float | None:
    """Largest resident memory of this process in MB; None on systems that do not report it
    (Windows).
    """
    with suppress(OSError, ValueError, StopIteration):
        # Linux counts into the other figure what the process that started this one held
        lines = Path("/proc/self/status").read_text("utf-8").splitlines()
        return int(next(s for s in lines if s.startswith("VmHWM")).split()[1]) * 1024 / 1e6
    if sys.platform == "win32":
        return None
    import resource

    unit = 1e6 if sys.platform == "darwin" else 1e6 / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


@dataclass(kw_only=True)
class Clock:
    """Times of the stages of a run."""

    store: Store
    """Its hits and misses show whether a stage was reused."""
    began: tuple[float, float]
    """Start of the run: wall clock and CPU time in s, as `now` returns them."""
    workers: Workers = HERE
    """Who computes the parts of its stages."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall-clock time per stage in s."""
    cpu: dict[str, float] = field(default_factory=dict)
    """CPU time per stage in s."""
    peak_mb: dict[str, float] = field(default_factory=dict)
    """Largest resident memory up to the end of each stage in MB; empty on systems that do not
    report it.
    """

    @staticmethod
    def now() -> tuple[float, float]:
        """Wall clock and CPU time in s."""
        return time.perf_counter(), cpu_seconds()

    def lap(self, stage: str, since: tuple[float, float]) -> None:
        """Records a stage's time since an earlier `now`."""
        self.seconds[stage] = round(time.perf_counter() - since[0], 3)
        self.cpu[stage] = round(cpu_seconds() - since[1], 3)
        if (peak := peak_memory_mb()) is not None:
            self.peak_mb[stage] = round(peak, 1)

    def stage(self, name: str, work: Steps[T], *, keeps: bool = True) -> Generator[Event, None, T]:
        """Runs a stage, yields its events and returns its result; `keeps` is False for a stage that
        stores nothing.
        """
        begun, hits, misses = self.now(), self.store.hits, self.store.misses
        handed = self.workers.handed
        yield StageStarted(stage=name, total=0)
        try:
            while True:
                step = next(work)
                yield _progress(name, *step) if isinstance(step, tuple) else step
                yield from self.workers.news()
        except StopIteration as stop:
            result: T = stop.value
        finally:
            work.close()
        del work
        give_back_growth()
        self.lap(name, begun)
        yield StageFinished(
            stage=name,
            seconds=self.seconds[name],
            cpu_seconds=round(cpu_seconds() - begun[1], 3),
            reused=keeps
            and self.store.misses == misses
            and self.store.hits > hits
            and self.workers.handed == handed,
        )
        return result

    def total(self) -> float:
        """Wall-clock time so far in s."""
        return time.perf_counter() - self.began[0]

    def cpu_total(self) -> float:
        """CPU time so far in s, of this process."""
        return cpu_seconds() - self.began[1]
