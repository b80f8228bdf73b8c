"""What one unit of work did."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Update:
    """One unit of work done."""

    what: str
    """placed, waiting, refined, loose, refused, drawn, closed or noted."""
    photo: int | None = None
    """The photo it was about."""
    moved: tuple[int, ...] = ()
    """Photos that lie elsewhere now."""
    tiles: int = 0
    """Tiles written."""
    text: str = ""
    """A sentence, where there is something to say."""
    seconds: float = 0.0
    """Time it took."""
