"""Keeps the state of the flight against its plan, in the server's process: the mapping does not
wait for it.
"""

import os
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

from skyquilt.engine.error_log import log_error
from skyquilt.errors import OutputError
from skyquilt.live.ledger import Ledger
from skyquilt.live.live_map import PHOTOS
from skyquilt.live.mission import Mission, MissionState
from skyquilt.planning.records import Plan

PAUSE_S = 1.0
"""Pause in s between looks at the ledger."""
BUDGET = 2
"""Photos measured for blur in one look, so that the mapping keeps its processors."""
WRITE_S = 10.0
"""Shortest time in s between files."""
NICE = 15
"""Niceness of the thread where the system has one per thread."""


class MissionWatch:
    """Looks at the ledger when it has changed and tells events `plan` and `coverage`. As a context
    manager it runs in a separate thread.
    """

    def __init__(self, folder: Path, plan: Plan | None) -> None:
        self.folder = folder
        self.plan = plan
        self.state: MissionState | None = None
        self._mission = Mission(folder=folder, plan=plan)
        self._lock = threading.Lock()
        self._stamp, self._told = -1, ""
        self._written = 0.0
        self._stale = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="mission")

    def __enter__(self) -> "MissionWatch":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join(10)

    def _run(self) -> None:
        if sys.platform == "linux":  # only there a thread has its own niceness
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        ledger = Ledger(self.folder, write=True)
        try:
            while not self._stop.wait(PAUSE_S):
                try:
                    self.step(ledger)
                except OutputError:
                    continue  # the disk is full: the mapping reports it
                except Exception as error:  # the map and its viewer go on
                    log_error(self.folder, "the state of the plan", error)
        finally:
            with suppress(OutputError):
                self.step(ledger, now=True)
            ledger.close()

    def step(self, ledger: Ledger, *, now: bool = False) -> MissionState:
        """The newest state; with `now` every photo is measured, and the files are written."""
        with self._lock:
            # photos are the only thing that counts; events of our own would wake us for ever
            row = ledger.row("select max(seq) from event where kind in ('photo', 'tiles')")
            stamp = int(row[0] or 0) if row else 0
            waiting = self._mission.waiting
            if self.state is None or stamp != self._stamp or waiting or now:
                self._stamp = stamp
                budget = 10**9 if now else BUDGET
                self.state = self._mission.look(ledger, self.folder / PHOTOS, budget=budget)
                self._stale = True
                self._tell(ledger, self.state)
            if self._stale and (now or time.monotonic() - self._written > WRITE_S):
                self._written, self._stale = time.monotonic(), False
                self._mission.write(self.state)
            return self.state

    def _tell(self, ledger: Ledger, state: MissionState) -> None:
        kinds = ("planned", "taken", "missing", "unsharp")
        counts = {k: sum(s == k for s in state.points.values()) for k in kinds}
        said = {"share": round(state.share, 5), "missing_m2": round(state.missing_m2, 1)}
        key = f"{counts} {said}"
        if key == self._told:
            return
        self._told = key
        if self.plan is not None:
            ledger.tell("plan", {"state": "flying", **counts})
        ledger.tell("coverage", {**said, "views": state.views})
