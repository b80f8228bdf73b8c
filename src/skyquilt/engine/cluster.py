"""Work shared out to the processes of a Dask cluster. Needs the extra `cluster`.

What a step does is written once into the run's folder, which all workers must see; a task names
that file and one item. A worker that dies takes nothing with it: Dask gives its tasks to others,
and what was finished is in the run's store.
"""

import json
import os
import pickle
import platform
import threading
import time
import uuid
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence, Sized
from contextlib import contextmanager, suppress
from io import BytesIO
from itertools import islice
from pathlib import Path, PurePath
from typing import Any, ClassVar, NamedTuple, TypeVar

from skyquilt.engine.folder import refusal
from skyquilt.engine.free_memory import return_large_blocks
from skyquilt.errors import SkyquiltError, UsageError
from skyquilt.model.event import Note
from skyquilt.version import __version__

try:
    import cloudpickle
    import cv2
    import dask
    import distributed
    from distributed.comm.core import CommClosedError
except ImportError as error:
    raise UsageError("--scheduler needs Dask: install skyquilt with its extra `cluster`") from error

A = TypeVar("A")
B = TypeVar("B")
TASKS = "tasks"
"""Folder of the steps that workers take part in, below the run's state."""
POLL_S = 2.0
"""Seconds between two looks at which workers are there."""
PATIENCE_S = 120.0
"""Seconds that a run waits for a worker, or for the scheduler, before it ends with an error."""
ANSWER_S = 20.0
"""Seconds that a scheduler may take to answer."""
START_S = 60.0
"""Seconds that the first worker may take to come."""
FAILURES = 5
"""Workers that may die of one task before the run ends with an error."""
AHEAD = 3
"""Tasks that are handed out at a time for each thread of the workers."""
TASK_S, MOST_ITEMS, LOOKED = 0.4, 64, 50
"""Seconds that a task shall take, most items in one, and the number of the last items that tell how
long one takes.
"""
STEPS_KEPT = 2
"""Steps that a worker keeps in memory."""


@contextmanager
def cluster(scheduler: str, folder: Path, sees: Sequence[Path]) -> Iterator["Cluster"]:
    """The workers of a scheduler: `local:N` starts N processes of one thread, an address such as
    tcp://host:8786 or a scheduler file (JSON) joins a cluster that runs. `folder` is that of the
    run's state; the workers must see it, and the files `sees`.

    Raises:
        UsageError: no scheduler answers, no worker comes, or one is not fit.
    """
    with (
        dask.config.set(
            {
                "distributed.scheduler.allowed-failures": FAILURES,
                "distributed.comm.timeouts.connect": f"{ANSWER_S}s",
                # a run watches its own memory; Dask would pause workers and spill what they hold
                "distributed.worker.memory.target": False,
                "distributed.worker.memory.spill": False,
                "distributed.worker.memory.pause": False,
                "distributed.worker.memory.terminate": False,
                "distributed.worker.profile.enabled": False,
            }
        ),
        _client(scheduler) as client,
    ):
        found = Cluster(client, scheduler, folder / TASKS, sees)
        try:
            found.check()
            yield found
        finally:
            found.close()


@contextmanager
def _client(scheduler: str) -> Iterator[Any]:
    kind, _, number = scheduler.partition(":")
    if kind == "local":
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the processes inherit it
        with (
            distributed.LocalCluster(
                n_workers=int(number),
                threads_per_worker=1,
                processes=True,
                memory_limit=0,
                dashboard_address=None,
                worker_dashboard_address=None,
                silence_logs=50,
            ) as local,
            distributed.Client(local) as client,
        ):
            yield client
        return
    address = scheduler if "://" in scheduler else _address_in(Path(scheduler))
    try:
        client = distributed.Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(f"no Dask scheduler answers at {address}: {error}") from error
    with client:
        yield client


def _address_in(file: Path) -> str:
    """The address in a scheduler file.

    Raises:
        UsageError: it holds none.
    """
    try:
        address = json.loads(file.read_text(encoding="utf-8"))["address"]
    except (OSError, ValueError, KeyError, TypeError):
        address = None
    if not isinstance(address, str) or "://" not in address:
        raise UsageError(f"--scheduler {file} is no scheduler file: it holds no address")
    return address


class _Step(NamedTuple):
    """What workers are doing."""

    work: Any
    file: Path
    """Where they read it."""
    spent_s: deque[float]
    """Seconds that its last items took."""


class Cluster:
    """Workers of a Dask scheduler, as `engine.workers.Workers`."""

    apart: ClassVar[bool] = True

    def __init__(self, client: Any, name: str, folder: Path, sees: Sequence[Path]) -> None:
        self._client, self._name, self._folder = client, name, folder
        self._sees = [str(p.absolute()) for p in sees]
        self._news: list[Note] = []
        self._workers: set[str] = set()
        self._threads = 1
        self._since = time.monotonic()
        self._step: _Step | None = None
        self.handed = 0
        """Number of tasks so far."""

    def check(self) -> None:
        """Waits for the first worker, and asks those that are there whether they can take part.

        Raises:
            UsageError: none came, or one cannot.
        """
        try:
            self._client.wait_for_workers(1, timeout=START_S)
        except TimeoutError as error:
            raise UsageError(
                f"no worker has come to the Dask scheduler {self._name} in {START_S:.0f} s;"
                " start workers, then run the same command again"
            ) from error
        marker = self._written(None)
        try:
            for address, wrong in self._client.run(_unfit, str(marker)).items():
                if wrong:
                    raise UsageError(f"the worker {address} cannot take part: {wrong}")
        finally:
            marker.unlink(missing_ok=True)
        self._look_around()
        self._news.clear()

    def each(self, work: Callable[[A], B], items: Iterable[A]) -> Iterator[B]:
        """work(item) for each item, in order.

        Raises:
            SkyquiltError: the scheduler is gone, no worker is left, or a task ends every worker
                that takes it.
        """
        waiting: deque[Any] = deque()
        name = f"{getattr(work, '__name__', type(work).__name__)}-{uuid.uuid4().hex[:8]}"
        rest, number, spent_s = iter(items), 0, self._spent_s(work)
        share = len(items) // (AHEAD * self._threads) if isinstance(items, Sized) else MOST_ITEMS
        try:
            while some := list(islice(rest, max(1, min(_size(spent_s), share)))):
                path, number = self._file_of(work, spent_s), number + 1
                waiting.append(
                    self._client.submit(_do, str(path), some, key=f"{name}-{number}", pure=False)
                )
                self.handed += len(some)
                if len(waiting) > AHEAD * self._threads:
                    yield from self._taken(waiting.popleft(), spent_s)
            while waiting:
                yield from self._taken(waiting.popleft(), spent_s)
        finally:
            with suppress(Exception):  # the scheduler may be gone
                self._client.cancel(list(waiting))

    def _taken(self, future: Any, spent_s: deque[float]) -> list[Any]:
        """The results of a task; adds the seconds that its items took."""
        results, seconds = self._result(future)
        spent_s += seconds
        return results  # type: ignore[no-any-return]

    def news(self) -> Sequence[Note]:
        """Workers that came or went since the last call."""
        told, self._news = self._news, []
        return told

    def close(self) -> None:
        """Removes the folder of the steps."""
        self._forget()
        with suppress(OSError):
            self._folder.rmdir()

    def _spent_s(self, work: Any) -> deque[float]:
        """Seconds that the last items of this work took, for its next tasks to be added to."""
        if self._step is not None and self._step.work is work:
            return self._step.spent_s
        return deque(maxlen=LOOKED)

    def _file_of(self, work: Any, spent_s: deque[float]) -> Path:
        """The file of a step; what was written for the same work before, since workers know it."""
        if self._step is None or self._step.work is not work:
            self._forget()
            self._step = _Step(work, self._written(work), spent_s)
        return self._step.file

    def _forget(self) -> None:
        if self._step is not None:
            self._step.file.unlink(missing_ok=True)
            self._step = None

    def _written(self, work: Any) -> Path:
        """The file of a step.

        Raises:
            OutputError: it cannot be written.
        """
        body = BytesIO()
        about = {"sees": self._sees, "version": _version()}
        _Pickler(body).dump(about)
        _Pickler(body).dump(work)
        path = (self._folder / uuid.uuid4().hex).absolute()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(body.getbuffer())
        except OSError as error:
            raise refusal(path.parent, error) from error
        return path

    def _result(self, future: Any) -> Any:
        while True:
            try:
                return future.result(timeout=POLL_S)
            except (TimeoutError, distributed.TimeoutError):
                if future.status == "error":  # the work's own
                    raise
                self._look_around()
            except distributed.KilledWorker as error:
                raise SkyquiltError(
                    f"{FAILURES + 1} workers died of the same task; they may have too little"
                    " memory, see their logs; the same command goes on where this one stopped"
                ) from error
            except (distributed.CancelledError, CommClosedError) as error:
                raise self._lost() from error

    def _look_around(self) -> None:
        """Notes who came and went; ends the run where nobody is left for long."""
        found: dict[str, int] = {}
        if self._client.status == "running":
            try:
                found = dict(self._client.nthreads())
                self._replace(len(found))
            except (OSError, RuntimeError, AttributeError):
                found = {}
        now = set(found)
        if self._workers and now != self._workers:
            gone, new = len(self._workers - now), len(now - self._workers)
            text = (
                f"{len(now)} workers" + (f", {gone} lost" * bool(gone)) + f", {new} new" * bool(new)
            )
            self._news.append(Note(text=text, warning=bool(gone)))
        if now:
            self._workers, self._since = now, time.monotonic()
            self._threads = sum(found.values())
        elif time.monotonic() - self._since > PATIENCE_S:
            raise self._lost()

    def _replace(self, there: int) -> None:
        """Starts processes of its own again that Dask has given up: those that took long to come
        back, as on a busy machine, or died as they started.
        """
        own = self._client.cluster
        if own is not None and there < len(own.worker_spec):
            own.scale(len(own.worker_spec))

    def _lost(self) -> SkyquiltError:
        return SkyquiltError(
            f"the Dask scheduler {self._name} or all its workers are gone; start them, then run the"
            " same command again: it goes on where this one stopped"
        )


class _Pickler(cloudpickle.Pickler):  # type: ignore[misc]
    """Writes paths as absolute ones: workers have another current folder."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, PurePath) and not obj.is_absolute():
            return Path, (str(Path(obj).absolute()),)
        return super().reducer_override(obj)


def _version() -> list[str]:
    """What must be alike in all processes."""
    return [
        f"skyquilt {__version__}",
        f"Python {platform.python_version()}",
        f"OpenCV {cv2.__version__}",
    ]


_steps: OrderedDict[str, Callable[[Any], Any]] = OrderedDict()
_reading = threading.Lock()


def _unfit(path: str) -> str:
    """Why this process cannot take part in what the file describes; empty if it can."""
    try:
        with Path(path).open("rb") as file:
            about = pickle.load(file)
    except OSError:
        return f"it does not see {path}; the run's folder must lie where all workers see it"
    if about["version"] != _version():
        return f"it has {', '.join(_version())} instead of {', '.join(about['version'])}"
    for seen in about["sees"]:
        if not Path(seen).exists():
            return f"it does not see {seen}; the photos must lie where all workers see them"
    return ""


def _step(path: str) -> Callable[[Any], Any]:
    """The work of a step, read once."""
    with _reading:
        if path not in _steps:
            if wrong := _unfit(path):
                raise UsageError(f"the worker {platform.node()} cannot take part: {wrong}")
            cv2.setNumThreads(1)  # as many tasks run as there are threads
            return_large_blocks()  # Dask has every free give memory back, which costs more time
            with Path(path).open("rb") as file:
                pickle.load(file)
                _steps[path] = pickle.load(file)
            while len(_steps) > STEPS_KEPT:
                _steps.popitem(last=False)
        _steps.move_to_end(path)
        return _steps[path]


def _size(spent_s: Collection[float]) -> int:
    """How many items the next task gets, so that it takes about `TASK_S` if they take as long as
    the last ones: neighbours use the same photos, and handing out a task costs milliseconds.
    """
    if not spent_s:
        return 1
    return max(1, min(MOST_ITEMS, round(TASK_S * len(spent_s) / max(sum(spent_s), 1e-6))))


def _do(path: str, items: list[Any]) -> tuple[list[Any], list[float]]:
    """One task: the results of its items, and the seconds that each took."""
    work, results, seconds = _step(path), [], []
    for item in items:
        began = time.monotonic()
        results.append(work(item))
        seconds.append(time.monotonic() - began)
    return results, seconds
