"""Tracks: the observations of one ground point in several photos; connected components."""

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.problem import of_some
from skyquilt.model.features import Features, Link

Index = NDArray[np.int64]
TOGETHER = 1_000_000
"""Edges or observations that are looked at at once."""


class Ends(Protocol):
    """A link, of whatever kind, of two photos."""

    @property
    def a(self) -> int:
        """The first one."""
        ...

    @property
    def b(self) -> int:
        """The second one."""
        ...


def blocks_of(count: int, links: Sequence[Ends]) -> NDArray[np.integer[Any]]:
    """(count,) numbers of the groups of photos that links connect, see `connected`."""
    a, b = (np.array([getattr(k, name) for k in links], np.int64) for name in ("a", "b"))
    return connected(count, a, b)


def connected(count: int, a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.integer[Any]]:
    """Component (count,) of each node of a graph with edges a-b, numbered in order of their first
    nodes.

    Each node takes the smallest label among its neighbours; each round then follows the labels to
    their roots (Shiloach and Vishkin 1982).
    """
    label = np.arange(count, dtype=_index_type(count))
    edges = [slice(k, k + TOGETHER) for k in range(0, len(a), TOGETHER)]
    moved = True
    while moved:
        moved = False
        for some in edges:
            of_a, of_b = label[a[some]], label[b[some]]
            differ = of_a != of_b
            if differ.any():
                of_a, of_b = of_a[differ], of_b[differ]
                least = np.minimum(of_a, of_b)
                np.minimum.at(label, of_a, least)
                np.minimum.at(label, of_b, least)
                moved = True
        while (label[label] != label).any():
            label = label[label]
    number: NDArray[Any] = np.cumsum(
        label == np.arange(count, dtype=label.dtype), dtype=label.dtype
    )
    number -= 1
    return np.asarray(number[label])


def _index_type(count: int) -> type[np.int32 | np.int64]:
    """The smaller type that numbers so many: of large surveys, lists of numbers fill the memory."""
    return np.int32 if count < 2**31 else np.int64


def spanning_tree(count: int, a: NDArray[Any], b: NDArray[Any], cost: NDArray[Any]) -> list[int]:
    """The edges (their indices) of the cheapest tree, or forest, that spans the nodes (Kruskal
    1956).
    """
    parent = list(range(count))

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = node = parent[parent[node]]
        return node

    tree = []
    for edge in np.argsort(cost, kind="stable").tolist():
        i, j = root(int(a[edge])), root(int(b[edge]))
        if i != j:
            parent[i] = j
            tree.append(edge)
    return tree


def outwards(
    count: int, a: NDArray[Any], b: NDArray[Any], edges: list[int]
) -> Iterator[tuple[int, int]]:
    """(parent, node) of a tree's nodes, breadth first from node 0."""
    beside: list[list[int]] = [[] for _ in range(count)]
    for edge in edges:
        i, j = int(a[edge]), int(b[edge])
        beside[i].append(j)
        beside[j].append(i)
    waiting, reached = deque([0]), {0}
    while waiting:
        parent = waiting.popleft()
        for node in beside[parent]:
            if node not in reached:
                reached.add(node)
                waiting.append(node)
                yield parent, node


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracks:
    """Observations sorted by track."""

    point: NDArray[np.integer[Any]]
    """(N,) track of each observation, 0 .. count-1, ascending."""
    photo: NDArray[np.integer[Any]]
    """(N,) photo."""
    px: NDArray[np.float64]
    """(N, 2) px."""
    sigma_px: NDArray[np.float64]
    """(N,) standard deviation in px."""
    relative: NDArray[np.float64] | float = 1.0
    """Deviation of all or of each (N,) over that of a usual one of its kind, as far as it is known
    (`alignment.least_squares_matching`).
    """

    @property
    def count(self) -> int:
        """Number of tracks."""
        return int(self.point[-1]) + 1 if len(self.point) else 0

    def parts(self, about: int) -> Iterator[tuple[slice, slice]]:
        """Observations and points of parts of whole tracks, with about so many observations."""
        wanted = np.arange(about, len(self.point), about)
        starts = np.searchsorted(self.point, self.point[wanted]) if len(wanted) else wanted
        for low, high in pairwise(np.unique([0, *starts.tolist(), len(self.point)]).tolist()):
            yield slice(low, high), slice(int(self.point[low]), int(self.point[high - 1]) + 1)

    def part(self, observations: slice, points: slice) -> "Tracks":
        """Some of the tracks."""
        return Tracks(
            point=self.point[observations] - points.start,
            photo=self.photo[observations],
            px=self.px[observations],
            sigma_px=self.sigma_px[observations],
            relative=of_some(self.relative, observations),
        )

    def only(self, observation: NDArray[np.bool_]) -> "Tracks":
        """The selected observations, without tracks left with one observation; renumbered."""
        if observation.all():
            return self
        point = self.point[observation]
        keep = np.flatnonzero(observation)[np.bincount(point, minlength=self.count)[point] >= 2]
        return Tracks(
            point=_renumbered(self.point[keep]),
            photo=self.photo[keep],
            px=self.px[keep],
            sigma_px=self.sigma_px[keep],
            relative=of_some(self.relative, keep),
        )


@dataclass(frozen=True, kw_only=True)
class Thinning:
    """How many tracks are kept: long ones first, until every photo has enough observations spread
    over its area, one in each of as many cells: neighbouring ones err alike.
    """

    sizes: Sequence[tuple[int, int]]
    """(width, height) of each photo in px."""
    per_photo: int
    """Observations wanted of a photo."""
    cells: int | None = None
    """Cells along a side instead of the root of `per_photo`."""
    least: int = 0
    """A photo that would be left with fewer, since its observations lie in few of the cells, keeps
    all of them.
    """

    def chosen(
        self,
        point: NDArray[np.integer[Any]],
        photo: NDArray[np.integer[Any]],
        px_of: Callable[[Index], NDArray[np.float64]],
    ) -> NDArray[np.bool_]:
        """(tracks,) which tracks are kept.

        `point`, `photo` (N,): track, ascending, and photo of each observation. `px_of` gives the
        pixels (n, 2) of some of them, sorted by photo: of large surveys those of all would fill
        the memory.
        """
        count = int(point[-1]) + 1 if len(point) else 0
        length = np.bincount(point, minlength=count)
        chosen = np.zeros(count, bool)
        by_photo = np.argsort(photo, kind="stable")
        cuts = np.searchsorted(photo[by_photo], np.arange(len(self.sizes) + 1))
        for lo, hi in _grouped(cuts, TOGETHER):
            own = by_photo[lo:hi]
            chosen[point[self._best(photo[own], length[point[own]], px_of(own), own)]] = True
        if self.least:
            number = np.bincount(photo[chosen[point]], minlength=len(self.sizes))
            chosen[point[number[photo] < self.least]] = True
        return chosen

    def _best(
        self, photo: NDArray[np.integer[Any]], length: Index, px: NDArray[np.float64], own: Index
    ) -> NDArray[np.int64]:
        """Those of some photos' observations `own` that are the best ones of their cells."""
        cells = self.cells or max(1, math.isqrt(self.per_photo))
        size = np.array(self.sizes)[photo]
        column, row = ((px + 0.5) / size * cells).astype(int).clip(0, cells - 1).T
        slot = (photo.astype(np.int64) * cells + row) * cells + column
        order = np.lexsort((px[:, 0], -length, slot))
        starts = np.flatnonzero(np.r_[True, np.diff(slot[order]) != 0])
        rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
        return own[order[rank < max(1, self.per_photo // cells**2)]]


def _grouped(cuts: Index, about: int) -> Iterator[tuple[int, int]]:
    """Ranges of whole photos of about so many observations; `cuts` (photos + 1,) ascending."""
    lo = 0
    for hi, following in pairwise([*cuts[1:].tolist(), math.inf]):
        if following - lo > about and hi > lo:
            yield lo, hi
            lo = hi


def build_tracks(
    features: Sequence[Features],
    links: Sequence[Link],
    *,
    sigma: float = 0.25,
    thinning: Thinning | None = None,
) -> Tracks:
    """Joins matches to tracks. A track with observations in two places of one photo contains a
    wrong match and is removed.

    Features at one place count as one: a detector describes a place several times where it has
    several orientations. As observations of several points they would err alike.

    `sigma`: standard deviation of a keypoint in px of the image it was found in. `thinning`: only
    some of the tracks are wanted.
    """
    offset, scales, place = _places(features)
    used, photo, point = _joined(offset, place, links)

    def px_of(some: Index) -> NDArray[np.float64]:
        """Of observations sorted by photo."""
        px, whose = np.empty((len(some), 2)), photo[some]
        starts = np.flatnonzero(np.r_[True, np.diff(whose) != 0])[: len(whose)]
        for lo, hi in pairwise([*starts.tolist(), len(whose)]):
            i = int(whose[lo])
            px[lo:hi] = features[i].px[used[some[lo:hi]] - offset[i]]
        return px

    if thinning is not None:
        keep = thinning.chosen(point, photo, px_of)[point]
        used, photo, point = used[keep], photo[keep], _renumbered(point[keep])
    by_photo = np.argsort(photo, kind="stable")
    px = np.empty((len(used), 2))
    px[by_photo] = px_of(by_photo)
    return Tracks(point=point, photo=photo, px=px, sigma_px=np.maximum(sigma * scales[photo], 0.3))


def _joined(
    offset: Index, place: list[NDArray[np.int32]], links: Sequence[Link]
) -> tuple[NDArray[np.integer[Any]], ...]:
    """Observations by track, as `build_tracks` describes: the feature of each in the list of all
    (N,), its photo (N,), and its track (N,) ascending. `offset`, `place` as `_places` gives them;
    the latter is emptied.
    """
    kind = _index_type(int(offset[-1]))
    ends = np.cumsum([0, *(len(k) for k in links)])
    a, b = np.empty(ends[-1], kind), np.empty(ends[-1], kind)
    for link, (lo, hi) in zip(links, pairwise(ends.tolist()), strict=True):
        a[lo:hi] = offset[link.a] + place[link.a][link.index_a]
        b[lo:hi] = offset[link.b] + place[link.b][link.index_b]
    place.clear()
    linked = np.zeros(offset[-1], bool)  # most features are in no link
    linked[a] = linked[b] = True
    used = np.flatnonzero(linked).astype(kind)
    number: NDArray[Any] = np.cumsum(linked, dtype=kind)
    number -= 1
    label = connected(len(used), number[a], number[b])
    del a, b, linked, number
    photo = (np.searchsorted(offset, used, "right") - 1).astype(kind)
    order = np.argsort(label, kind="stable")  # within a track they are in order of photos
    used, photo, track = used[order], photo[order], label[order]
    repeated = np.flatnonzero((np.diff(track) == 0) & (np.diff(photo) == 0))
    wrong = np.zeros(int(track[-1]) + 1 if len(track) else 0, bool)
    wrong[track[repeated]] = True
    good = ~wrong[track]
    used, photo, track = used[good], photo[good], track[good]
    order, point = _by_photos(track, photo)
    return used[order], photo[order], point.astype(kind)


def _renumbered(point: NDArray[np.integer[Any]]) -> NDArray[np.integer[Any]]:
    """Numbers without gaps of ascending ones (n,)."""
    return np.cumsum(np.r_[False, np.diff(point) != 0], dtype=point.dtype)[: len(point)]


def _places(
    features: Sequence[Features],
) -> tuple[Index, NDArray[np.float64], list[NDArray[np.int32]]]:
    """Where each photo's features begin in the list of all (photos + 1,), their scale (photos,),
    and of each photo for every feature the first one at the same place.
    """
    parts, begin, scales = list[NDArray[np.int32]](), [0], list[float]()
    for photo in features:
        _, first, which = np.unique(
            photo.px[:, 0] + 1j * photo.px[:, 1], return_index=True, return_inverse=True
        )
        parts.append(first.astype(np.int32)[which])
        begin.append(begin[-1] + len(photo))
        scales.append(photo.scale)
    return np.array(begin, np.int64), np.array(scales), parts


def _by_photos(track: Index, photo: Index) -> tuple[Index, Index]:
    """The order of observations in which tracks that the same photos show follow one another, and
    the number of each one's track: so neighbouring observations are of few photos.

    `track` (N,) ascending, `photo` (N,) ascending within each track.
    """
    starts = np.flatnonzero(np.r_[True, np.diff(track) != 0])[: len(track)]
    length = np.diff(np.r_[starts, len(track)])
    nth = [photo[starts + np.minimum(k, length - 1)] for k in range(3)]
    place = np.empty(len(starts), np.int64)
    place[np.lexsort((np.arange(len(starts)), *nth[::-1]))] = np.arange(len(starts))
    number = np.repeat(place, length)
    order = np.argsort(number, kind="stable")
    return order, number[order]


def thin(
    tracks: Tracks,
    sizes: Sequence[tuple[int, int]],
    *,
    per_photo: int,
    cells: int | None = None,
    least: int = 0,
) -> Tracks:
    """Selects tracks for an adjustment, as `Thinning` describes."""
    rule = Thinning(sizes=sizes, per_photo=per_photo, cells=cells, least=least)
    chosen = rule.chosen(tracks.point, tracks.photo, lambda some: tracks.px[some])
    return tracks.only(chosen[tracks.point])
