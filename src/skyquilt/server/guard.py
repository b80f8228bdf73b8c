"""Protection of the server: tokens, hosts, limits and headers."""

import hmac
import ipaddress
from dataclasses import dataclass

from skyquilt.errors import UsageError

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
    upload_stall_s: float = 10.0
    """If no data arrive for this time in s, the connection of an upload counts as lost."""
    upload_idle_s: float = 600.0
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
        if self.token is not None or not local(self.host):
            return True
        return local(
            host_header.rsplit(":", 1)[0] if not host_header.endswith("]") else host_header
        )


def local(host: str) -> bool:
    """Whether an address means this machine only."""
    bare = host.strip("[]").lower()
    if bare == "localhost":
        return True
    try:
        return ipaddress.ip_address(bare).is_loopback
    except ValueError:
        return False
