"""Matches guided by where each keypoint is expected in the other photo."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.matching.similarity import no_matches, similarities
from skyquilt.model.features import Features, Matches


@dataclass(frozen=True, kw_only=True)
class Guided:
    """Each other's nearest among those within a radius of the expected place."""

    radius_px: float = 100.0
    """Farthest that a match lies from where it is expected, px of the full photo b."""
    ratio: float = 0.9
    """Largest distance to the nearest over distance to the second nearest within the radius."""
    distance: float = 0.8
    """Largest distance of two unit descriptors (0 equal, sqrt 2 unrelated): a circle may hold no
    second to compare with. Of binary ones, half of it is the largest share of bits that differ.
    """
    version: ClassVar[int] = 1

    def __call__(self, a: Features, b: Features, predicted: NDArray[np.float64]) -> Matches:
        """Putative matches; `predicted` (len(a), 2) px of b, NaN where nothing is known, which
        matches nothing.
        """
        if predicted.shape != (len(a), 2):
            raise ValueError(
                f"a place for each of {len(a)} keypoints expected, got {predicted.shape}"
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
