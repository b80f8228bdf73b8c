"""Mutual nearest neighbours with a ratio test."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from skyquilt.matching.similarity import similarities
from skyquilt.model.features import Features, Matches


@dataclass(frozen=True, kw_only=True)
class Mutual:
    """Each other's nearest, and clearly nearer than the second nearest."""

    ratio: float = 0.85
    """Largest distance to the nearest over distance to the second nearest; Hamming's of binary
    descriptors.
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
        # 1 - s is d^2 / 2 of unit vectors, but twice the distance itself of bits
        ratio = self.ratio if a.binary else self.ratio**2
        clear = np.flatnonzero((1 - first) < ratio * (1 - second))
        # who is nearest the other way round matters for the clear ones only
        mutual = similarity[:, best[clear]].max(0) <= first[clear]
        kept = clear[mutual]
        return Matches(index_a=kept, index_b=best[kept])
