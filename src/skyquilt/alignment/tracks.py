"""Tracks: the observations of one ground point in several photos; connected components."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.problem import of_some
from skyquilt.model.features import Features, Link

Index = NDArray[np.int64]


def connected(count: int, a: NDArray[Any], b: NDArray[Any]) -> Index:
    """Component (count,) of each node of a graph with edges a-b, numbered in order of their first
    nodes.

    Each node takes the smallest label among its neighbours; each round then follows the labels to
    their roots (Shiloach and Vishkin 1982).
    """
    label = np.arange(count)
    while (label[a] != label[b]).any():
        least = np.minimum(label[a], label[b])
        np.minimum.at(label, label[a], least)
        np.minimum.at(label, label[b], least)
        while (label[label] != label).any():
            label = label[label]
    return np.asarray(np.unique(label, return_inverse=True)[1], np.int64)


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

    point: Index
    """(N,) track of each observation, 0 .. count-1, ascending."""
    photo: Index
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
        point = self.point[observation]
        keep = np.flatnonzero(observation)[np.bincount(point, minlength=self.count)[point] >= 2]
        _, renumbered = np.unique(self.point[keep], return_inverse=True)
        return Tracks(
            point=renumbered.astype(np.int64),
            photo=self.photo[keep],
            px=self.px[keep],
            sigma_px=self.sigma_px[keep],
            relative=of_some(self.relative, keep),
        )


def build_tracks(
    features: Sequence[Features], links: Sequence[Link], *, sigma: float = 0.25
) -> Tracks:
    """Joins matches to tracks. A track with observations in two places of one photo contains a
    wrong match and is removed.

    Features at one place count as one: a detector describes a place several times where it has
    several orientations. As observations of several points they would err alike.

    `sigma`: standard deviation of a keypoint in px of the image it was found in.
    """
    if not links:
        return Tracks(
            point=np.zeros(0, np.int64),
            photo=np.zeros(0, np.int64),
            px=np.zeros((0, 2)),
            sigma_px=np.zeros(0),
        )
    offset, place = _places(features)
    a = np.concatenate([offset[k.a] + place[k.a][k.index_a] for k in links])
    b = np.concatenate([offset[k.b] + place[k.b][k.index_b] for k in links])
    del place
    used = np.unique(np.concatenate([a, b]))  # most features are in no link
    label = connected(len(used), np.searchsorted(used, a), np.searchsorted(used, b))
    del a, b
    photo = np.searchsorted(offset, used, "right") - 1
    order = np.lexsort((photo, label))
    used, photo, track = used[order], photo[order], label[order]
    repeated = np.flatnonzero((np.diff(track) == 0) & (np.diff(photo) == 0))
    good = ~np.isin(track, track[repeated])
    used, photo, track = used[good], photo[good], track[good]
    order, point = _by_photos(track, photo)
    used, photo = used[order], photo[order]
    px, scale = np.empty((len(used), 2)), np.empty(len(used))
    by_photo = np.argsort(photo, kind="stable")
    cuts = np.searchsorted(photo[by_photo], np.arange(len(features) + 1))
    for i, (lo, hi) in enumerate(pairwise(cuts.tolist())):
        if lo < hi:
            own = by_photo[lo:hi]
            px[own], scale[own] = features[i].px[used[own] - offset[i]], features[i].scale
    return Tracks(
        point=point.astype(np.int64), photo=photo, px=px, sigma_px=np.maximum(sigma * scale, 0.3)
    )


def _places(features: Sequence[Features]) -> tuple[Index, list[NDArray[np.int32]]]:
    """Where each photo's features begin in the list of all (photos + 1,), and of each photo for
    every feature the first one at the same place.
    """
    parts, begin = list[NDArray[np.int32]](), [0]
    for photo in features:
        _, first, which = np.unique(
            photo.px[:, 0] + 1j * photo.px[:, 1], return_index=True, return_inverse=True
        )
        parts.append(first.astype(np.int32)[which])
        begin.append(begin[-1] + len(photo))
    return np.array(begin, np.int64), parts


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
    """Selects tracks for an adjustment: long ones first, until every photo has `per_photo`
    observations spread over its area, one in each of as many cells (or in `cells` by `cells` of
    them): neighbouring ones err alike.

    `sizes`: (width, height) of each photo. A photo that would be left with fewer than `least`,
    since its observations lie in few of the cells, keeps all of them.
    """
    length = np.bincount(tracks.point, minlength=tracks.count)
    cells = cells or max(1, math.isqrt(per_photo))
    size = np.array(sizes)[tracks.photo]
    column, row = ((tracks.px + 0.5) / size * cells).astype(int).clip(0, cells - 1).T
    slot = (tracks.photo * cells + row) * cells + column
    order = np.lexsort((tracks.px[:, 0], -length[tracks.point], slot))
    starts = np.flatnonzero(np.r_[True, np.diff(slot[order]) != 0])
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    chosen = np.zeros(tracks.count, bool)
    chosen[tracks.point[order[rank < max(1, per_photo // cells**2)]]] = True
    if least:
        number = np.bincount(tracks.photo[chosen[tracks.point]], minlength=len(sizes))
        chosen[tracks.point[number[tracks.photo] < least]] = True
    return tracks.only(chosen[tracks.point])
