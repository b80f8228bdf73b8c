"""Runs the server in a separate process, so that the number of viewers does not slow down the
mapping.
"""

import multiprocessing
import os
import signal
import socket
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from skyquilt.errors import SkyquiltError, UsageError
from skyquilt.live.inbox import Inbox
from skyquilt.live.ledger import Ledger
from skyquilt.live.live_map import PHOTOS
from skyquilt.live.photo_intake import Intake
from skyquilt.live.settings import LiveSettings
from skyquilt.server.access import Guard
from skyquilt.server.published_files import PublishedFiles
from skyquilt.server.server_thread import ServerThread, address, bound
from skyquilt.server.survey import LiveSurvey

PATIENCE_S = 60.0
"""Longest time in s that the process may take to start."""
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
    base: Path | None = None
    """An older orthophoto as a further layer; None = none."""


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
        except EOFError:
            return "the viewer's process ended during its start"

    def _keep(self) -> None:
        while True:
            self._parts["process"].join()
            if self._ending.wait(1.0) or self._start():
                return

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


def _serve(
    listening: socket.socket, asked: ServerConfig, wire: Connection, other: Connection
) -> None:
    """Main function of the process: serves until its parent closes the pipe or ends."""
    other.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl+C
    with suppress(OSError, AttributeError):
        os.nice(NICE)
    try:
        survey = LiveSurvey(asked.folder, base=asked.base)
        door = UploadEndpoint(asked.folder, asked.settings)
        with (
            ServerThread(
                survey=survey,
                guard=asked.guard,
                folder=asked.folder,
                writer=door,
                listening=listening,
            ),
            PublishedFiles(LiveSurvey(asked.folder), asked.folder),
        ):
            wire.send("")
            with suppress(EOFError, OSError):
                wire.recv()
    except SkyquiltError as error:
        with suppress(OSError):
            wire.send(str(error))
