"""A second look at photos that no link connects with the others: with many more features.

Forests, crops and water have few features that are alike in two photos, and the strongest ones of a
photo are rarely those of its neighbour. Among five times as many there mostly are enough; to look
for so many in all photos would be a waste. Where these connect nothing either, a few pairs are
compared with one photo mirrored or in negative, and a note names it where that is why.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.tracks import blocks_of
from skyquilt.engine.clock import Steps
from skyquilt.engine.store import Store, digest
from skyquilt.engine.workers import Workers
from skyquilt.imaging.grey import shrink
from skyquilt.matching.candidates import Pair
from skyquilt.matching.fixed_marks import FixedMarks
from skyquilt.matching.matchers import Guided
from skyquilt.model.features import Features, Link, RejectedLink, numbers
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Prior
from skyquilt.workflows.links import Links, link_pair, marked_in, seen_as
from skyquilt.workflows.methods import Countable, Methods
from skyquilt.workflows.photo_features import PICTURE, FeaturedPhotos, GreyPictures, features_recipe

MORE = 5
"""How many times as many features are looked for."""
TRIED = 6
"""Pairs that are compared again for each of these photos."""
SAME_PX = 0.5
"""Features closer to one another than this, in px of the image that is searched, are the same."""
CHANGED_TRIED = 6
"""Pairs, each with another photo outside the largest block, of which one photo is changed."""
CHANGED_LINKS = 2
"""Pairs that must be linked then, for a note."""
CAUSES = {
    "mirrored": "a program or a camera setting has mirrored some of them; mirror these back",
    "in negative": "some of them are negatives, or their thermal palette was reversed (white hot,"
    " black hot); invert these",
}
"""What programs and cameras do to some photos of a survey, and features do not survive; what a user
is told to do.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class CloserLook:
    """Gives many features of photos, and compares these."""

    photos: Sequence[Photo]
    """The photos."""
    grey: GreyPictures
    """Their grey images."""
    methods: Methods
    """Finds, matches and verifies features."""
    store: Store
    """Keeps the features."""
    marks: FixedMarks = field(default_factory=FixedMarks)
    """What the pictures show at the same place each."""

    def __call__(self, photo: int) -> Features:
        """Features of a photo (index)."""
        detector, one = self.methods.detector, self.photos[photo]
        key = digest(one.pixels_key, "closer", features_recipe(detector))

        def found() -> Features:
            small, _ = shrink(self.grey(photo, PICTURE), detector.longest)
            return detector.of_shrunken(small, (one.height, one.width))

        return self.store.get_or("features", key, found)

    def changed(self, pair: Pair, how: str, first: Features) -> bool:
        """Whether two photos are linked where the second one is changed; `first`: usual features of
        the first.
        """
        a, b = pair
        detector, two = self.methods.detector, (self.photos[a], self.photos[b])
        names = seen_as(two[0]), seen_as(two[1])
        recipe = features_recipe(detector), self.methods.matcher, self.methods.verify

        def compared() -> list[bool]:
            small, _ = shrink(self.grey(b, PICTURE), detector.longest)
            shown = changed_picture(small, how)
            second = detector.of_shrunken(shown, (two[1].height, two[1].width))
            return [isinstance(link_pair(a, b, (first, second), two, self.methods), Link)]

        key = digest(names, how, CHANGED_LINKS, recipe)
        return bool(self.store.get_or("links", key, compared)[0])

    def prepare(self, photo: int) -> None:
        """Finds the features of a photo (index), so that its pairs need not."""
        self(photo)

    def pair(self, pair: Pair) -> Link | RejectedLink:
        """The link of two photos, or the reason why there is none."""
        a, b = pair
        names = seen_as(self.photos[a]), seen_as(self.photos[b])
        methods = self.methods
        recipe = (features_recipe(methods.detector), methods.matcher, methods.verify, self.marks)

        def compared() -> Link | RejectedLink:
            two = self(a), self(b)
            marked = marked_in(self.marks, self.photos, pair, two)
            photos = self.photos[a], self.photos[b]
            return link_pair(a, b, two, photos, methods, marked=marked)

        found = self.store.get_or("links", digest(names, "closer", recipe), compared)
        return replace(found, a=a, b=b)


def connect(
    found: FeaturedPhotos,
    links: Links,
    priors: Sequence[Prior],
    grey: GreyPictures,
    methods: Methods,
    store: Store,
    workers: Workers,
) -> Steps[tuple[FeaturedPhotos, Links]]:
    """The photos and their links after the second look: pairs that failed and would connect photos
    with the largest block are compared again. New features follow those found before.
    """
    yield 0, 1
    pairs, detector = unconnected(len(found.photos), links, priors), methods.detector
    if not pairs or isinstance(methods.matcher, Guided) or not isinstance(detector, Countable):
        return found, links
    more = replace(methods, detector=detector.counted(MORE * detector.count))
    look = CloserLook(photos=found.photos, grey=grey, methods=more, store=store, marks=links.marks)
    photos = sorted({i for pair in pairs for i in pair})
    total, better = len(photos) + len(pairs), list[Link]()
    for done, _ in enumerate(workers.each(look.prepare, photos)):
        yield done + 1, total
    for done, link in enumerate(workers.each(look.pair, pairs)):
        yield len(photos) + done + 1, total
        if isinstance(link, Link):
            better.append(link)
    still = set(pairs) - {(k.a, k.b) for k in better}
    usual = replace(look, methods=methods)
    links = replace(links, changed=changed_notes(sorted(still), usual, found))
    if not better:
        return found, links
    again = frozenset(i for k in better for i in (k.a, k.b))
    names = {i: _numbers(found.features[i], look(i)) for i in sorted(again)}
    joined = {
        (k.a, k.b): replace(
            k, index_a=numbers(names[k.a][k.index_a]), index_b=numbers(names[k.b][k.index_b])
        )
        for k in better
    }
    whole = sorted([*links.links, *joined.values()], key=lambda k: (k.a, k.b))
    rest = tuple(k for k in links.rejected if (k.a, k.b) not in joined)
    linked = replace(links, links=tuple(whole), rejected=rest)
    return replace(found, closer=look, again=again), linked


def changed_picture(grey: NDArray[np.uint8], how: str) -> NDArray[np.uint8]:
    """A grey image (h, w) changed in one of the ways of `CAUSES`; twice, it is as it was."""
    changed = cv2.flip(grey, 1) if how == "mirrored" else cv2.bitwise_not(grey)
    return np.asarray(changed, np.uint8)


def changed_notes(
    failed: Sequence[Pair], look: CloserLook, found: FeaturedPhotos
) -> tuple[str, ...]:
    """What keeps pairs from being linked that are linked with one photo changed: one note at most
    for each of `CAUSES`. Pairs of photos with marks tell nothing, since marks are linked with
    themselves.
    """
    tried, seen = list[Pair](), set[int]()
    for pair in failed:
        cameras = {found.photos[i].camera_key for i in pair}
        if seen.isdisjoint(pair) and cameras.isdisjoint(look.marks.masks):
            tried.append(pair)
            seen.update(pair)
    if len(tried) < CHANGED_LINKS:
        return ()  # no note could come of them, and features of changed pictures cost time
    spread = np.unique(np.linspace(0, len(tried) - 1, CHANGED_TRIED, dtype=int))
    tried = [tried[k] for k in spread.tolist()]
    out = list[str]()
    for how, cause in CAUSES.items():
        linked = [k for k in tried if look.changed(k, how, found.features[k[0]])]
        if len(linked) >= CHANGED_LINKS:
            a, b = (found.photos[i].name for i in linked[0])
            out.append(
                f"Some photos show the ground {how} against others, and these do not connect, such"
                f" as {a} and {b}: {cause}, or map them by themselves."
            )
    return tuple(out)


def unconnected(count: int, links: Links, priors: Sequence[Prior]) -> list[Pair]:
    """Pairs that failed, of photos that links do not connect: for each photo outside the largest
    block those nearest to it.
    """
    block = blocks_of(count, links.links)
    largest = int(np.bincount(block).argmax()) if count else 0
    xy = np.array([p.map_C[:2] for p in priors]).reshape(-1, 2)

    def away(pair: Pair) -> tuple[float, int]:
        apart = float(np.hypot(*(xy[pair[0]] - xy[pair[1]])))
        return (apart if np.isfinite(apart) else np.inf), abs(pair[0] - pair[1])

    failed = sorted(
        ((k.a, k.b) for k in links.rejected if block[k.a] != block[k.b]),
        key=lambda pair: (*away(pair), pair),
    )
    tried, chosen = np.zeros(count, int), set[Pair]()
    for pair in failed:
        outside = [i for i in pair if block[i] != largest]
        if any(tried[i] < TRIED for i in outside):
            tried[outside] += 1
            chosen.add(pair)
    return sorted(chosen)


def _numbers(features: Features, more: Features) -> NDArray[np.int64]:
    """The number of each of the second features among both: that of the first one at its place, or
    its own after all of these.
    """
    own = len(features) + np.arange(len(more))
    if not len(features):
        return own
    from scipy.spatial import cKDTree  # most surveys need it for nothing else

    distance, nearest = cKDTree(features.px).query(more.px)
    return np.where(distance < SAME_PX * more.scale, nearest, own)
