"""Names for the moments at which data has just become durable. Crash tests end the process at these
points.
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
"""All crash points, in the order in which a photo passes them."""


def _nothing(name: str) -> None:
    """Does nothing: the default outside tests."""


watcher: Callable[[str], None] = _nothing
"""Called with the name of each point that is reached. Tests replace it."""


def hit(name: str) -> None:
    """Reports that a point was reached."""
    watcher(name)
