"""Finds photos that show the same ground: candidate pairs, matches, verified links."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.oblique import looked_at
from skyquilt.alignment.pose import ByPose
from skyquilt.alignment.start import ground_of
from skyquilt.alignment.tracks import blocks_of
from skyquilt.engine.clock import Steps
from skyquilt.engine.free_memory import give_back_growth
from skyquilt.engine.store import Store, digest
from skyquilt.engine.workers import Workers
from skyquilt.geometry.set_aside import InFile
from skyquilt.imaging.nodes import View, project_nodes
from skyquilt.imaging.views import make_views, on_ground
from skyquilt.matching.candidates import Pair, by_camera, closest, overlap_reach_m, sequence
from skyquilt.matching.fixed_marks import FindFixedMarks, FixedMarks
from skyquilt.matching.lens_kind import fisheye_note, fisheyes, may_be_fisheye
from skyquilt.matching.matchers import Guided
from skyquilt.matching.straightened import straightened_features
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link, Matches, RejectedLink, numbers
from skyquilt.model.photo import Photo
from skyquilt.model.poses import MapFrame, Prior
from skyquilt.ortho.tie_surface import level
from skyquilt.workflows.methods import Methods
from skyquilt.workflows.photo_features import PICTURE, FeaturedPhotos, GreyPictures, features_recipe


class ExpectedPlaces:
    """Photos projected to level ground by their reported poses."""

    def __init__(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        priors: Sequence[Prior],
        height_m: float | None = None,
    ) -> None:
        """Places the photos; `height_m`: height above ground if the altitudes do not give it.

        Raises:
            AlignmentError: no photo has a position, a heading and a height above ground.
        """
        self.key = digest(frame, list(priors), [(p.camera_key, p.focal.px) for p in photos])
        self._ground = level(0.0)
        placed = ByPose(height_m=height_m)(photos, frame, priors)
        self._views: dict[int, View] = {v.photo: v for v in make_views(placed, self._ground)}

    def __call__(self, a: int, b: int, px: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 2) px of photo b for px (n, 2) of photo a; NaN where metadata do not place both."""
        if a not in self._views or b not in self._views:
            return np.full((len(px), 2), np.nan)
        xyz = on_ground(self._views[a], px, self._ground)
        nodes = project_nodes(self._views[b], xyz[None, :, 0], xyz[None, :, 1], xyz[None, :, 2])
        places = np.stack([nodes.u[0], nodes.v[0]], -1).astype(np.float64)
        return np.where((np.abs(places) < 1e6).all(1, keepdims=True), places, np.nan)


APART = 0.1
"""Where more photos than this share are not connected with most others, positions do not tell which
overlap: cameras look to all sides. Those are asked for by their content,
"""
ASIDE = 6.0
"""within so many times the distance at which photos usually overlap: what looks alike farther away
is other ground.
"""
BATCH = 24
"""Most pairs of a stored artefact: those of one photo with later ones, which one worker matches."""


LONG = 1_000_000
"""Matches of a survey beyond which they lie in files: they are needed now and then only."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Links:
    """Verified links and refused pairs."""

    links: tuple[Link, ...] = ()
    """Pairs that show the same ground."""
    rejected: tuple[RejectedLink, ...] = ()
    """Pairs that do not, with reasons."""
    marks: FixedMarks = field(default_factory=FixedMarks)
    """What pictures show at the same place each, and does not connect them."""
    matches: tuple[InFile, ...] = ()
    """Where the keypoints of all links lie."""
    lenses: tuple[str, ...] = ()
    """Notes on lenses whose kind was found by them."""
    changed: tuple[str, ...] = ()
    """Notes on photos that are mirrored or in negative against others."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know."""
        return (*self.marks.notes, *self.lenses, *self.changed)

    def make_room(self) -> None:
        """Gives back the memory of matches that were used."""
        for part in self.matches:
            part.release()


@dataclass(frozen=True, kw_only=True, eq=False)
class PackedLinks:
    """Pairs in their order, and what was found of each, as they are stored: a few long arrays are
    read faster than two short ones of each link.
    """

    pairs: NDArray[np.int32]
    """(n, 2) photos."""
    ends: NDArray[np.int64]
    """(n + 1,) where the matches of each pair begin in the lists of all."""
    index_a: NDArray[np.integer[Any]]
    """(M,) keypoints of the pairs' first photos."""
    index_b: NDArray[np.integer[Any]]
    """(M,) keypoints of their second ones."""
    b_S_a: NDArray[np.complex128]
    """(n,) scale and rotation, see `Link`."""
    reasons: tuple[str | None, ...]
    """Why a pair is none; None of links."""

    @staticmethod
    def of(found: Sequence[Link | RejectedLink]) -> "PackedLinks":
        """What was found of some pairs."""
        links = [k for k in found if isinstance(k, Link)]
        return PackedLinks(
            pairs=np.array([(k.a, k.b) for k in found], np.int32).reshape(-1, 2),
            ends=np.cumsum([0, *(len(k) if isinstance(k, Link) else 0 for k in found)]),
            index_a=_joined([k.index_a for k in links]),
            index_b=_joined([k.index_b for k in links]),
            b_S_a=np.array([k.b_S_a if isinstance(k, Link) else 0 for k in found], complex),
            reasons=tuple(None if isinstance(k, Link) else k.reason for k in found),
        )

    def in_files(self) -> tuple[InFile, InFile]:
        """The two lists of keypoints, in files if they are long."""
        long = len(self.index_a) > LONG
        return InFile(self.index_a, large=long), InFile(self.index_b, large=long)

    def __iter__(self) -> Iterator[Link | RejectedLink]:
        """The pairs; their arrays are parts of the long ones."""
        ranges = pairwise(self.ends.tolist())
        for k, ((a, b), (low, high)) in enumerate(zip(self.pairs.tolist(), ranges, strict=True)):
            reason = self.reasons[k]
            if reason is not None:
                yield RejectedLink(a=a, b=b, reason=reason)
                continue
            yield Link(
                a=a,
                b=b,
                index_a=self.index_a[low:high],
                index_b=self.index_b[low:high],
                b_S_a=complex(self.b_S_a[k]),
            )


def _joined(parts: Sequence[NDArray[np.integer[Any]]]) -> NDArray[np.integer[Any]]:
    return numbers(np.concatenate([np.zeros(0, np.uint16), *parts]))


def link_pair(
    a: int,
    b: int,
    features: tuple[Features, Features],
    photos: tuple[Photo, Photo],
    methods: Methods,
    expected: NDArray[np.float64] | None = None,
    marked: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None = None,
) -> Link | RejectedLink:
    """The link of photos a and b (numbers), or the reason why there is none.

    `expected` (len(features of a), 2): positions in px of a's keypoints in b predicted from
    metadata, NaN where unknown; needed by a guided matcher only. `marked`: which keypoints of each
    lie on fixed marks; their matches are not used.
    """
    if isinstance(methods.matcher, Guided):
        assert expected is not None, "a guided matcher needs predicted positions"
        matches = methods.matcher.for_width(photos[0].width)(*features, expected)
    else:
        matches = methods.matcher(*features)
    matches = _on_ground(matches, marked)
    lenses = photos[0].lens, photos[1].lens
    wide = lenses if lenses[0].fisheye or lenses[1].fisheye else None
    return methods.verify(a, b, *features, matches, photos[0].width, wide)


def _on_ground(
    matches: Matches, marked: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None
) -> Matches:
    """Matches without those on marks."""
    if marked is None:
        return matches
    ground = ~(marked[0][matches.index_a] | marked[1][matches.index_b])
    return Matches(index_a=matches.index_a[ground], index_b=matches.index_b[ground])


class _Linker:
    """Verifies pairs of one survey; the keys of artefacts depend on the photos and the methods."""

    def __init__(
        self,
        found: FeaturedPhotos,
        frame: MapFrame,
        priors: Sequence[Prior],
        methods: Methods,
        store: Store,
    ) -> None:
        self.found, self.methods, self.store = found, methods, store
        self.features = found.features
        self.marks = marks_of(found.photos, found.features)
        self.expected: ExpectedPlaces | None = None
        if isinstance(methods.matcher, Guided):
            height = methods.matcher.height_m
            self.expected = ExpectedPlaces(found.photos, frame, priors, height)
        by = None if self.expected is None else self.expected.key
        self.xy = np.array([p.map_C[:2] for p in priors]).reshape(-1, 2)
        """Positions (n, 2) in m; NaN where unknown."""
        self.views = looked_at(priors, ground_of(frame))
        """Places by which photos with like views are near to one another; None where positions
        alone tell which photos may show the same.
        """
        if self.views is None:  # cameras that tell no number of theirs have a folder each
            cameras = [f"{p.camera_key} {p.path.parent}" for p in found.photos]
            self.views = by_camera(cameras, self.xy)
        self._recipe = digest(
            features_recipe(methods.detector), methods.matcher, methods.verify, by, self.marks
        )

    def nearest(self, reach_m: float | None = None) -> list[Pair]:
        """Pairs, nearest first, of photos within a reach in m (None: any) by their views, then of
        those within it by their positions.
        """
        pairs = self.methods.nearest(self.xy, reach_m)
        if self.views is None:
            return pairs
        return [*self.methods.nearest(self.views, reach_m), *pairs]

    def one(self, pair: Pair) -> Link | RejectedLink:
        a, b = pair
        two = self.features[a], self.features[b]
        places = None if self.expected is None else self.expected(a, b, two[0].px)
        marked = marked_in(self.marks, self.found.photos, pair, two)
        photos = self.found.photos[a], self.found.photos[b]
        return link_pair(a, b, two, photos, self.methods, places, marked)

    def batch(self, pairs: Sequence[Pair]) -> list[Link | RejectedLink]:
        """Links of a batch. They are stored by content: photos that join the survey later change
        the indices, but not what is stored of other photos.
        """
        photos = self.found.photos
        names = [(seen_as(photos[i]), seen_as(photos[j])) for i, j in pairs]
        kept = self.store.get_or(
            "links",
            digest(names, self._recipe),
            lambda: PackedLinks.of([self.one(pair) for pair in pairs]),
        )
        return [replace(k, a=i, b=j) for k, (i, j) in zip(kept, pairs, strict=True)]

    def key(self) -> str:
        """Key of all links of the survey."""
        photos = [(seen_as(p), p.width, p.height) for p in self.found.photos]
        methods = self.methods
        by = methods.nearest, methods.retrieval, methods.through_others, link_photos
        places = self.xy if self.views is None else np.column_stack([self.xy, self.views])
        return digest(photos, places.tolist(), self._recipe, *by)


def seen_as(photo: Photo) -> object:
    """What of a photo enters its links: its content, and its lens if that is a fisheye."""
    return (photo.pixels_key, photo.lens) if photo.lens.fisheye else photo.pixels_key


def of_unknown_kind(photos: Sequence[Photo]) -> dict[str, Camera]:
    """Lenses by camera of which nothing but what photos have in common tells whether they are
    fisheyes.
    """
    asked = {p.camera_key: p.lens for p in photos if p.band == "visible"}
    return {key: lens for key, lens in asked.items() if may_be_fisheye(lens)}


def with_fisheyes(
    found: FeaturedPhotos, links: Links, grey: GreyPictures, methods: Methods
) -> tuple[FeaturedPhotos, tuple[str, ...]]:
    """The photos, those of cameras that prove to have a fisheye with such a lens, and notes on
    them; the same where there are none. Links must be found again for these.
    """
    matcher, features = methods.matcher, found.features
    if isinstance(matcher, Guided):
        return found, ()

    def matched(a: int, b: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        two = features[a], features[b]
        marked = marked_in(links.marks, found.photos, (a, b), two)
        matches = _on_ground(matcher(*two), marked)
        return two[0].px[matches.index_a], two[1].px[matches.index_b]

    def straight(photo: int, lens: Camera) -> Features:
        full = found.photos[photo].height, found.photos[photo].width
        return straightened_features(lens, grey(photo, PICTURE), full, methods.detector)

    def shared(a: int, b: int, lens: Camera) -> int:
        two = straight(a, lens), straight(b, lens)
        matches = _on_ground(matcher(*two), marked_in(links.marks, found.photos, (a, b), two))
        link = methods.verify(a, b, *two, matches, lens.width, (lens, lens))
        return len(link) if isinstance(link, Link) else 0

    tried = [(k.a, k.b) for k in links.links] + [(k.a, k.b) for k in links.rejected]
    asked = of_unknown_kind(found.photos)
    cameras = {i: p.camera_key for i, p in enumerate(found.photos)}
    lenses = fisheyes(cameras, asked, features.__getitem__, links.links, tried, matched, shared)
    if not lenses:
        return found, ()
    notes = tuple(fisheye_note(camera) for camera in lenses)
    return found.through(lenses), notes


def link_photos(
    found: FeaturedPhotos,
    frame: MapFrame,
    priors: Sequence[Prior],
    methods: Methods,
    store: Store,
    workers: Workers,
) -> Steps[Links]:
    """Links neighbours first; their overlap gives the largest distance of further candidates. All
    links are kept as one artefact too, so that a run that goes on has them at once.
    """
    linker = _Linker(found, frame, priors, methods, store)
    key = linker.key()
    packed: PackedLinks | None = store.get("links", key)
    if packed is None:
        packed = PackedLinks.of((yield from _linked(linker, workers)))
        store.put("links", key, packed)
    matches = packed.in_files()
    tried = list(replace(packed, index_a=matches[0].values, index_b=matches[1].values))
    del packed
    yield len(tried), len(tried)
    return Links(
        links=tuple(k for k in tried if isinstance(k, Link)),
        rejected=tuple(k for k in tried if isinstance(k, RejectedLink)),
        marks=linker.marks,
        matches=matches,
    )


def marks_of(photos: Sequence[Photo], features: Sequence[Features]) -> FixedMarks:
    """What the pictures of each camera show at the same place each."""
    cameras, sizes = [p.camera_key for p in photos], [(p.width, p.height) for p in photos]
    return FindFixedMarks()(features, cameras, sizes)


def marked_in(
    marks: FixedMarks, photos: Sequence[Photo], pair: Pair, two: tuple[Features, Features]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
    """Which keypoints of a pair lie on marks; None where neither camera has any."""
    cameras = [photos[i].camera_key for i in pair]
    if not any(c in marks.masks for c in cameras):
        return None
    a, b = (marks.on_mark(c, f.px) for c, f in zip(cameras, two, strict=True))
    return a, b


def _linked(linker: _Linker, workers: Workers) -> Steps[list[Link | RejectedLink]]:
    """Tries all pairs."""
    found, methods, xy = linker.found, linker.methods, linker.xy
    n, tried, done = len(found.photos), list[Link | RejectedLink](), set[Pair]()
    sizes = [(p.width, p.height) for p in found.photos]
    lost = [i for i in range(n) if not np.isfinite(xy[i]).all()]

    def compared(pairs: Iterable[Pair], share: float = 1.0) -> Steps[bool]:
        """Tries pairs that were not yet, a share of all; whether any is a link."""
        # in order of capture, so that the features of a photo are read once for all its pairs
        new, before = sorted(set(pairs) - done), len(tried)
        done.update(new)
        for batch in workers.each(linker.batch, _batches(new)):
            tried.extend(batch)
            yield len(tried), round(len(done) / share)
        return any(isinstance(k, Link) for k in tried[before:])

    def links() -> list[Link]:
        return [k for k in tried if isinstance(k, Link)]

    yield from compared([*sequence(n), *closest(linker.nearest(), n, 2)], share=0.5)
    if n > 2:
        reach = overlap_reach_m(links(), found.features, sizes, xy)
        rest = linker.nearest(reach)
        if lost:
            rest += methods.retrieval(found.features, None if len(lost) == n else lost)
        yield from compared(rest)
        block = blocks_of(n, links())
        apart = np.flatnonzero(block != np.bincount(block).argmax()).tolist()
        if len(apart) > APART * n:
            alike = methods.retrieval(found.features, apart)
            far = ASIDE * (reach or np.inf)
            yield from compared(p for p in alike if not np.hypot(*(xy[p[0]] - xy[p[1]])) > far)
    for _ in range(methods.through_others.rounds):
        if not (yield from compared(methods.through_others(links(), found.features, sizes, done))):
            break
    return tried


def _batches(pairs: Sequence[Pair]) -> list[Sequence[Pair]]:
    """Sorted pairs, those of each first photo by themselves."""
    of_photo = [list(own) for _, own in groupby(pairs, key=lambda pair: pair[0])]
    return [own[k : k + BATCH] for own in of_photo for k in range(0, len(own), BATCH)]


def make_room(found: FeaturedPhotos, grey: GreyPictures, links: Links) -> None:
    """Drops features, grey images and matches kept in memory where not all fit."""
    found.looks.make_room()
    grey.make_room()
    links.make_room()
    give_back_growth()
