"""What all addresses share: the survey, and who may write to it."""

from typing import Protocol

from fastapi import HTTPException, Request

from skyquilt.live.ledger import Ledger
from skyquilt.live.photo_intake import Intake
from skyquilt.server.guard import Guard
from skyquilt.server.survey import Survey


class Writer(Protocol):
    """The growing map that photos and layers are handed to."""

    intake: Intake
    ledger: Ledger


class Context:
    """Of one survey."""

    def __init__(self, survey: Survey, guard: Guard, writer: Writer | None) -> None:
        self.survey, self.guard, self.writer = survey, guard, writer

    def layer(self, name: str | None) -> str:
        """The layer of a name, or the first one."""
        known = self.survey.layers()
        if name is None and known:
            return next(iter(known))
        if name not in known:
            raise HTTPException(
                404,
                f"there is no layer {str(name)[:60]!r}; there are {', '.join(known) or 'none yet'}",
            )
        return str(name)

    def growing(self) -> Writer:
        """The growing map, where there is one."""
        if self.writer is None:
            raise HTTPException(
                405, "this survey is only looked at; 'skyquilt live' takes photos and layers"
            )
        return self.writer

    def writing(self, request: Request) -> Writer:
        """The growing map, for a request that may write to it."""
        writer = self.growing()
        given = request.headers.get("authorization") or request.headers.get("x-token")
        if not self.guard.admits(given):
            raise HTTPException(
                401,
                "writing needs the token that the server was started with",
                {"WWW-Authenticate": "Bearer"},
            )
        origin = request.headers.get("origin")
        if origin is not None and origin.split("://")[-1] != request.headers.get("host", ""):
            raise HTTPException(403, "pages of other sites may not write here")
        return writer
