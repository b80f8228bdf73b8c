"""Registration by a structure descriptor, verified like everything else by agreement of patches."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.decision import Decide
from skyquilt.coregistration.index_features import IndexFeatures, index_features, mutual
from skyquilt.coregistration.log_gabor import phase
from skyquilt.coregistration.orientation import Pyramid, shrunken
from skyquilt.coregistration.subpixel import Fit, SubpixelRefinement
from skyquilt.coregistration.usable import Usable, both_usable
from skyquilt.model.estimate import Estimate, NoEstimate
from skyquilt.model.registration import Guess, Matrix, Picture, RefusedRegistration, Registration

Estimator = Callable[[NDArray[Any], NDArray[Any]], Estimate | NoEstimate]


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal:
    """What matches say, not yet verified."""

    b_H_a: Matrix | None
    """(3, 3) in px of the pictures; None where matches agree on nothing."""
    matches: int
    """How many there were."""
    reason: str = ""
    """Why there is no transform."""


@dataclass(frozen=True, kw_only=True)
class StructureMatches:
    """Phase congruency, maximum index map, mutual matches, one similarity."""

    estimate: Estimator
    """A similarity from matches (n, 2), or none."""
    count: int = 1500
    """Most keypoints of a picture."""
    patch: int = 72
    """Px of a descriptor's patch, a multiple of 6."""
    side: float = 320.0
    """Px of the square whose area the pictures are shrunken to."""
    version: ClassVar[int] = 1

    def __call__(self, a: Usable, b: Usable) -> Proposal:
        """The transform that most matches agree on."""
        (fa, full_a), (fb, full_b) = self._features(a), self._features(b)
        in_a, in_b = mutual(fa, fb)
        found = self.estimate(fa.px[in_a], fb.px[in_b])
        if isinstance(found, NoEstimate):
            return Proposal(b_H_a=None, matches=len(in_a), reason=found.reason)
        full = np.linalg.inv(full_b) @ found.b_H_a @ full_a
        return Proposal(b_H_a=full / full[2, 2], matches=len(in_a))

    def _features(self, picture: Usable) -> tuple[IndexFeatures, Matrix]:
        """Features, and what takes full-size pixels to theirs."""
        grey, valid, small_S_full = shrunken(picture.grey, picture.valid, self.side)
        # what is no picture gets the mean, whose edge is weaker than that of black or white
        filled = np.where(valid, grey, grey[valid].mean() if valid.any() else 0).astype(np.float32)
        return index_features(
            phase(filled), valid, count=self.count, patch=self.patch
        ), small_S_full


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Structure matches, sharpened and verified."""

    propose: StructureMatches
    """The matches."""
    decide: Decide = field(default_factory=Decide)
    """The verdict."""
    sides: tuple[float, float] = (160.0, 256.0)
    """Px of the squares whose areas the pictures are shrunken to: sharpening, verdict."""
    version: ClassVar[int] = 1

    def __call__(
        self, a: Picture, b: Picture, guess: Guess | None = None
    ) -> Registration | RefusedRegistration:
        """The registration of b to a, or why there is none; a guess is not used."""
        pictures = both_usable(a, b)
        if isinstance(pictures, RefusedRegistration):
            return pictures
        proposal = self.propose(*pictures)
        if proposal.b_H_a is None:
            return RefusedRegistration(
                reason=proposal.reason, evidence={"matches": float(proposal.matches)}
            )
        pyramid = Pyramid(a=pictures[0], b=pictures[1], sides=self.sides)
        return self.decide(pyramid, [sharpened(pyramid, proposal.b_H_a, pyramid.last - 1)])


def sharpened(pyramid: Pyramid, b_H_a: Matrix, level: int) -> Fit:
    """A transform of the pictures' pixels sharpened at a level, then at the last one, in whose px
    it is.
    """
    rough = SubpixelRefinement()(*pyramid.at(level), pyramid.small(b_H_a, level))
    return SubpixelRefinement()(
        *pyramid.at(pyramid.last), pyramid.moved(rough.b_H_a, level, pyramid.last)
    )
