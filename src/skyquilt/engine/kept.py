"""Parts of a long step that an interrupted run need not repeat."""

from collections.abc import Callable
from typing import Protocol, TypeVar

T = TypeVar("T")


class Keep(Protocol):
    """Gives a part of a result by its name: the one kept of an interrupted run, or made now."""

    def __call__(self, part: str, make: Callable[[], T], /) -> T:
        """The part; `make` computes it."""
        ...


def made_now(_: str, make: Callable[[], T], /) -> T:
    """Keeps nothing."""
    return make()


def within(keep: Keep, name: str) -> Keep:
    """Keeps parts of a part."""
    if keep is made_now:
        return keep

    def inner(part: str, make: Callable[[], T], /) -> T:
        return keep(f"{name} {part}", make)

    return inner
