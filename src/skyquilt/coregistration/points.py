"""Registration of a picture that shows a small part of another one of the same spectrum, by points.

SIFT finds its points at the scale of what they show, so one picture may be many times as near as
the other. In pictures of two spectra it finds few in common; structure matches and the search
(`auto`) are for those.
"""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.orientation import MARGIN, shrunken
from skyquilt.coregistration.structure import Estimator, Proposal
from skyquilt.coregistration.usable import Usable
from skyquilt.matching.matchers import Mutual
from skyquilt.matching.sift import Sift
from skyquilt.model.estimate import NoEstimate
from skyquilt.model.features import Features
from skyquilt.model.registration import Matrix


@dataclass(frozen=True, kw_only=True)
class PointMatches:
    """SIFT, mutual matches, one similarity of any scale."""

    estimate: Estimator
    """Estimator of a similarity from matches (n, 2)."""
    detect: Sift = field(
        default_factory=lambda: Sift(count=3000, longest=4096, doubled=0, contrast=0.01)
    )
    """Points of both pictures."""
    match: Mutual = field(default_factory=Mutual)
    """Matches."""
    side: float = 700.0
    """Side in px of the square to whose area pictures are reduced."""
    version: ClassVar[int] = 1

    def __call__(self, a: Usable, b: Usable) -> Proposal:
        """The transform on which most matches agree."""
        (fa, full_a), (fb, full_b) = self._points(a), self._points(b)
        matches = self.match(fb, fa)
        found = self.estimate(fa.px[matches.index_b], fb.px[matches.index_a])
        if isinstance(found, NoEstimate):
            return Proposal(b_H_a=None, matches=len(matches.index_a), reason=found.reason)
        moved = np.linalg.inv(full_b) @ found.b_H_a @ full_a
        return Proposal(b_H_a=np.asarray(moved / moved[2, 2]), matches=len(matches.index_a))

    def _points(self, picture: Usable) -> tuple[Features, Matrix]:
        """Points of the valid part, and the transform from full-size pixels to theirs."""
        grey, valid, small_S_full = shrunken(picture.grey, picture.valid, self.side)
        found = self.detect(_levels(grey, valid))
        inner = cv2.erode(valid.astype(np.uint8), np.ones((2 * MARGIN + 1,) * 2), borderValue=1)
        column, row = np.rint(found.px).astype(int).T
        kept = inner[row, column] > 0
        return replace(
            found, px=found.px[kept], size=found.size[kept], descriptors=found.descriptors[kept]
        ), small_S_full


def _levels(grey: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Values (h, w) of any unit in 8 bits, between the 0.5th and 99.5th percentile."""
    low, high = np.percentile(grey[valid], [0.5, 99.5]) if valid.any() else (0.0, 0.0)
    factor = 255 / max(float(high - low), 1e-6)
    return np.asarray(np.clip((grey - low) * factor, 0, 255), np.uint8)
