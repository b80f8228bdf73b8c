"""Points spread along the seams of a mosaic, from the raster that holds the photo of each pixel."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.surface import STRIP


@dataclass(frozen=True, kw_only=True)
class SeamPoint:
    """A point where two photos meet."""

    row: float
    """Row in the label raster, centres at integers."""
    column: float
    """Column in the label raster."""
    a: int
    """The smaller of the two labels."""
    b: int
    """The larger."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Edges:
    """All pixel edges between two photos, grouped by pair of photos."""

    place: NDArray[np.float64]
    """(m, 2) rows and columns of the edges' midpoints."""
    first: NDArray[np.int64]
    """(k,) index of the first edge of each pair."""
    length: NDArray[np.int64]
    """(k,) number of edges of each pair, in px."""
    pair: NDArray[np.int64]
    """(k, 2) labels, the smaller first."""


def seam_points(
    labels: NDArray[Any], *, spacing_px: float = 16.0, limit: int = 300
) -> list[SeamPoint]:
    """Points spread evenly along all seams of a label raster (H, W) of integers, 0 = no photo.

    One point about every `spacing_px`, fewer where `limit` would be exceeded. Every pair of photos
    that share a seam has at least one; if there are more pairs than `limit`, only the longest seams
    have.
    """
    edges = _edges(labels)
    if limit < 1 or not len(edges.length):
        return []
    points = []
    for k, count in enumerate(_shares(edges.length, spacing_px, limit)):
        place = edges.place[edges.first[k] : edges.first[k] + edges.length[k]]
        for row, column in _spread(place, int(count)):
            a, b = edges.pair[k].tolist()
            points.append(SeamPoint(row=float(row), column=float(column), a=a, b=b))
    return points


def _edges(labels: NDArray[Any]) -> _Edges:
    """Edges between pixels of two photos, by pair."""
    places, pairs = [], []
    below, right = (
        (labels[1:], labels[:-1], (0.5, 0.0)),
        (labels[:, 1:], labels[:, :-1], (0.0, 0.5)),
    )
    for there, here, middle in (below, right):
        for row in range(0, max(len(here), 1), STRIP):  # masks of large maps would fill the memory
            one, other = here[row : row + STRIP], there[row : row + STRIP]
            pixels = np.argwhere((other != one) & (other != 0) & (one != 0))
            a, b = one[tuple(pixels.T)].astype(np.int64), other[tuple(pixels.T)].astype(np.int64)
            places.append(pixels + np.array([row + middle[0], middle[1]]))
            pairs.append(np.stack([np.minimum(a, b), np.maximum(a, b)], 1))
    place, pair = np.concatenate(places), np.concatenate(pairs)
    order = np.lexsort((pair[:, 1], pair[:, 0]))
    place, pair = place[order], pair[order]
    unlike = (pair[1:] != pair[:-1]).any(1)
    first = np.flatnonzero(np.r_[len(pair) > 0, unlike])
    return _Edges(
        place=place, first=first, length=np.diff(np.r_[first, len(pair)]), pair=pair[first]
    )


def _shares(length: NDArray[np.int64], spacing_px: float, limit: int) -> NDArray[np.int64]:
    """Number of points per seam: one each, the others by length, at most `limit` in all."""
    if len(length) >= limit:
        return np.isin(np.arange(len(length)), np.argsort(-length, kind="stable")[:limit]).astype(
            np.int64
        )
    wanted = np.maximum(length / spacing_px, 1) - 1
    spare = limit - len(length)
    return 1 + np.floor(wanted * min(1.0, spare / max(float(wanted.sum()), 1e-9)) + 1e-9).astype(
        np.int64
    )


def _spread(place: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """`count` of the points of a seam, at equal steps along its main direction."""
    if count == 0:
        return place[:0]
    away = place - place.mean(0)
    main = np.linalg.eigh(away.T @ away)[1][:, 1]
    order = np.argsort(away @ main, kind="stable")
    return place[order[((np.arange(count) + 0.5) / count * len(place)).astype(np.int64)]]
