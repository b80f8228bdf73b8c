"""Notes about photos that come one after the other: at the first, and whenever there are twice as
many.
"""

from collections.abc import Callable, Iterable

from skyquilt.live.ledger import Ledger
from skyquilt.outside import whole

MOST_NOTED = 10**9
"""Most photos that a note counts."""


def tell_doubled(ledger: Ledger, key: str, count: int, notes: Callable[[], Iterable[str]]) -> None:
    """Tells notes about `count` photos if these are twice as many as when it was told last; that
    number is kept under a name in the ledger.
    """
    noted = whole(ledger.meta(key, 0), 0, MOST_NOTED) or 0
    if count < max(1, 2 * noted):
        return
    with ledger.change():
        ledger.put_meta(key, count)
        for note in notes():
            ledger.tell("note", {"text": note})
