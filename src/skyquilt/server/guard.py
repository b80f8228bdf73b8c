"""Who may do what: tokens, hosts, limits, headers."""

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
"""Sent with every answer. Scripts come from this server only; a base map's pictures may come from
elsewhere.
"""


@dataclass(frozen=True, kw_only=True)
class Guard:
    """What protects a server."""

    host: str = "127.0.0.1"
    """The address it listens on."""
    token: str | None = None
    """What writing asks for; None = nothing, on this machine only."""
    most_layer_bytes: int = 20_000_000
    """Largest posted layer."""
    most_layers: int = 200
    """Most layers."""
    most_uploads: int = 200
    """Uploads under way at a time."""
    upload_stall_s: float = 10.0
    """An upload of which nothing comes for so long has lost its connection."""
    upload_idle_s: float = 600.0
    """One that nobody went on with for so long no longer counts as under way."""
    upload_keep_s: float = 24 * 3600.0
    """One that nobody went on with for so long is dropped."""

    def __post_init__(self) -> None:
        if self.token is None and not local(self.host):
            raise UsageError(
                f"--host {self.host} can be reached from other machines, and nothing protects the"
                " map against"
                " writing; add --token with a secret, or listen on 127.0.0.1"
            )
        if self.token is not None and len(self.token) < 8:
            raise UsageError(f"--token has {len(self.token)} characters; take at least 8")

    def admits(self, given: str | None) -> bool:
        """Whether a request may write: its `Authorization: Bearer ...` or `X-Token` holds the
        token.
        """
        if self.token is None:
            return True
        said = (given or "").removeprefix("Bearer ").strip()
        return hmac.compare_digest(said.encode(), self.token.encode())

    def knows(self, host_header: str) -> bool:
        """Whether a request was meant for this server: names that others let point here are refused
        (DNS rebinding).
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
