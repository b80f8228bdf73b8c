"""Runs the server in a separate process, so that the number of viewers does not slow down the
mapping.
"""

import ctypes
import multiprocessing
import os
import signal
import socket
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from skyquilt.engine.error_log import log_error
from skyquilt.engine.memory_watch import MemoryWatch, enough_files
from skyquilt.errors import SkyquiltError, UsageError
from skyquilt.live.fill import known_plan
from skyquilt.live.inbox import Inbox
from skyquilt.live.ledger import Ledger
from skyquilt.live.live_map import PHOTOS
from skyquilt.live.photo_intake import Intake
from skyquilt.live.settings import LiveSettings
from skyquilt.server.access import Guard
from skyquilt.server.mission_watch import MissionWatch
from skyquilt.server.published_files import PublishedFiles
from skyquilt.server.server_thread import ServerThread, address, bound
from skyquilt.server.survey import LiveSurvey

PATIENCE_S = 60.0
"""Longest time in s that the process may take to start."""
RESTART_S = 10.0
"""Pause in s before another attempt to start the process."""
NICE = 5
"""Niceness of the server process: the mapping has priority."""


class UploadEndpoint:
    """Receives photos and layers in the server process; the mapping reads them from the ledger."""

    def __init__(self, folder: Path, settings: LiveSettings) -> None:
        self.ledger = Ledger(folder, write=True)
        inbox = Inbox(self.ledger, folder / PHOTOS, most_bytes=settings.most_bytes, tidy=False)
        self.intake = Intake(self.ledger, inbox, settings)


@dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """Settings of the server process."""

    folder: Path
    """The survey's folder."""
    settings: LiveSettings
    """Settings of the live map, for its limits."""
    guard: Guard
    """Access rules."""
    parent: int = field(default_factory=os.getpid)
    """The process that starts it, with which it ends."""
    most_memory: int = 1_500_000_000
    """Resident memory in bytes at which it is ended and started anew; 0 = no limit."""
    base: tuple[Path, ...] = ()
    """Older maps as further layers."""


@dataclass(kw_only=True)
class ServerProcess:
    """A running server and the files it publishes. As a context manager it stops at the end of its
    block.

    If its process ends unexpectedly, another one is started on the same socket.
    """

    asked: ServerConfig
    """Settings of the process."""
    port: int = 0
    """Port on which it listens; 0 = a free port, which can be read here after the start."""
    _ending: threading.Event = field(default_factory=threading.Event)
    _parts: dict[str, Any] = field(default_factory=dict)

    def __enter__(self) -> Self:
        """Starts it.

        Raises:
            UsageError: packages are missing, the address is in use, or `base` is not a map.
        """
        listening = bound(self.asked.guard.host, self.port)
        self.port = int(listening.getsockname()[1])
        self._parts["socket"] = listening
        problem = self._start()
        if problem:
            listening.close()
            raise UsageError(problem)
        self._parts["thread"] = threading.Thread(target=self._keep, daemon=True, name="viewer")
        self._parts["thread"].start()
        return self

    def _start(self) -> str:
        """Starts a process; returns why it could not be started, empty if it runs."""
        context = multiprocessing.get_context("spawn")
        wire, theirs = context.Pipe()
        process = context.Process(
            target=_serve,
            args=(self._parts["socket"], self.asked, theirs, wire),
            daemon=True,
            name="viewer",
        )
        process.start()
        theirs.close()
        self._parts |= {"process": process, "wire": wire}
        try:
            return str(wire.recv()) if wire.poll(PATIENCE_S) else "the viewer does not start"
        except (EOFError, OSError):  # or this server ended meanwhile
            return "the viewer's process ended during its start"

    def _keep(self) -> None:
        while True:
            self._parts["process"].join()
            if self._ending.wait(1.0):
                return
            log_error(self.asked.folder, "the viewer's process ended and is started anew", "")
            while (problem := self._again()) and not self._ending.is_set():
                log_error(self.asked.folder, f"it does not start: {problem}", "")
                if self._ending.wait(RESTART_S):
                    return

    def _again(self) -> str:
        """Starts another process; returns why it could not be started, empty if it runs."""
        if sys.platform == "win32":
            # a socket there stays with the completion port of the first process that waited on it
            self._parts["socket"].close()
            try:
                self._parts["socket"] = bound(self.asked.guard.host, self.port)
            except UsageError as error:
                return str(error)
        return self._start()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ending.set()
        self._parts["wire"].close()
        self._parts["thread"].join(5)  # this thread waits for the process
        if self._parts["thread"].is_alive():
            self._parts["process"].terminate()
            self._parts["thread"].join(5)
        self._parts["socket"].close()

    @property
    def url(self) -> str:
        """URL of the viewer."""
        return address(self.asked.guard.host, self.port)


def _end_with_parent(parent: int) -> None:
    """On Linux, the system ends this process when the one that started it is killed."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    if os.getppid() != parent:
        os._exit(0)


def _too_large(asked: ServerConfig, taken: int) -> None:
    """Ends the process; its parent starts another one on the same socket."""
    text = f"the viewer took {taken / 1e9:.1f} of {asked.most_memory / 1e9:.1f} GB and is restarted"
    log_error(asked.folder, text, "")
    sys.stderr.write(f"skyquilt: {text}\n")
    sys.stderr.flush()
    os._exit(3)


def _serve(
    listening: socket.socket, asked: ServerConfig, wire: Connection, other: Connection
) -> None:
    """Main function of the process: serves until its parent closes the pipe or ends."""
    other.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl+C
    _end_with_parent(asked.parent)
    enough_files()  # each connection is one
    if sys.platform != "win32":
        with suppress(OSError):
            os.nice(NICE)
    try:
        survey = LiveSurvey(asked.folder, base=asked.base)
        door = UploadEndpoint(asked.folder, asked.settings)
        watch = MissionWatch(asked.folder, known_plan(asked.folder))
        with (
            watch,
            ServerThread(
                survey=survey,
                guard=asked.guard,
                folder=asked.folder,
                writer=door,
                watch=watch,
                listening=listening,
            ),
            PublishedFiles(LiveSurvey(asked.folder), asked.folder),
        ):
            wire.send("")
            with MemoryWatch(limit=asked.most_memory, end=partial(_too_large, asked)):
                try:
                    wire.recv()
                except (EOFError, OSError):
                    if os.getppid() != asked.parent:
                        os._exit(0)  # the parent was killed: the port must be free at once
    except SkyquiltError as error:
        with suppress(OSError):
            wire.send(str(error))
