"""Features of photos and links between them, as they are found and as they are written down."""

from collections import OrderedDict
from collections.abc import Collection, Iterable, Sequence
from functools import lru_cache

import numpy as np

from skyquilt.config import Methods
from skyquilt.model.features import Features, Link
from skyquilt.pipelines.intake import Looked, features_key, look
from skyquilt.pipelines.live.state import Member, Members
from skyquilt.run.codec import decode, encode
from skyquilt.run.pixel_cache import PixelCache
from skyquilt.run.store import Store

FEATURES_KEPT = 48
"""Photos whose features stay at hand."""
ENOUGH = 5
"""Links that hold a new photo; further neighbours are not compared."""
LINKS_KEPT = 1500
"""Links decoded and at hand, of some kilobytes each."""


class Linking:
    """Compares photos."""

    def __init__(
        self, members: Members, methods: Methods, store: Store, pixels: PixelCache
    ) -> None:
        self.members, self.methods, self.store, self.pixels = members, methods, store, pixels
        self._features: OrderedDict[int, Features] = OrderedDict()

    def has_features(self, number: int) -> bool:
        """Whether a photo's features are at hand."""
        return number in self._features

    def features(self, number: int) -> Features:
        """Features of a photo: at hand, from the store, or found now."""
        if number in self._features:
            self._features.move_to_end(number)
            return self._features[number]
        photo = self.members.by_id[number].photo
        key = features_key(photo, self.methods)
        looked: Looked = self.store.get_or(
            "features", key, lambda: look(photo, number, self.pixels, self.methods, self.store)
        )
        self._features[number] = looked.features
        while len(self._features) > FEATURES_KEPT:
            self._features.popitem(last=False)
        return looked.features

    def compared(self, member: Member, others: Sequence[int]) -> dict[tuple[int, int], Link | None]:
        """Links to others, one after the other until enough hold; None where a pair does not
        match.
        """
        own = self.features(member.id)
        found: dict[tuple[int, int], Link | None] = {}
        for i in others:
            if sum(link is not None for link in found.values()) >= ENOUGH:
                break
            theirs = self.features(i)
            matches = self.methods.mutual(theirs, own)
            link = self.methods.verify(
                i, member.id, theirs, own, matches, self.members.by_id[i].photo.width
            )
            found[i, member.id] = link if isinstance(link, Link) else None
        return found

    def links_among(
        self, ids: Iterable[int], touching: Collection[int] | None = None
    ) -> list[Link]:
        """Known links between these photos, or only those that hold one of `touching`."""
        inside = set(ids)
        ends = inside if touching is None else touching
        pairs = sorted(
            {(min(i, j), max(i, j)) for i in ends for j in self.members.by_id[i].links & inside}
        )
        return [k for a, b in pairs if (k := self.link(a, b)) is not None]

    def link(self, a: int, b: int) -> Link | None:
        """A known link; None where there is none."""
        for i, j in ((a, b), (b, a)):
            row = self.members.ledger.row("select body from link where a = ? and b = ?", i, j)
            if row is not None and row[0] is not None:
                return link_from(row[0])
        return None


def link_bytes(link: Link) -> bytes:
    """A link for the ledger."""
    return encode(
        {
            "a": link.a,
            "b": link.b,
            "ia": link.index_a.astype(np.int32),
            "ib": link.index_b.astype(np.int32),
            "s": complex(link.b_S_a),
        }
    )


@lru_cache(maxsize=LINKS_KEPT)
def link_from(body: bytes) -> Link:
    """The link of such bytes; every photo asks for the same links of its surroundings."""
    d = decode(body, {})
    return Link(
        a=d["a"],
        b=d["b"],
        index_a=d["ia"].astype(np.int64),
        index_b=d["ib"].astype(np.int64),
        b_S_a=d["s"],
    )
