"""Runs the server in a separate thread, on a socket that is bound before anything else starts."""

import errno
import socket
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from skyquilt.errors import PIP, UsageError
from skyquilt.server.access import Guard
from skyquilt.server.shown import Survey

RETRY_S = 2.0
"""If the port is in use, it is tried again for this time in s."""
NEEDED = (
    "the live map and its viewer need the packages of the extra `live`; in the folder of the"
    f' source: make install, or {PIP} install -c constraints.txt ".[live]"'
)


def bound(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 = a free one.

    Raises:
        UsageError: the address is in use, or does not belong to this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # TCP given explicitly, so that responses are sent at once (no delay by Nagle's algorithm)
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    # the option of the same name lets two programs listen on one port of Windows
    if sys.platform == "win32":
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
    else:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    until = time.monotonic() + RETRY_S
    while True:
        try:
            listening.bind((host, port))
            break
        except OSError as error:
            if error.errno == errno.EADDRINUSE and time.monotonic() < until:
                time.sleep(0.1)  # a former run may be ending
                continue
            listening.close()
            raise UsageError(
                f"cannot listen on {host}:{port} ({error.strerror or error}); choose another --port"
                " or --host"
            ) from error
        except (UnicodeError, ValueError) as error:
            listening.close()
            raise UsageError(f"--host {host!r} is not an address of this machine") from error
    listening.listen(512)  # connections made before the server is ready wait in a queue
    return listening


@dataclass(kw_only=True)
class ServerThread:
    """A running server. As a context manager it stops at the end of its block."""

    survey: Survey
    """The survey that it shows."""
    guard: Guard
    """Access rules."""
    folder: Path
    """The survey's folder."""
    writer: Any = None
    """The growing map; None for a finished run."""
    watch: Any = None
    """A `MissionWatch` that follows the plan of a live survey."""
    port: int = 0
    """Port on which it listens; 0 = a free port, which can be read here after the start."""
    listening: socket.socket | None = None
    """A socket that is already listening; None = one is created."""
    _parts: dict[str, Any] = field(default_factory=dict)

    def __enter__(self) -> Self:
        """Starts it.

        Raises:
            UsageError: packages are missing, or the address is in use.
        """
        try:
            import uvicorn

            from skyquilt.server.app import make_app
            from skyquilt.server.connections import limited
        except ImportError as error:
            raise UsageError(NEEDED) from error
        listening = self.listening or bound(self.guard.host, self.port)
        self.port = int(listening.getsockname()[1])
        app = make_app(self.survey, self.guard, self.writer, self.folder, self.watch)
        config = uvicorn.Config(
            app,
            log_level="error",
            timeout_graceful_shutdown=1,
            limit_concurrency=1000,
            http=limited(self.guard.most_connections),
            ws="none",
            server_header=False,
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(
            target=server.run, kwargs={"sockets": [listening]}, daemon=True, name="viewer"
        )
        thread.start()
        self._parts = {
            "server": server,
            "thread": thread,
            "socket": listening,
            "ending": app.state.ending,
        }
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._parts["ending"].set()
        self._parts["server"].should_exit = True
        self._parts["thread"].join(5)
        self._parts["socket"].close()

    @property
    def url(self) -> str:
        """URL of the viewer."""
        return address(self.guard.host, self.port)


def address(host: str, port: int) -> str:
    """URL to open in a browser."""
    host = "127.0.0.1" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    return f"http://{host}:{port}/"
