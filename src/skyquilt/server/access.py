"""Who may do what: tokens, hosts, limits, headers, packing; and what all addresses share."""

import asyncio
import hmac
import ipaddress
import socket
import sqlite3
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

from fastapi import HTTPException, Request
from fastapi.responses import JSONResponse
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skyquilt.engine.error_log import log_error
from skyquilt.errors import OutputError, UsageError
from skyquilt.live.ledger import Ledger
from skyquilt.live.photo_intake import Intake
from skyquilt.outside import plain
from skyquilt.raster.map_source import MapSource
from skyquilt.server.shown import Survey
from skyquilt.server.survey import LiveSurvey

RESUMABLE = "/photos/uploads"
"""The address of resumable uploads."""
TUS = {"Tus-Resumable": "1.0.0"}
"""Sent with every answer from there."""

SLOWEST, GRACE_S = 200.0, 60.0
"""Slowest rate of a body in bytes/s, and the time in s after which it counts."""
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob: https:;"
    " style-src 'self' 'unsafe-inline'; script-src 'self'; connect-src 'self'; object-src 'none';"
    " frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Sent with every response. Scripts are loaded from this server only; images of a base map may come
from other servers.
"""


@dataclass(frozen=True, kw_only=True)
class Guard:
    """Access rules and limits of a server."""

    host: str = "127.0.0.1"
    """The host name or address on which it listens."""
    token: str | None = None
    """Token required for writing. None = no token; allowed only if the server listens on this
    machine alone.
    """
    most_layer_bytes: int = 20_000_000
    """Largest layer in bytes."""
    most_layers: int = 200
    """Largest number of layers."""
    most_uploads: int = 200
    """Largest number of uploads at a time."""
    most_uploads_each: int = 60
    """Largest number of uploads at a time from one address."""
    most_connections: int = 200
    """Largest number of connections from one address."""
    allow_hosts: tuple[str, ...] = ()
    """Further names under which clients may address the server."""
    public_url: str | None = None
    """Address under which a reverse proxy shows the server, `https://host/path/`; None = there is
    none.
    """
    upload_stall_s: float = 10.0
    """If no data arrive for this time in s, the connection of an upload counts as lost."""
    upload_empty_s: float = 600.0
    """An upload that was announced, and of which no byte arrived for this time in s, is deleted."""
    upload_idle_s: float = 30.0
    """An upload that was not continued for this time in s no longer counts as active."""
    upload_keep_s: float = 24 * 3600.0
    """An upload that was not continued for this time in s is deleted."""

    def __post_init__(self) -> None:
        if self.token is None and not local(self.host):
            raise UsageError(
                f"--host {self.host} can be reached from other machines, and the map is not"
                " protected against"
                " writing; add --token with a secret, or listen on 127.0.0.1"
            )
        if self.token is not None and len(self.token) < 8:
            raise UsageError(f"--token has {len(self.token)} characters; use at least 8")
        if self.public_url is not None:
            _check_public(self.public_url)

    @property
    def public_host(self) -> str:
        """Host, and port if given, of the public address; empty if there is none."""
        return urlsplit(self.public_url).netloc.lower() if self.public_url else ""

    def base(self, request: Request) -> str:
        """The address under which clients reach the server, with a slash at its end."""
        return (self.public_url or str(request.base_url)).rstrip("/") + "/"

    def admits(self, given: str | None) -> bool:
        """Whether a request may write: its header `Authorization: Bearer ...` or `X-Token` contains
        the token.
        """
        if self.token is None:
            return True
        said = (given or "").removeprefix("Bearer ").strip()
        return hmac.compare_digest(said.encode(), self.token.encode())

    def knows(self, host_header: str) -> bool:
        """Whether the host name of a request is a name of this server. Other names that resolve to
        it are refused (protection against DNS rebinding).
        """
        name = host_header.rsplit(":", 1)[0] if not host_header.endswith("]") else host_header
        name = name.strip("[]").rstrip(".").lower()
        public = urlsplit(f"//{self.public_host}").hostname
        if local(name) or name == public or name in {n.lower() for n in self.allow_hosts}:
            return True
        if local(self.host):
            return False
        if name == self.host.strip("[]").lower() or name in _machine():
            return True
        try:  # an address is no name that could be made to point elsewhere
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return self.host in ("0.0.0.0", "::", "")


def _check_public(url: str) -> None:
    """Raises `UsageError` where an address is none that a reverse proxy can have."""
    try:
        parts = urlsplit(url)
        usual = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0
    except ValueError:
        usual, parts = False, urlsplit("")
    strange = parts.query or parts.fragment or "@" in parts.netloc or not url.isprintable()
    if not usual or strange or set(url) & set(' "<>{}\\'):
        raise UsageError(
            f"--public-url {plain(url, 80)!r} is no address under which a reverse proxy shows a"
            " map, such as https://host/map/"
        )


@cache
def _machine() -> frozenset[str]:
    """Names of this machine."""
    name = socket.gethostname().lower()
    return frozenset({name, f"{name}.local", socket.getfqdn().lower()})


def local(host: str) -> bool:
    """Whether an address means this machine only."""
    bare = host.strip("[]").lower()
    if bare == "localhost":
        return True
    try:
        return ipaddress.ip_address(bare).is_loopback
    except ValueError:
        return False


class Packed:
    """Sends long texts compressed to those who take them so: the page's scripts and the list of
    photos are most of what a viewer loads over a weak link. Pictures and files are left alone.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.plain, self.packing = app, GZipMiddleware(app, minimum_size=1000, compresslevel=6)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        text = scope["type"] == "http" and scope["method"] == "GET"
        text = text and (scope["path"] in ("/", "/photos") or scope["path"].startswith("/static/"))
        await (self.packing if text else self.plain)(scope, receive, send)


class Guarded:
    """Middleware: refuses requests for other hosts and adds the security headers to every
    response.
    """

    def __init__(self, app: ASGIApp, guard: Guard, log: Path | None = None) -> None:
        """`log`: folder of the log of errors."""
        self.app, self.guard, self.log = app, guard, log

    async def _answered(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers a request; errors that no endpoint foresaw are answered in one place."""
        started = False

        async def sending(message: Message) -> None:
            nonlocal started
            started = True
            await send(message)

        try:
            await self.app(scope, receive, sending)
        except Exception as error:
            code, text = 500, "the server failed; its log tells more"
            if isinstance(error, OutputError):
                code, text = 507, str(error)
            elif isinstance(error, sqlite3.Error):
                code, text = 503, f"the survey cannot be read now ({error})"
            elif isinstance(error, ClientDisconnect):
                return
            elif self.log is not None:
                log_error(self.log, f"{scope['method']} {scope['path']}", error)
            if not started:
                await JSONResponse({"detail": text}, code)(scope, receive, send)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        always, asked = HEADERS, Headers(scope=scope)
        if scope["path"].startswith(RESUMABLE):
            always = HEADERS | TUS
            # tus: a header for clients that cannot send PATCH or DELETE
            method = asked.get("x-http-method-override", scope["method"])
            scope = {**scope, "method": method.upper()}

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in always.items():
                    headers.setdefault(name, value)
            await send(message)

        if self.guard.knows(asked.get("host", "")):
            await self._answered(scope, receive, with_headers)
            return
        names = "localhost only" if local(self.guard.host) else "its own names (--allow-host)"
        refused = JSONResponse({"detail": f"this server answers requests to {names}"}, 421)
        await refused(scope, receive, with_headers)


def client_of(request: Request) -> str:
    """The address of a client, for limits."""
    return request.client.host if request.client else ""


HEARD_S = 0.25
"""How often in s a request that waits for data asks whether the server ends."""


async def blocks_of(request: Request, patience_s: float) -> AsyncIterator[bytes]:
    """The blocks of a body as they arrive.

    Raises:
        TimeoutError: no data arrived for `patience_s`, or they arrive too slowly to be of use.
        ClientDisconnect: the connection was lost, or the server ends.
    """
    stream, began, size = request.stream(), time.monotonic(), 0
    ending = request.app.state.ending
    while True:
        coming = asyncio.ensure_future(anext(stream, None))
        until = time.monotonic() + patience_s
        try:
            while not (await asyncio.wait({coming}, timeout=HEARD_S))[0]:
                if ending.is_set():
                    raise ClientDisconnect
                if time.monotonic() > until:
                    raise TimeoutError
            block = coming.result()
        finally:
            coming.cancel()
        if block is None:
            return
        size += len(block)
        if size < SLOWEST * (time.monotonic() - began - GRACE_S):
            raise TimeoutError
        yield block


class Writer(Protocol):
    """The growing map that receives photos and layers."""

    intake: Intake
    ledger: Ledger


class Context:
    """The shared state of one survey's endpoints."""

    def __init__(self, survey: Survey, guard: Guard, writer: Writer | None) -> None:
        self.survey, self.guard, self.writer = survey, guard, writer

    def layer(self, name: str | None) -> tuple[str, MapSource]:
        """A layer by its name; None gives the first one. Its source is found in the same look: a
        moment later a final map may be gone.
        """
        return self._one_of(self.survey.layers(), name)

    def drawn(self, name: str | None) -> tuple[str, MapSource]:
        """The same for what the page draws: also layers of a map without a place."""
        return self._one_of(self.survey.layers() | self.placeless(), name)

    def placeless(self) -> dict[str, MapSource]:
        """Layers of a growing map without a place; empty where there is none."""
        return self.survey.placeless() if isinstance(self.survey, LiveSurvey) else {}

    @staticmethod
    def _one_of(known: dict[str, MapSource], name: str | None) -> tuple[str, MapSource]:
        if name is None and known:
            return next(iter(known.items()))
        if name is None or name not in known:
            raise HTTPException(
                404,
                f"there is no layer {str(name)[:60]!r}; there are {', '.join(known) or 'none yet'}",
            )
        return name, known[name]

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
        self.admitted(request)
        return writer

    def admitted(self, request: Request) -> None:
        """An HTTP error if the request may not write: it lacks the token, or another site sent
        it.
        """
        given = request.headers.get("authorization") or request.headers.get("x-token")
        if not self.guard.admits(given):
            raise HTTPException(
                401,
                "writing needs the token that the server was started with",
                {"WWW-Authenticate": "Bearer"},
            )
        origin = request.headers.get("origin")
        if origin is None:
            return
        own = {request.headers.get("host", ""), self.guard.public_host} - {""}
        if origin.split("://")[-1].lower() not in {name.lower() for name in own}:
            raise HTTPException(403, "pages of other sites may not write here")
