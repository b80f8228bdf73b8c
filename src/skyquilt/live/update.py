"""Result of one unit of work."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Update:
    """Describes one unit of work that was done."""

    what: str
    """placed, waiting, refined, loose, refused, drawn, closed or noted."""
    photo: int | None = None
    """The photo concerned."""
    moved: tuple[int, ...] = ()
    """Photos that have moved."""
    tiles: int = 0
    """Tiles written."""
    text: str = ""
    """A message for the user; may be empty."""
    seconds: float = 0.0
    """Duration in s."""
