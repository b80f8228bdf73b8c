"""Connections of the server: bounded per address and in time, so that nobody keeps others out."""

import time
from collections import defaultdict
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

HEADER_S = 10.0
"""Longest time in s from the opening of a connection, or from the end of the last response, until
the head of a request is complete.
"""
SENDING_S = 30.0
"""A client that takes no byte of a response for this time in s is disconnected."""
SWEEP_S = 1.0
MOST = 900
"""Largest number of connections."""
_FULL = (
    b"HTTP/1.1 429 Too Many Requests\r\nRetry-After: 5\r\nConnection: close\r\n"
    b"Content-Length: 0\r\n\r\n"
)


class Connections:
    """The open connections of a server."""

    def __init__(self, most_per_address: int) -> None:
        self.most_per_address = most_per_address
        self.by_address: dict[str, dict[LimitedProtocol, None]] = defaultdict(dict)
        self._sweeping = False

    def opened(self, one: "LimitedProtocol") -> bool:
        """Takes a connection; False if there are too many. Where others only wait to send the head
        of a request, the oldest of these is closed instead.
        """
        mine = self.by_address[one.address]
        if len(mine) >= self.most_per_address and not _close_oldest(list(mine)):
            return False
        everyone = [c for some in self.by_address.values() for c in some]
        if len(everyone) >= MOST and not _close_oldest(everyone):
            return False
        self.by_address[one.address][one] = None
        if not self._sweeping:
            self._sweeping = True
            one.loop.call_later(SWEEP_S, self._sweep, one.loop)
        return True

    def closed(self, one: "LimitedProtocol") -> None:
        """Forgets a connection."""
        mine = self.by_address.get(one.address, {})
        mine.pop(one, None)
        if not mine:
            self.by_address.pop(one.address, None)

    def _sweep(self, loop: Any) -> None:
        """Closes connections that are late."""
        now = time.monotonic()
        for one in [c for some in self.by_address.values() for c in some]:
            if one.late(now):
                one.transport.abort()
        self._sweeping = bool(self.by_address)
        if self._sweeping:
            loop.call_later(SWEEP_S, self._sweep, loop)


class LimitedProtocol(H11Protocol):
    """HTTP/1.1 on one connection, with limits."""

    table: Connections

    def connection_made(self, transport: Any) -> None:
        """Counts the connection for its address."""
        super().connection_made(transport)
        self.address = str(self.client[0]) if self.client else ""
        self.since = time.monotonic()
        self._pending, self._sent = 0, self.since
        self.refused = not self.table.opened(self)
        if self.refused:
            transport.write(_FULL)
            transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forgets the connection."""
        self.table.closed(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Passes data on, unless the connection was refused."""
        if self.refused:
            return
        try:
            super().data_received(data)
        except Exception:  # a request so broken that no answer can be formed
            self.transport.abort()

    def on_response_complete(self) -> None:
        """From now on the head of the next request is awaited."""
        self.since = time.monotonic()
        super().on_response_complete()

    @property
    def waits(self) -> bool:
        """Whether no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    def late(self, now: float) -> bool:
        """Whether the client is too slow with a request, or with taking the response."""
        if self.waits and now - self.since > HEADER_S:
            return True
        pending = self.transport.get_write_buffer_size()
        if pending == 0 or pending != self._pending:
            self._pending, self._sent = pending, now
        return now - self._sent > SENDING_S


def _close_oldest(some: list[LimitedProtocol]) -> bool:
    """Closes the connection that has waited longest to send a request; False if none waits."""
    waiting = min((c for c in some if c.waits), key=lambda c: c.since, default=None)
    if waiting is None:
        return False
    waiting.table.closed(waiting)
    waiting.transport.abort()
    return True


def limited(most_per_address: int) -> type[LimitedProtocol]:
    """The protocol class of one server."""
    table = Connections(most_per_address)
    return type("Protocol", (LimitedProtocol,), {"table": table})
