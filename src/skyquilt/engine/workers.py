"""Who computes what can be computed apart: threads of this process, or other processes."""

from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Generic, Protocol, TypeVar

from skyquilt.engine.memory_watch import enough_addresses
from skyquilt.model.event import Note
from skyquilt.settings import RunningSettings

A = TypeVar("A")
B = TypeVar("B")


class Workers(Protocol):
    """Compute the parts of a step; the results come in order, whoever computed them."""

    @property
    def apart(self) -> bool:
        """Whether each has a Python of its own: then work that is mostly Python gains, too."""
        ...

    @property
    def handed(self) -> int:
        """Number of items given to other processes so far."""
        ...

    def each(self, work: Callable[[A], B], items: Iterable[A]) -> Iterator[B]:
        """work(item) for each item, in order, computing at most a few results ahead of the
        consumer.

        `work`, items and results may go to other processes: what `work` refers to is copied there,
        so it gives its results back or puts them into the store, and changes nothing here.
        """
        ...

    def news(self) -> Sequence[Note]:
        """What the user should know since the last call."""
        ...


@dataclass(frozen=True)
class Threads:
    """Threads of this process.

    The heavy parts (OpenCV, BLAS, the JPEG codec) release the interpreter lock. An interrupt
    cancels items that have not started and waits only for those being computed.
    """

    number: int = 1
    """How many; 1 = none but the caller's."""
    apart: ClassVar[bool] = False
    handed: ClassVar[int] = 0

    def each(self, work: Callable[[A], B], items: Iterable[A]) -> Iterator[B]:
        """work(item) for each item, in order."""
        if self.number <= 1:
            for item in items:
                yield work(item)
            return
        pool = ThreadPoolExecutor(self.number)
        waiting: deque[Future[B]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) > 2 * self.number:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def news(self) -> Sequence[Note]:
        """Nothing."""
        return ()


HERE = Threads()
"""One thread: that of the caller."""


@dataclass(frozen=True)
class Telling:
    """Workers of which each result that is waited for is told."""

    workers: Workers
    """Who computes."""
    tell: Callable[[str], None]
    """Hears `what 3 of 40`; it may end the work by raising."""
    what: str
    """What is computed."""

    @property
    def apart(self) -> bool:
        """As of the workers."""
        return self.workers.apart

    @property
    def handed(self) -> int:
        """As of the workers."""
        return self.workers.handed

    def each(self, work: Callable[[A], B], items: Iterable[A]) -> Iterator[B]:
        """work(item) for each item, in order."""
        items = list(items)
        found = self.workers.each(work, items)
        for number in range(len(items)):
            self.tell(f"{self.what} {number + 1} of {len(items)}")
            yield next(found)

    def news(self) -> Sequence[Note]:
        """As of the workers."""
        return self.workers.news()


class Ahead(Generic[A, B]):
    """Results of items in a known order, computed while the caller does something else with the
    ones before.
    """

    def __init__(
        self,
        workers: Workers,
        work: Callable[[A], B],
        items: Sequence[tuple[Hashable, A]],
        tell: Callable[[str], None] = lambda _: None,
        what: str = "part",
    ) -> None:
        """`items`: by a name each, in the order in which `take` will ask for them. `tell` hears
        which of them is waited for, as `what 3 of 40`.
        """
        self._work, self._tell, self._what = work, tell, what
        self._total = len(items)
        self._names = deque(name for name, _ in items)
        self._results = workers.each(work, [item for _, item in items])

    def take(self, name: Hashable, item: A) -> B:
        """The result of the next item of this name; computed here if none is to come."""
        if name not in self._names:  # the first one nearly always
            return self._work(item)
        while True:
            self._tell(f"{self._what} {self._total - len(self._names) + 1} of {self._total}")
            asked = self._names.popleft() == name
            result = next(self._results)
            if asked:
                return result


@contextmanager
def workers_for(running: RunningSettings, folder: Path, sees: Sequence[Path]) -> Iterator[Workers]:
    """The workers of a run: threads, or those of `--scheduler`. `folder`: that of the run's state;
    `sees`: files that all workers must see.

    Raises:
        UsageError: the scheduler or its workers cannot be used. SkyquiltError: the system allows
            too few addresses for so many threads.
    """
    if running.scheduler is None:
        enough_addresses(running.threads)
        yield Threads(running.threads)
        return
    from skyquilt.engine.cluster import cluster  # Dask is an extra

    with cluster(running.scheduler, folder, sees) as found:
        yield found
