"""Map events for viewers, as server-sent events."""

import asyncio
import threading
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import Query, Request
from fastapi.responses import StreamingResponse

from skyquilt.outside import whole
from skyquilt.server.access import Context
from skyquilt.server.survey import LiveSurvey
from skyquilt.version import __version__

WAIT_S = 0.1
"""Longest pause in s between checks for new events."""
LISTEN_S = 0.02
"""Pause in s between checks whether the survey may have changed."""
KEEP_ALIVE_S = 5.0
"""If there are no events, `here` is sent at this interval in s: a client that hears nothing for
longer has lost the connection. (A comment would do for proxies, but pages do not see comments.)
"""


class EventEndpoints:
    """The endpoint of events."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self.ending = threading.Event()

    async def events(
        self, request: Request, after: Annotated[int | None, Query(ge=0, le=2**53)] = None
    ) -> StreamingResponse:
        """Server-sent events: photo, tiles, layer, note, refused, finish; `Last-Event-ID` or
        `after` continue after that event.
        """
        said = whole(request.headers.get("last-event-id", ""), 0, 2**53)
        known = after if said is None else said
        newest = self.context.survey.version()
        start = newest if known is None else min(known, newest)  # it may be of another survey
        return StreamingResponse(
            self._news(request, start),
            media_type="text/event-stream",
            headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
        )

    async def _news(self, request: Request, last: int) -> AsyncIterator[str]:
        yield f": skyquilt {__version__}\nretry: 1000\n\n"
        quiet = 0.0
        while not self.ending.is_set() and not await request.is_disconnected():
            told = (
                self.context.survey.ledger.told(last)
                if isinstance(self.context.survey, LiveSurvey)
                else []
            )
            for number, kind, body in told:
                yield f"id: {number}\nevent: {kind}\ndata: {body}\n\n"
                last = number
            quiet = 0.0 if told else quiet + WAIT_S
            if quiet >= KEEP_ALIVE_S:
                quiet = 0.0
                yield "event: here\ndata: {}\n\n"
            if len(told) < 100:
                await self._pause()

    async def _pause(self) -> None:
        """Waits until there may be new events."""
        known = self.context.survey.stamp()
        for _ in range(round(WAIT_S / LISTEN_S)):
            await asyncio.sleep(LISTEN_S)
            if self.context.survey.stamp() != known:
                return
