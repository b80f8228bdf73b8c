"""Parts of a long step: kept, so that an interrupted run need not repeat them, and shared out."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from skyquilt.engine.workers import HERE, Workers

T = TypeVar("T")
Held = Callable[[str, Callable[[], Any]], Any]
"""Gives what is kept under a name, else what the function makes, which is then kept."""


@dataclass(frozen=True, kw_only=True)
class Keep:
    """Gives the parts of a step by name: those kept of an interrupted run, or made now."""

    held: Held | None = None
    """Keeps them; None = nothing is kept."""
    has: Callable[[str], bool] | None = None
    """Whether a name is kept, as far as can be said without reading it; None = none is."""
    workers: Workers = HERE
    """Make parts that do not depend on one another."""
    prefix: str = ""
    """Begins the names of all parts."""
    told: Callable[[str], None] | None = None
    """Hears the name of each part before it is given or made; it may end the step by raising."""

    def __call__(self, part: str, make: Callable[[], T], /) -> T:
        """The part; `make` computes it."""
        self.tell(part)
        if self.held is None:
            return make()
        found: T = self.held(self.prefix + part, make)
        return found

    def tell(self, part: str) -> None:
        """Says that a part begins."""
        if self.told is not None:
            self.told(self.prefix + part)

    def missing(self, parts: Iterable[str]) -> list[str]:
        """Those of these parts that will be made, in their order."""
        return [part for part in parts if self.has is None or not self.has(self.prefix + part)]

    def within(self, name: str) -> "Keep":
        """Gives the parts of a part."""
        return replace(self, prefix=f"{self.prefix}{name} ")

    def __reduce__(self) -> tuple[Callable[..., "Keep"], tuple[Held | None, str]]:
        return _elsewhere, (self.held, self.prefix)


def _elsewhere(held: Held | None, prefix: str) -> Keep:
    """In another process, which is one of the workers: it asks no others."""
    return Keep(held=held, prefix=prefix)


MADE_NOW = Keep()
"""Keeps nothing."""
