"""Nearest neighbours as VLFeat's ubcmatch finds them: one way, ratio of squared distances."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from skyquilt.matching.similarity import no_matches, similarities
from skyquilt.model.features import Features, Matches


@dataclass(frozen=True, kw_only=True)
class OneWay:
    """Each feature of a with its nearest in b, where the second nearest is clearly farther [Y
    5.2.1].
    """

    threshold: float = 1.2
    """A match is kept when this times its squared distance is less than that of the second nearest.
    """
    version: ClassVar[int] = 1

    def __call__(self, a: Features, b: Features) -> Matches:
        """Putative matches of two pictures; several of a may share one of b."""
        if not len(a) or len(b) < 2:
            return no_matches()
        # of unit vectors, d^2 = 2 (1 - s); of bits, half of that is the share of those that differ
        distance = 1 - similarities(a, b)
        best = distance.argmin(1)
        rows = np.arange(len(a))
        first = distance[rows, best].copy()
        distance[rows, best] = np.inf
        kept = np.flatnonzero(self.threshold * first < distance.min(1))
        return Matches(index_a=kept, index_b=best[kept])
