"""Time that passes as a test says: what a watched folder waits for has not to be waited for."""

import time
from collections.abc import Iterator
from unittest import mock

from skyquilt.live import folder_watch
from skyquilt.live.folder_watch import Watch
from skyquilt.live.photo_intake import Accepted, Refused


class Clock:
    """Stands for the module `time` while a folder is looked at."""

    thread_time = staticmethod(time.thread_time)

    def __init__(self) -> None:
        self.now = time.monotonic()

    def monotonic(self) -> float:
        return self.now

    def look(self, watch: Watch, step: float) -> Iterator[Accepted | Refused]:
        """What is taken or refused now; so many seconds pass after it."""
        with mock.patch.object(folder_watch, "time", self):
            yield from watch.look()
        self.now += step
