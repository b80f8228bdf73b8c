"""Names for the moments at which something has just become durable: what crash tests are aimed
at.
"""

from collections.abc import Callable

POINTS = (
    "photo file synced",
    "photo file named",
    "photo row committed",
    "photo placed",
    "tiles written",
    "drawing told",
    "photo refined",
    "block closed",
    "folder seen",
    "published",
)
"""All of them, in the order that a photo passes them."""


def _nothing(name: str) -> None:
    """Nobody is waiting."""


watcher: Callable[[str], None] = _nothing
"""Called with the name of each point that is reached; a test puts its own here."""


def hit(name: str) -> None:
    """Says that a point is passed."""
    watcher(name)
