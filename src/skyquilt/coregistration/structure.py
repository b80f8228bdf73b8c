"""Registration by a structure descriptor, verified by the agreement of patches."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.decision import Decide
from skyquilt.coregistration.index_features import IndexFeatures, index_features, mutual, phase
from skyquilt.coregistration.orientation import Pyramid, shrunken
from skyquilt.coregistration.subpixel import Fit, Freedom, SubpixelRefinement
from skyquilt.coregistration.usable import Usable, both_usable
from skyquilt.model.estimate import Estimate, NoEstimate
from skyquilt.model.registration import Guess, Matrix, Picture, RefusedRegistration, Registration

Estimator = Callable[[NDArray[Any], NDArray[Any]], Estimate | NoEstimate]


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal:
    """A transform from matches, not verified yet."""

    b_H_a: Matrix | None
    """(3, 3) in px of the images; None if the matches do not fit a common transform."""
    matches: int
    """Number of matches."""
    reason: str = ""
    """Why there is no transform."""
    stretched: Callable[[], Matrix | None] = lambda: None
    """Looks for an affine transform (3, 3) in px of the images; None if there is none."""


class Proposes(Protocol):
    """A way to propose a transform."""

    def __call__(self, a: Usable, b: Usable) -> Proposal:
        """The transform, or why there is none."""
        ...


@dataclass(frozen=True, kw_only=True)
class StructureMatches:
    """Phase congruency, maximum index map, mutual matches, one similarity."""

    estimate: Estimator
    """Estimator of a similarity from matches (n, 2)."""
    stretch: Estimator | None = None
    """The same of an affine transform; None: none is looked for."""
    count: int = 1500
    """Largest number of keypoints per image."""
    patch: int = 72
    """Side in px of a descriptor's patch, a multiple of 6."""
    side: float = 320.0
    """Side in px of the square to whose area the images are reduced."""
    version: ClassVar[int] = 1

    def __call__(self, a: Usable, b: Usable) -> Proposal:
        """The transform on which most matches agree."""
        # as many pixels of both: descriptors of the same ground are alike at the same size only
        side = min(self.side, *(float(np.sqrt(p.grey.size)) for p in (a, b)))
        (fa, full_a), (fb, full_b) = self._features(a, side), self._features(b, side)
        in_a, in_b = mutual(fa, fb)
        px = fa.px[in_a], fb.px[in_b]

        def full(estimate: Estimate | NoEstimate) -> Matrix | None:
            if isinstance(estimate, NoEstimate):
                return None
            moved = np.linalg.inv(full_b) @ estimate.b_H_a @ full_a
            return np.asarray(moved / moved[2, 2])

        found = self.estimate(*px)
        return Proposal(
            b_H_a=full(found),
            matches=len(in_a),
            reason=found.reason if isinstance(found, NoEstimate) else "",
            stretched=lambda: full(self.stretch(*px)) if self.stretch else None,
        )

    def _features(self, picture: Usable, side: float) -> tuple[IndexFeatures, Matrix]:
        """Features, and the transform from full-size pixels to theirs."""
        grey, valid, small_S_full = shrunken(picture.grey, picture.valid, side)
        # invalid pixels get the mean, whose edges are weaker than those of black or white
        filled = np.where(valid, grey, grey[valid].mean() if valid.any() else 0).astype(np.float32)
        return index_features(
            phase(filled), valid, count=self.count, patch=self.patch
        ), small_S_full


@dataclass(frozen=True, kw_only=True)
class Structure:
    """A proposal by matches, refined and verified."""

    propose: Proposes
    """The matches."""
    decide: Decide = field(default_factory=Decide)
    """The decision."""
    sides: tuple[float, float] = (160.0, 256.0)
    """Sides in px of the squares to whose areas the images are reduced: for refinement,
    decision.
    """
    version: ClassVar[int] = 3

    def __call__(
        self, a: Picture, b: Picture, guess: Guess | None = None
    ) -> Registration | RefusedRegistration:
        """The registration of b to a, or the reason why there is none; a guess is not used."""
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


def sharpened(pyramid: Pyramid, b_H_a: Matrix, level: int, freedom: Freedom = "similarity") -> Fit:
    """Refines a transform of the images' pixels at a level, then at the last level; the result is
    in px of the last level.
    """
    refine = SubpixelRefinement(freedom=freedom)
    rough = refine(*pyramid.at(level), pyramid.small(b_H_a, level))
    return refine(*pyramid.at(pyramid.last), pyramid.moved(rough.b_H_a, level, pyramid.last))
