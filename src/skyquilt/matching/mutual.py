"""Mutual nearest neighbours with a ratio test."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from skyquilt.model.features import Features, Matches


@dataclass(frozen=True, kw_only=True)
class Mutual:
    """Each other's nearest, and clearly nearer than the second nearest."""

    ratio: float = 0.85
    """Largest distance to the nearest over distance to the second nearest."""
    version: ClassVar[int] = 1

    def __call__(self, a: Features, b: Features) -> Matches:
        """Putative matches of two photos."""
        if len(a) < 2 or len(b) < 2:
            return Matches(index_a=np.zeros(0, np.int64), index_b=np.zeros(0, np.int64))
        similarity = a.descriptors @ b.descriptors.T
        rows = np.arange(len(a))
        best = similarity.argmax(1)
        first = similarity[rows, best]
        back = similarity.argmax(0)
        similarity[rows, best] = -1.0
        second = similarity.max(1)
        # for unit vectors d^2 = 2 - 2 s
        good = (back[best] == rows) & ((1 - first) < self.ratio**2 * (1 - second))
        return Matches(index_a=np.flatnonzero(good), index_b=best[good])
