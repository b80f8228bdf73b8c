"""Features of photos and links between photos: computed, stored and read."""

from collections import OrderedDict
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.aligners import KEYPOINTS
from skyquilt.alignment.nothing_shown import one_tone
from skyquilt.engine.codec import decode, encode
from skyquilt.engine.pixel_cache import PixelCache
from skyquilt.engine.store import Store
from skyquilt.live.failures import concerning
from skyquilt.live.ledger import DAMAGED
from skyquilt.live.lenses import LiveLenses
from skyquilt.live.marks import LiveMarks
from skyquilt.live.members import Member, Members
from skyquilt.model.features import Features, Link, numbers
from skyquilt.workflows.links import link_pair, marked_in
from skyquilt.workflows.methods import Methods
from skyquilt.workflows.photo_features import PhotoFeatures, photo_features, picture_of

FEATURES_KEPT = 48
"""Number of photos whose features are kept in memory."""
ENOUGH = 5
"""Number of links that are enough for a new photo; further neighbours are not compared."""
LINKS_KEPT = 1500
"""Number of decoded links kept in memory, of a few kilobytes each."""


class LiveLinks:
    """Finds features and matches pairs of photos."""

    def __init__(
        self, members: Members, methods: Methods, store: Store, pixels: PixelCache[NDArray[Any]]
    ) -> None:
        self.members, self.methods, self.store, self.pixels = members, methods, store, pixels
        self._features: OrderedDict[int, PhotoFeatures] = OrderedDict()
        self.marks = LiveMarks(members, self.features, self.thumbnail)
        self.lenses = LiveLenses(members, self.features)

    def has_features(self, number: int) -> bool:
        """Whether a photo's features are in memory."""
        return number in self._features

    def features(self, number: int) -> Features:
        """Features of a photo: from memory, from the store, or computed now."""
        return self._look(number).features

    def detail(self, number: int) -> NDArray[np.float32]:
        """(rows, columns, 3) how sharp a photo is in its cells (`imaging.grey.detail`)."""
        return self._look(number).detail

    def thumbnail(self, number: int) -> NDArray[np.uint8]:
        """A photo reduced, (h, w[, bands])."""
        return self._look(number).thumbnail

    def _look(self, number: int) -> PhotoFeatures:
        if number in self._features:
            self._features.move_to_end(number)
            return self._features[number]
        photo, pixels = self.members.by_id[number].photo, self.pixels
        with concerning(number):
            look = photo_features(photo, lambda: pixels(number), self.methods.detector, self.store)
        self._features[number] = look
        while len(self._features) > FEATURES_KEPT:
            self._features.popitem(last=False)
        return look

    def shows_nothing(self, number: int, *, compared: bool) -> bool:
        """Whether a photo without links is black or white all over. One that could not be compared
        yet may be a dark photo of a flight at night, unless it has hardly any features.
        """
        if not compared and len(self.features(number)) >= KEYPOINTS:
            return False
        photo = self.members.by_id[number].photo
        return one_tone(photo, lambda longest: picture_of(self.pixels(number), longest))

    def compared(self, member: Member, others: Sequence[int]) -> dict[tuple[int, int], Link | None]:
        """Links to other photos, compared one after the other until there are enough links; None
        where a pair does not match.
        """
        camera = member.photo.camera_key
        marked = self.marks.look(camera)
        bent = self.lenses.asks(member.photo) and self.lenses.bent(camera, self._of(camera))
        if marked or bent:
            self._compare_again(camera, marked=marked, bent=bent)
        found: dict[tuple[int, int], Link | None] = {}
        for i in others:
            if sum(link is not None for link in found.values()) >= ENOUGH:
                break
            found[i, member.id] = self._compared(i, member.id)
        return found

    def _compared(self, a: int, b: int) -> Link | None:
        """The link of two photos; None where they do not match."""
        photos = self.members.by_id[a].photo, self.members.by_id[b].photo
        two = self.features(a), self.features(b)
        marked = marked_in(self.marks.known, photos, (0, 1), two)
        link = link_pair(a, b, two, photos, self.methods, marked=marked)
        return link if isinstance(link, Link) else None

    def _of(self, camera: str) -> list[Link]:
        """Links of a camera's photos."""
        return self.links_among(self.members.by_id, self._ids(camera))

    def _ids(self, camera: str) -> set[int]:
        """The photos of a camera."""
        return {i for i, m in self.members.by_id.items() if m.photo.camera_key == camera}

    def _compare_again(self, camera: str, *, marked: bool, bent: bool) -> None:
        """Links of a camera's photos anew, after marks were found on its pictures, on which they
        may rest alone, or another kind of lens. What did not match before may do so now: without
        the matches of marks, which look like ground that repeats, or by the other lens.
        """
        before = {(k.a, k.b) for k in self._of(camera)}
        ids, again = self._ids(camera), set(before)
        for i in ids if bent else ():
            self._features.pop(i, None)  # found in pictures that are not straightened
        if marked:
            again |= {p for i in ids for p in self.members.ledger.unlike(i) if ids.issuperset(p)}
        links = [(a, b, self._compared(a, b)) for a, b in sorted(again)]
        with self.members.ledger.change():
            self.members.ledger.put_links(
                [(a, b, None if k is None else link_bytes(k)) for a, b, k in links]
            )
            if marked:
                self.marks.keep(camera)
            if bent:
                self.members.save_fisheye(camera)
                self.members.ledger.forget_unlike(ids)
        for a, b, link in links:
            if link is None and (a, b) in before:
                self.members.parted(a, b)
            elif link is not None and (a, b) not in before:
                self.members.joined(a, b)

    def links_among(
        self, ids: Iterable[int], touching: Collection[int] | None = None
    ) -> list[Link]:
        """Stored links between these photos, or only those with at least one photo of
        `touching`.
        """
        inside = set(ids)
        ends = inside if touching is None else touching
        pairs = sorted(
            {(min(i, j), max(i, j)) for i in ends for j in self.members.by_id[i].links & inside}
        )
        return [k for a, b in pairs if (k := self.link(a, b)) is not None]

    def link(self, a: int, b: int) -> Link | None:
        """A stored link; None if there is none."""
        for i, j in ((a, b), (b, a)):
            row = self.members.ledger.row("select body from link where a = ? and b = ?", i, j)
            if row is not None and row[0] is not None:
                with suppress(*DAMAGED):  # then it counts as none
                    return link_from(row[0])
        return None


def link_bytes(link: Link) -> bytes:
    """A link encoded for the ledger."""
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
    """Decodes a link. Cached, since each new photo needs the same links of its surroundings."""
    d = decode(body, {})
    return Link(
        a=d["a"], b=d["b"], index_a=numbers(d["ia"]), index_b=numbers(d["ib"]), b_S_a=d["s"]
    )
