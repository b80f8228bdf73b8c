"""State shared by all endpoints: the survey and the write permissions."""

from typing import Protocol

from fastapi import HTTPException, Request

from skyquilt.live.ledger import Ledger
from skyquilt.live.photo_intake import Intake
from skyquilt.server.guard import Guard
from skyquilt.server.survey import Survey


class Writer(Protocol):
    """The growing map that receives photos and layers."""

    intake: Intake
    ledger: Ledger


class Context:
    """The shared state of one survey's endpoints."""

    def __init__(self, survey: Survey, guard: Guard, writer: Writer | None) -> None:
        self.survey, self.guard, self.writer = survey, guard, writer

    def layer(self, name: str | None) -> str:
        """Checks the name of a layer; None gives the first layer."""
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
        """The growing map; an HTTP error if the survey is read-only."""
        if self.writer is None:
            raise HTTPException(
                405, "this survey is read-only; 'skyquilt live' accepts photos and layers"
            )
        return self.writer

    def writing(self, request: Request) -> Writer:
        """The growing map, if the request is allowed to write to it; otherwise an HTTP error."""
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
