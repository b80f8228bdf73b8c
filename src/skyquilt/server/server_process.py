"""The viewer in a process of its own: however many look on, they take no turn from the one that
places photos.
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
from skyquilt.server.guard import Guard
from skyquilt.server.published_files import PublishedFiles
from skyquilt.server.server_thread import ServerThread, address, bound
from skyquilt.server.survey import LiveSurvey

PATIENCE_S = 60.0
"""How long the process may take to begin."""
NICE = 5
"""Placing photos comes first."""


class UploadEndpoint:
    """Where photos and layers are handed in; the mapping finds them in the ledger."""

    def __init__(self, folder: Path, settings: LiveSettings) -> None:
        self.ledger = Ledger(folder, write=True)
        inbox = Inbox(self.ledger, folder / PHOTOS, most_bytes=settings.most_bytes, tidy=False)
        self.intake = Intake(self.ledger, inbox, settings)


@dataclass(frozen=True, kw_only=True)
class ServerConfig:
    """What the process is to serve."""

    folder: Path
    """The survey's folder."""
    settings: LiveSettings
    """Its limits."""
    guard: Guard
    """Who may write."""
    base: Path | None = None
    """An older orthophoto."""


@dataclass(kw_only=True)
class ServerProcess:
    """A running server and the files it publishes; as a context manager it ends with its block.

    Should its process die, another one takes its place on the same socket.
    """

    asked: ServerConfig
    """What it serves."""
    port: int = 0
    """Where it listens; 0 = a free port, to be read afterwards."""
    _ending: threading.Event = field(default_factory=threading.Event)
    _parts: dict[str, Any] = field(default_factory=dict)

    def __enter__(self) -> Self:
        """Starts it.

        Raises:
            UsageError: packages are missing, the address is taken, or `base` is no map.
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
        """Begins a process; why it could not, empty where it runs."""
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
            return str(wire.recv()) if wire.poll(PATIENCE_S) else "the viewer does not begin"
        except EOFError:
            return "the viewer's process ended as it began"

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
        self._parts["thread"].join(5)  # it alone waits for the process
        if self._parts["thread"].is_alive():
            self._parts["process"].terminate()
            self._parts["thread"].join(5)
        self._parts["socket"].close()

    @property
    def url(self) -> str:
        """Where to look."""
        return address(self.asked.guard.host, self.port)


def _serve(
    listening: socket.socket, asked: ServerConfig, wire: Connection, other: Connection
) -> None:
    """The process: serves until its parent closes the wire, or is gone."""
    other.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
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
