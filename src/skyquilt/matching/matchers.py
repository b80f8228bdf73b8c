"""Putative matches of two photos by their descriptors: mutual nearest neighbours, one-way nearest
neighbours, and nearest neighbours within a radius of a predicted position.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.features import Features, Matches

LATELY = 16
"""Photos whose unit descriptors are kept: those that the next pairs share."""


@lru_cache(maxsize=LATELY)
def _unit(features: Features) -> NDArray[np.float32]:
    """(N, D) descriptors of unit length, read-only."""
    unit = features.unit
    unit.setflags(write=False)
    return unit


def similarities(a: Features, b: Features) -> NDArray[np.float32]:
    """(len(a), len(b)) dot products of unit descriptors: 1 equal, 0 unrelated.

    Raises:
        ValueError: the descriptors are of different kinds.
    """
    if a.binary != b.binary or a.descriptors.shape[1] != b.descriptors.shape[1]:
        kinds = [f"{'binary' if f.binary else 'real'} of {f.descriptors.shape[1]}" for f in (a, b)]
        raise ValueError(f"descriptors of one kind expected, got {kinds[0]} and {kinds[1]}")
    return np.asarray(_unit(a) @ _unit(b).T)


def no_matches() -> Matches:
    """An empty set of matches."""
    return Matches(index_a=np.zeros(0, np.int64), index_b=np.zeros(0, np.int64))


@dataclass(frozen=True, kw_only=True)
class Mutual:
    """Mutual nearest neighbours that are clearly nearer than the second nearest."""

    ratio: float = 0.85
    """Largest ratio of the distances to the nearest and the second nearest; Hamming distances for
    binary descriptors.
    """
    version: ClassVar[int] = 3

    def __call__(self, a: Features, b: Features) -> Matches:
        """Putative matches of two photos."""
        if len(a) < 2 or len(b) < 2:
            return Matches(index_a=np.zeros(0, np.int64), index_b=np.zeros(0, np.int64))
        similarity = similarities(a, b)
        rows = np.arange(len(a))
        best = similarity.argmax(1)
        first = similarity[rows, best].copy()
        similarity[rows, best] = -1.0
        second = similarity.max(1)
        similarity[rows, best] = first
        # 1 - s is d^2 / 2 for unit vectors, but proportional to the distance itself for bits
        ratio = self.ratio if a.binary else self.ratio**2
        clear = np.flatnonzero((1 - first) < ratio * (1 - second))
        # the maxima of all columns take a sixth of the time of gathering those that are needed
        mutual = similarity.max(0)[best[clear]] <= first[clear]
        kept = clear[mutual]
        return Matches(index_a=kept, index_b=best[kept])


@dataclass(frozen=True, kw_only=True)
class OneWay:
    """Matches each feature of a with its nearest in b if the second nearest is clearly farther [Y
    5.2.1].
    """

    threshold: float = 1.2
    """A match is kept if its squared distance times this factor is less than that of the second
    nearest.
    """
    version: ClassVar[int] = 1

    def __call__(self, a: Features, b: Features) -> Matches:
        """Putative matches of two images; several features of a may share one of b."""
        if not len(a) or len(b) < 2:
            return no_matches()
        # for unit vectors, d^2 = 2 (1 - s); for bits, half of that is the share that differs
        distance = 1 - similarities(a, b)
        best = distance.argmin(1)
        rows = np.arange(len(a))
        first = distance[rows, best].copy()
        distance[rows, best] = np.inf
        kept = np.flatnonzero(self.threshold * first < distance.min(1))
        return Matches(index_a=kept, index_b=best[kept])


@dataclass(frozen=True, kw_only=True)
class Guided:
    """Mutual nearest neighbours among the features within a radius of the predicted position."""

    radius_px: float = 100.0
    """Largest distance of a match from its predicted position, in px of the full photo b."""
    share: float = 0.15
    """The same as a share of a photo's width, see `for_width`. It allows for errors of metres in
    positions and of degrees in headings.
    """
    height_m: float | None = None
    """Height above ground in m used for the prediction; None = heights above take-off."""
    ratio: float = 0.9
    """Largest ratio of the distances to the nearest and the second nearest within the radius."""
    distance: float = 0.8
    """Largest distance of two unit descriptors (0 equal, sqrt 2 unrelated): needed since the circle
    may contain no second feature for the ratio test. For binary descriptors, half of it is the
    largest share of bits that differ.
    """
    version: ClassVar[int] = 2

    def for_width(self, width: int) -> "Guided":
        """The same with a radius for photos of this width in px."""
        return replace(self, radius_px=self.share * width)

    def __call__(self, a: Features, b: Features, predicted: NDArray[np.float64]) -> Matches:
        """Putative matches; `predicted` (len(a), 2) px of b, NaN where it is unknown; such features
        get no match.
        """
        if predicted.shape != (len(a), 2):
            raise ValueError(
                f"a position for each of {len(a)} keypoints expected, got {predicted.shape}"
            )
        if not len(a) or not len(b):
            return no_matches()
        off = predicted[:, None] - b.px[None]
        near = np.einsum("abi,abi->ab", off, off) <= self.radius_px**2
        similarity = np.where(near, similarities(a, b), -1.0)
        rows, best = np.arange(len(a)), similarity.argmax(1)
        first = similarity[rows, best].copy()
        mutual = similarity.argmax(0)[best] == rows
        similarity[rows, best] = -1.0
        power = 1 if a.binary else 2
        clear = (1 - first) < self.ratio**power * (1 - similarity.max(1))
        close = 1 - first <= self.distance**power / (1 if a.binary else 2)
        kept = np.flatnonzero(mutual & clear & close & (first > -1))
        return Matches(index_a=kept, index_b=best[kept])
