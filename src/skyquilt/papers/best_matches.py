"""The n best mutual nearest neighbours by distance [A 2.4: 150 within a flight line, 50 across]."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from skyquilt.matching.matchers import no_matches, similarities
from skyquilt.model.features import Features, Matches


@dataclass(frozen=True, kw_only=True)
class Best:
    """Mutual nearest neighbours, sorted by distance."""

    count: int = 150
    """Most matches."""
    ratio: float | None = None
    """Largest distance to the nearest over distance to the second nearest; None = no ratio test.
    VLFeat's matcher, used by A, accepts 1.5 d1^2 < d2^2: a ratio of 0.816.
    """
    version: ClassVar[int] = 2

    def __call__(self, a: Features, b: Features) -> Matches:
        """Putative matches of two photos, by increasing distance of their descriptors."""
        if not len(a) or not len(b):
            return no_matches()
        similarity = similarities(a, b)
        best = similarity.argmax(1)
        mutual = np.flatnonzero(similarity.argmax(0)[best] == np.arange(len(a)))
        if self.ratio is not None and len(b) > 1:
            best_first = similarity[mutual, best[mutual]]
            second = np.partition(similarity[mutual], -2, axis=1)[:, -2]
            # for unit vectors d^2 = 2 - 2 s
            mutual = mutual[(1 - best_first) < self.ratio**2 * (1 - second)]
        order = np.argsort(-similarity[mutual, best[mutual]], kind="stable")[: self.count]
        return Matches(index_a=mutual[order], index_b=best[mutual[order]])
