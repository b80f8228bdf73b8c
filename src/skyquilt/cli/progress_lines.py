"""Progress where there is no terminal (a log file, a service): a line when a stage has ended, and
one every half minute while it lasts.
"""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from skyquilt.model.event import Event, Note, Result, StageFinished, StageProgress, StageStarted
from skyquilt.outside import shown

EVERY_S = 30.0
"""Time in s between two lines while a stage lasts."""


@dataclass(kw_only=True)
class ProgressLines:
    """Follows the events of a run. As a context manager it ends its clock with its block."""

    write: Callable[[str], None]
    """Takes a line."""
    verbose: bool = False
    """Add the CPU time of every stage."""
    every_s: float = EVERY_S
    """Time in s between two lines while a stage lasts."""
    _stage: str = ""
    _since: float = 0.0
    _done: int = 0
    _total: int = 0
    _what: str = ""
    _end: threading.Event = field(default_factory=threading.Event)

    def __enter__(self) -> Self:
        # a stage may compute for minutes without an event, so a clock of its own tells that it runs
        threading.Thread(target=self._tell, daemon=True, name="progress").start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end.set()

    def follow(self, events: Iterable[Event]) -> Result:
        """Consumes the events; the last one is the result."""
        for happened in events:
            if isinstance(happened, StageStarted):
                self._since, self._done, self._total = time.monotonic(), 0, happened.total
                self._stage, self._what = happened.stage, ""
            elif isinstance(happened, StageProgress):
                self._done, self._total, self._what = happened.done, happened.total, happened.what
            elif isinstance(happened, StageFinished):
                self._stage = ""
                self.write(_ended(happened, verbose=self.verbose))
            elif isinstance(happened, Note):
                self.write(("warning: " if happened.warning else "") + shown(happened.text))
            elif isinstance(happened, Result):
                result = happened
        return result

    def _tell(self) -> None:
        while not self._end.wait(self.every_s):
            if stage := self._stage:
                part = f", {self._done} of {self._total}" if self._total else ""
                what = f" ({self._what})" if self._what else ""
                self.write(f"{stage}: {time.monotonic() - self._since:.0f} s so far{part}{what}")


def _ended(happened: StageFinished, *, verbose: bool) -> str:
    how = " (from an earlier run)" if happened.reused else ""
    cpu = f", {happened.cpu_seconds:.2f} s of CPU" if verbose else ""
    return f"{happened.stage}: {happened.seconds:.2f} s{cpu}{how}"
