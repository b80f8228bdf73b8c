"""Drift of thermal cameras: differences between frames that show the same ground.

The temperature of an uncooled sensor changes, so each frame has its own offset. Overlapping frames
show the same ground, so the offsets can be estimated from the overlaps, one per frame. This is a
correction, not a measurement; an option keeps the recorded values.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import View, even_places, project_nodes
from skyquilt.model.surface import Surface
from skyquilt.ortho.frame_pattern import FramePattern, Samples

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]
CORRELATED = 30.0
"""Errors of neighbouring samples are correlated: this number of samples counts as one independent
sample.
"""
_TINY = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Overlaps:
    """Differences between overlapping frames: the edges of a graph of frames."""

    first: Ints
    """(E,) row of the one frame."""
    second: Ints
    """(E,) row of the other."""
    difference: Doubles
    """(E,) median of second minus first, in the values' unit."""
    sigma: Doubles
    """(E,) its standard deviation."""


@dataclass(frozen=True, kw_only=True)
class Drift:
    """One offset per frame from the medians of all overlaps, outlying overlaps down-weighted
    (Cauchy).

    Overlaps do not determine a common offset. It is chosen so that the median offset of each
    connected group of frames is zero: the map keeps the level of most of its frames.
    """

    points: int = 4000
    """Number of ground points sampled; more for surveys of many frames."""
    least: int = 8
    """Fewest points that two frames must share."""
    rounds: int = 12
    """Rounds of reweighting."""
    pattern: FramePattern = field(default_factory=FramePattern)
    """What frames have in common besides."""
    version: ClassVar[int] = 3

    def __call__(
        self,
        views: Sequence[View],
        thumbnails: Mapping[int, NDArray[Any]],
        surface: Surface,
        bounds: tuple[float, float, float, float],
    ) -> dict[int, float]:
        """Photo -> the offset to add to its values, from thumbnails (h, w) of the photos in their
        unit.
        """
        usable = [v for v in views if v.photo in thumbnails]
        if len(usable) < 2:
            return {}
        s = ground_samples(usable, thumbnails, surface, bounds, self.points)
        edges = overlaps(s.point, s.row, s.value, self.least)
        if not len(edges.first):
            return {}
        offsets = solved(edges, len(usable), self.rounds)
        return {v.photo: float(o) for v, o in zip(usable, offsets, strict=True)}

    def patterns(
        self,
        views: Sequence[View],
        thumbnails: Mapping[int, NDArray[Any]],
        surface: Surface,
        bounds: tuple[float, float, float, float],
    ) -> dict[int, NDArray[np.float32]]:
        """Photo -> correction (h, w) of its values at nodes of the frame, the same for all frames
        of a camera; without those of cameras that show none.
        """
        cameras: dict[tuple[float, ...], list[View]] = {}
        for v in views:
            if v.photo in thumbnails:
                key = (v.camera.width, v.camera.height, *v.camera.vector)
                cameras.setdefault(key, []).append(v)
        found: dict[int, NDArray[np.float32]] = {}
        for own in cameras.values():
            if len(own) < self.pattern.fewest:
                continue
            samples = ground_samples(own, thumbnails, surface, bounds, self.points)
            pattern = self.pattern(samples, own[0].camera)
            if pattern is not None:
                found |= {v.photo: pattern for v in own}
        return found


def ground_samples(
    views: Sequence[View],
    thumbnails: Mapping[int, NDArray[Any]],
    surface: Surface,
    bounds: tuple[float, float, float, float],
    points: int,
) -> Samples:
    """Values of views, from thumbnails (h, w) of their photos, at about so many points of the
    ground, and more of many views, inside bounds (west, south, east, north) in m.
    """
    x, y, z = even_places(surface, bounds, max(points, 40 * len(views)))
    parts = []
    for row, view in enumerate(views):
        nodes = project_nodes(view, x, y, z)
        seen = np.flatnonzero(nodes.seen.ravel())
        u, v = nodes.u.ravel()[seen], nodes.v.ravel()[seen]
        value = _nearest(thumbnails[view.photo], u, v, view)
        good = np.isfinite(value)
        place = (np.c_[u, v] + 0.5) / [view.camera.width, view.camera.height]
        parts.append((seen[good], np.full(int(good.sum()), row), value[good], place[good]))
    point, rows, values, places = (np.concatenate(p) for p in zip(*parts, strict=True))
    return Samples(
        point=point.astype(np.int64), row=rows.astype(np.int64), value=values, place=places
    )


def _nearest(thumbnail: NDArray[Any], u: NDArray[Any], v: NDArray[Any], view: View) -> Doubles:
    """Thumbnail values (n,), themselves area means, at photo pixels."""
    height, width = thumbnail.shape[:2]
    column = np.rint((u + 0.5) * width / view.camera.width - 0.5).astype(int)
    row = np.rint((v + 0.5) * height / view.camera.height - 0.5).astype(int)
    flat = thumbnail.reshape(height, width, -1)[..., 0]
    return np.asarray(flat[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)], np.float64)


def overlaps(point: Ints, row: Ints, value: Doubles, least: int) -> Overlaps:
    """Median differences of all pairs of frames with `least` ground points in common, from samples
    (N,).
    """
    order = np.lexsort((row, point))
    point, row, value = point[order], row[order], value[order]
    a, b, d = [], [], []
    for lag in range(1, int(np.bincount(point).max(initial=1))):
        same = np.flatnonzero(point[lag:] == point[:-lag])
        a.append(row[same])
        b.append(row[same + lag])
        d.append(value[same + lag] - value[same])
    if not a:
        return Overlaps(first=row[:0], second=row[:0], difference=value[:0], sigma=value[:0])
    first, second, difference = np.concatenate(a), np.concatenate(b), np.concatenate(d)
    order = np.lexsort((difference, second, first))
    first, second, difference = first[order], second[order], difference[order]
    cuts = np.flatnonzero((np.diff(first) != 0) | (np.diff(second) != 0)) + 1
    groups = [g for g in np.split(np.arange(len(first)), cuts) if len(g) >= least]
    middle = np.array([np.median(difference[g]) for g in groups])
    spread = [
        1.4826 * np.median(np.abs(difference[g] - m)) / np.sqrt(max(len(g) / CORRELATED, 1.0))
        for g, m in zip(groups, middle, strict=True)
    ]
    start = np.array([g[0] for g in groups], np.int64)
    sigma = np.array(spread)
    floor = 0.3 * float(np.median(sigma)) if len(sigma) else 0.0
    return Overlaps(
        first=first[start],
        second=second[start],
        difference=middle,
        sigma=np.maximum(sigma, floor + _TINY),
    )


def solved(edges: Overlaps, count: int, rounds: int) -> Doubles:
    """Offsets (count,) that make frames agree: second + o[second] = first + o[first], median zero
    per component.

    A weak prior of zero prevents the errors of overlaps from adding up along a long line of frames.
    Its deviation is the typical difference of frames, or the spread of the offsets without it: a
    camera that is calibrated anew on the way (its shutter closes) steps by much more than it
    drifts from frame to frame, and all frames after that step have it.
    """
    from scipy import sparse  # imported here, since only thermal runs need it
    from scipy.sparse.csgraph import connected_components

    number = np.arange(len(edges.first))
    ones = np.ones(len(number))
    A = sparse.csr_matrix(
        (np.r_[ones, -ones], (np.r_[number, number], np.r_[edges.second, edges.first])),
        (len(number), count),
    )
    _, part = connected_components(A.T @ A)
    usual = 1.4826 * float(np.median(np.abs(edges.difference))) + _TINY
    most = float(np.abs(edges.difference).sum()) + _TINY
    offset = np.zeros(count)
    for free in (most, 0.0):
        believed = free or max(usual, float(offset.std()))
        offset = _agreeing(edges, A, believed, usual, rounds)
        offset -= np.array([np.median(offset[part == p]) for p in range(part.max() + 1)])[part]
    return offset


def _agreeing(edges: Overlaps, A: Any, believed: float, usual: float, rounds: int) -> Doubles:
    """The offsets (count,) for a prior of that deviation, edges that do not fit down-weighted; A
    (E, count) takes the differences of offsets.
    """
    from scipy import sparse
    from scipy.sparse import linalg as sparse_linalg

    pull = sparse.identity(A.shape[1]) / believed**2
    least = max(float(np.median(edges.sigma)), _TINY)  # within it no edge is an outlier
    weight, offset = 1 / edges.sigma**2, np.zeros(A.shape[1])
    for k in range(rounds):
        W = sparse.diags(weight)
        offset = sparse_linalg.spsolve(
            (A.T @ W @ A + pull).tocsc(), -A.T @ (weight * edges.difference)
        )
        lacking = edges.difference + A @ offset
        scale = max(1.4826 * float(np.median(np.abs(lacking))), 0.5 * usual * 0.5**k, least)
        weight = 1 / edges.sigma**2 / (1 + (lacking / (2 * scale)) ** 2)
    return np.asarray(offset, np.float64)
