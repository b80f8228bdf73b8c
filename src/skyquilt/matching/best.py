"""The n best mutual nearest neighbours by distance [A 2.4: 150 within a flight line, 50 across]."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from skyquilt.matching.similarity import no_matches, similarities
from skyquilt.model.features import Features, Matches


@dataclass(frozen=True, kw_only=True)
class Best:
    """Each other's nearest, the nearest of them first; no ratio is asked for."""

    count: int = 150
    """Most matches."""
    version: ClassVar[int] = 1

    def __call__(self, a: Features, b: Features) -> Matches:
        """Putative matches of two photos, by increasing distance of their descriptors."""
        if not len(a) or not len(b):
            return no_matches()
        similarity = similarities(a, b)
        best = similarity.argmax(1)
        mutual = np.flatnonzero(similarity.argmax(0)[best] == np.arange(len(a)))
        order = np.argsort(-similarity[mutual, best[mutual]], kind="stable")[: self.count]
        return Matches(index_a=mutual[order], index_b=best[mutual[order]])
