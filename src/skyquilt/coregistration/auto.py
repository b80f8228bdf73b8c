"""Registration by image structure, coarse to fine; accepted only if independent patches agree."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from skyquilt.coregistration.candidates import Candidate, Nearby, distinct, same_view
from skyquilt.coregistration.common_part import LEAST_PX, common_part
from skyquilt.coregistration.decision import Decide, distinctness
from skyquilt.coregistration.everywhere import Everywhere
from skyquilt.coregistration.orientation import Orientation, Pyramid, full_size, orientation
from skyquilt.coregistration.points import PointMatches
from skyquilt.coregistration.structure import Proposal, StructureMatches, sharpened
from skyquilt.coregistration.subpixel import Fit, SubpixelRefinement
from skyquilt.coregistration.usable import Usable, both_usable
from skyquilt.model.registration import Guess, Matrix, Outcome, Picture, RefusedRegistration

_SEARCH, _NEARBY, _SELECT, _DECIDE = range(4)
_WORTH = 1.25
"""Least ratio of the largest to the smallest scale for which parts are searched."""
_APART = 0.04
"""How far apart, as a share of a's longer side, places of a part are that are tried."""


def _quick(smallest: float, largest: float) -> Everywhere:
    """A search in coarse steps by the first field alone, for many small parts of large planes."""
    return Everywhere(
        turns=0.55,
        step_scale=1.13,
        smallest=smallest,
        largest=largest,
        overlap=0.6,
        first_only=True,
    )


@dataclass(frozen=True, kw_only=True)
class Within:
    """A search for one image as a part of the other."""

    times: float
    """Pixels of the whole image along its side, for each one of the part along its own."""
    search: Everywhere
    """The search."""
    least_px: int = 0
    """Px that the part must have in the whole along its shorter side."""

    def fitting(self, whole: tuple[int, ...]) -> Everywhere | None:
        """The search for parts that have enough pixels in a whole of this shape (H, W); None if
        none have.
        """
        smallest = max(self.search.smallest, self.least_px / min(whole))
        if smallest * _WORTH > self.search.largest:
            return None
        return replace(self.search, smallest=smallest)


@dataclass(frozen=True, kw_only=True)
class Auto:
    """The default method. Structure matches are fast and tolerate distortion. If patches do not
    clearly confirm them, the neighbourhood of a guess and then all rotations and a range of scales
    are searched; if nothing is confirmed, places at which one image shows a part of the other only.
    """

    propose: StructureMatches
    """Structure matches."""
    everywhere: Everywhere = field(default_factory=Everywhere)
    """Search without prior knowledge."""
    within: Within = field(
        default_factory=lambda: Within(
            times=2.0,
            search=Everywhere(turns=0.85, smallest=1 / 2.9, largest=1 / 1.45, overlap=0.6),
        )
    )
    """Search for one as a part of the other."""
    points: PointMatches
    """Matches for one that shows any part of the other in the same spectrum."""
    deeper: tuple[Within, ...] = (
        Within(times=3.0, least_px=LEAST_PX, search=_quick(smallest=1 / 4.7, largest=1 / 2.8)),
        Within(times=5.0, least_px=LEAST_PX, search=_quick(smallest=1 / 6.0, largest=1 / 4.7)),
    )
    """Searches for one as a smaller part of the other."""
    parts: int = 2
    """Places of both that are tried of each of these."""
    nearby: Nearby = field(default_factory=Nearby)
    """Search around the guess (without a guess: two cameras side by side with equal fields of
    view).
    """
    decide: Decide = field(default_factory=Decide)
    """The decision."""
    sides: tuple[float, float, float, float] = (80.0, 128.0, 160.0, 256.0)
    """Sides in px of the squares to whose areas the images are reduced: for search, search near the
    guess, selection, decision.
    """
    sure: float = 6.0
    """Agreement above which nothing else is tried."""
    beyond: bool = True
    """Whether everything is searched where a guess is not confirmed."""
    version: ClassVar[int] = 9

    def __call__(self, a: Picture, b: Picture, guess: Guess | None = None) -> Outcome:
        """The registration of b to a, or the reason why there is none.

        A guess is tried first. If it is not confirmed, everything is searched (if `beyond`), since
        metadata may be wrong.
        """
        if guess is not None:
            found = self._guided(a, b, guess, told=True)
            if found or not self.beyond:
                return found
        pictures = both_usable(a, b)
        if isinstance(pictures, RefusedRegistration):
            return pictures
        pyramid = Pyramid(a=pictures[0], b=pictures[1], sides=self.sides)
        proposed = self.propose(*pictures)
        matched = proposed.b_H_a
        first = [] if matched is None else [sharpened(pyramid, matched, _SELECT)]
        found = self.decide(pyramid, first)
        if found.evidence.get("surprise", 0.0) >= self.sure:
            return found
        places = self._near(pyramid, same_view(a.shape, b.shape)) + self._anywhere(pyramid)
        found = self.decide(pyramid, first + self._best(pyramid, places))
        if found.evidence.get("surprise", 0.0) >= self.decide.least_surprise:
            return found
        return self._stretched(pyramid, proposed) or self._in_part(a, b, pictures) or found

    def _guided(self, a: Picture, b: Picture, guess: Guess, *, told: bool = False) -> Outcome:
        """The decision in the neighbourhood of a guess, on the part that both images then share;
        `told`: it is known beforehand, which excludes places beyond its reach.
        """
        part = common_part(a, b, guess)
        pictures = both_usable(part.a, part.b)
        if isinstance(pictures, RefusedRegistration):
            return pictures
        pyramid = Pyramid(a=pictures[0], b=pictures[1], sides=self.sides)
        fits = self._best(pyramid, self._near(pyramid, part.guess))
        reach = part.guess.reach * max(pyramid.at(_DECIDE)[1].shape) if told else float("inf")
        return part.whole(self.decide(pyramid, fits, reach, told=told))

    def _stretched(self, pyramid: Pyramid, proposed: Proposal) -> Outcome:
        """The decision where pixels of one image are longer than wide."""
        matched = proposed.stretched()
        fits = [] if matched is None else [sharpened(pyramid, matched, _SELECT, "affine")]
        return self.decide(pyramid, fits)

    def _in_part(self, a: Picture, b: Picture, pictures: tuple[Usable, Usable]) -> Outcome:
        """The decision where one image shows a part of the other only. Each of the best places is
        a guess, so that the same ground is compared.
        """
        best: Outcome = RefusedRegistration(reason="no part of one image was found in the other")
        for ways in ((self.within,), self.points, self.deeper):
            if isinstance(ways, PointMatches):
                matched = ways(*pictures).b_H_a
                places = [] if matched is None else [Candidate(b_H_a=matched, score=0.0)]
            else:
                places = [p for way in ways for p in self._parts(pictures, way)]
            for place in distinct(places, a.shape, _APART * max(a.shape), self.parts):
                guess = Guess(b_H_a=place.b_H_a, reach=0.05, rotation_deg=4.0, scale=1.08)
                best = max(best, self._guided(a, b, guess), key=_worth)
                if _worth(best)[1] >= self.sure:
                    return best
            if _worth(best)[1] >= self.decide.least_surprise:
                return best
        return best

    def _parts(self, pictures: tuple[Usable, Usable], way: Within) -> list[Candidate]:
        """Places, in px of the images, at which one is a part of the other, by distinctness."""
        side, places = self.sides[_SEARCH], []
        for pair, swapped in ((pictures, False), (pictures[::-1], True)):
            search = way.fitting(pair[0].grey.shape)
            if search is None:
                continue
            whole, part = (
                orientation(p.grey, p.valid, s)
                for p, s in zip(pair, (way.times * side, side), strict=True)
            )
            # the part is turned and the whole stays, so that all of it lies in the plane
            found = [replace(c, b_H_a=_inverse(c.b_H_a)) for c in search(part, whole)]
            for c in _sifted(whole, part, found):
                full = full_size(whole, part, c.b_H_a)
                places.append(
                    Candidate(
                        b_H_a=_inverse(full) if swapped else full,
                        score=distinctness(whole, part, c.b_H_a),
                    )
                )
        return places

    def _near(self, pyramid: Pyramid, guess: Guess) -> list[Matrix]:
        """Candidate transforms near a guess, in px of the selection level."""
        a, b = pyramid.at(_NEARBY)
        found = distinct(self.nearby(a, b, guess), a.shape, 3, 8)
        return [pyramid.moved(c.b_H_a, _NEARBY, _SELECT) for c in found]

    def _anywhere(self, pyramid: Pyramid) -> list[Matrix]:
        """Candidate transforms of all rotations and scales, in px of the selection level."""
        a, b = pyramid.at(_SEARCH)
        found = _sifted(a, b, self.everywhere(a, b))
        return [pyramid.moved(c.b_H_a, _SEARCH, _SELECT) for c in found]

    def _best(self, pyramid: Pyramid, places: Sequence[Matrix]) -> list[Fit]:
        """The few most distinct ones, refined at the decision level."""
        a, b = pyramid.at(_SELECT)
        found = distinct(_sharpened(a, b, places, 5), a.shape, 2, 8)
        found.sort(key=lambda c: -distinctness(a, b, c.b_H_a))
        a, b = pyramid.at(_DECIDE)
        fits = [
            SubpixelRefinement()(a, b, pyramid.moved(c.b_H_a, _SELECT, _DECIDE)) for c in found[:3]
        ]
        kept = distinct([Candidate(b_H_a=f.b_H_a, score=f.score) for f in fits], a.shape, 2, 3)
        return [f for f in fits if any(f.b_H_a is c.b_H_a for c in kept)]


def _worth(outcome: Outcome) -> tuple[bool, float]:
    return bool(outcome), outcome.evidence.get("surprise", 0.0)


def _inverse(matrix: Matrix) -> Matrix:
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _sifted(a: Orientation, b: Orientation, found: Sequence[Candidate]) -> list[Candidate]:
    """The few best of many candidates, refined, in px of the same resolution."""
    rough = distinct(found, a.shape, 3, 40)
    better = distinct(_sharpened(a, b, [c.b_H_a for c in rough], 2), a.shape, 1.5, 16)
    return distinct(_sharpened(a, b, [c.b_H_a for c in better], 3), a.shape, 1.5, 8)


def _sharpened(
    a: Orientation, b: Orientation, places: Sequence[Matrix], steps: int
) -> list[Candidate]:
    fits = [SubpixelRefinement(steps=steps)(a, b, place) for place in places]
    return [Candidate(b_H_a=fit.b_H_a, score=fit.score) for fit in fits]
