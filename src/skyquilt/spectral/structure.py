"""Registration by a structure descriptor, verified like everything else by agreement of patches."""

from dataclasses import dataclass, field
from typing import ClassVar

import cv2
import numpy as np

from skyquilt.model.estimate import NoEstimate
from skyquilt.model.registration import Guess, Picture, RefusedRegistration, Registration
from skyquilt.spectral.by_features import Estimator
from skyquilt.spectral.decision import Decide
from skyquilt.spectral.index_features import IndexFeatures, index_features, mutual
from skyquilt.spectral.log_gabor import phase
from skyquilt.spectral.pyramid import Pyramid
from skyquilt.spectral.sharpen import Sharpen
from skyquilt.spectral.usable import Usable, both_usable


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Phase congruency, maximum index map, mutual matches, one similarity, sharpened and verified."""

    estimate: Estimator
    """A similarity from matches (n, 2), or none."""
    count: int = 1500
    """Most keypoints of a picture."""
    patch: int = 72
    """Px of a descriptor's patch, a multiple of 6."""
    side: float = 320.0
    """Px of the square whose area the pictures are shrunken to."""
    decide: Decide = field(default_factory=Decide)
    """The verdict."""
    version: ClassVar[int] = 1

    def __call__(
        self, a: Picture, b: Picture, guess: Guess | None = None
    ) -> Registration | RefusedRegistration:
        """The registration of b to a, or why there is none; a guess is not used."""
        pictures = both_usable(a, b)
        if isinstance(pictures, RefusedRegistration):
            return pictures
        pyramid = Pyramid(a=pictures[0], b=pictures[1], sides=(self.side, 160.0, 256.0))
        fa, fb = (self._features(p, o.shape) for p, o in zip(pictures, pyramid.at(0), strict=True))
        in_a, in_b = mutual(fa, fb)
        found = self.estimate(fa.px[in_a], fb.px[in_b])
        evidence = {"matches": float(len(in_a))}
        if isinstance(found, NoEstimate):
            return RefusedRegistration(reason=found.reason, evidence=evidence)
        rough = Sharpen()(*pyramid.at(1), pyramid.moved(found.b_H_a, 0, 1))
        fine = Sharpen()(*pyramid.at(2), pyramid.moved(rough.b_H_a, 1, 2))
        return self.decide(pyramid, [fine])

    def _features(self, picture: Usable, shape: tuple[int, int]) -> IndexFeatures:
        size = (shape[1], shape[0])
        grey = cv2.resize(picture.grey, size, interpolation=cv2.INTER_AREA)
        valid = cv2.resize(picture.valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
        filled = np.where(valid, grey, grey[valid].mean()).astype(np.float32)
        return index_features(phase(filled), valid, count=self.count, patch=self.patch)
