"""Registration by structure, coarse to fine, believed only where independent patches agree."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.registration import Guess, Matrix, Picture, RefusedRegistration, Registration
from skyquilt.spectral.agreement import Agree, Agreement
from skyquilt.spectral.candidates import Candidate, distinct
from skyquilt.spectral.distinctness import distinctness
from skyquilt.spectral.everywhere import Everywhere
from skyquilt.spectral.nearby import Nearby, same_view
from skyquilt.spectral.orientation import Orientation, between, full_size, orientation
from skyquilt.spectral.sharpen import Fit, Freedom, Sharpen
from skyquilt.spectral.usable import Usable, usable

Outcome = Registration | RefusedRegistration


@dataclass(frozen=True, kw_only=True)
class Auto:
    """The default: every rotation and a range of scales are searched, plus the neighbourhood of a guess."""

    everywhere: Everywhere = field(default_factory=Everywhere)
    """Search without knowledge."""
    nearby: Nearby = field(default_factory=Nearby)
    """Search about the guess (without one: two cameras side by side with equal fields of view)."""
    agree: Agree = field(default_factory=Agree)
    """The test."""
    sides: tuple[float, ...] = (80.0, 128.0, 160.0, 256.0)
    """Sides in px of the squares whose areas the pictures are shrunken to: search, search nearby,
    selection, decision."""
    least_surprise: float = 5.0
    """Agreement below which a registration is refused; see docs/methods.md for what chance reaches."""
    gain: float = 0.02
    """Relative gain in correlation that a freer model must bring to be preferred."""
    version: ClassVar[int] = 1

    def __call__(self, a: Picture, b: Picture, guess: Guess | None = None) -> Outcome:
        """The registration of b to a, or why there is none.

        A guess is tried first; where it is not confirmed the search goes on everywhere: metadata may lie.
        """
        ua, ub = usable(a), usable(b)
        for name, one in (("A", ua), ("B", ub)):
            if not one:
                return RefusedRegistration(reason=f"picture {name} {one.reason}")
        pyramid = _Pyramid(a=ua, b=ub, sides=self.sides)
        if guess is not None and (
            found := self._judged(pyramid, self._fits(pyramid, guess, everywhere=False))
        ):
            return found
        return self._judged(pyramid, self._fits(pyramid, same_view(a.shape, b.shape), everywhere=True))

    def _judged(self, pyramid: "_Pyramid", fits: list[Fit]) -> Outcome:
        """The fit that most patches confirm, or why none is believed."""
        judged = [(self.agree(*pyramid.at(3), fit.b_H_a), fit) for fit in fits]
        if not judged:
            return RefusedRegistration(reason="no place was found where enough of both pictures overlaps")
        agreement, fit = max(judged, key=lambda j: j[0].surprise)
        if agreement.surprise < self.least_surprise:
            return RefusedRegistration(
                reason=_doubt(agreement, self.least_surprise),
                inliers=len(agreement.px),
                evidence=_evidence(agreement, fit),
            )
        return self._finished(pyramid, fit, agreement)

    def _fits(self, pyramid: "_Pyramid", guess: Guess, *, everywhere: bool) -> list[Fit]:
        """The best few places at the last resolution."""
        a, b = pyramid.at(1)
        near = distinct(self.nearby(a, b, guess), a.shape, 3, 8)
        candidates = [pyramid.moved(c.b_H_a, 1, 2) for c in near]
        if everywhere:
            candidates += [pyramid.moved(m, 0, 2) for m in self._anywhere(*pyramid.at(0))]
        a, b = pyramid.at(2)
        places = _sharpened(a, b, candidates, 5)
        best = sorted(distinct(places, a.shape, 2, 8), key=lambda c: -distinctness(a, b, c.b_H_a))
        a, b = pyramid.at(3)
        finest = [Sharpen()(a, b, pyramid.moved(c.b_H_a, 2, 3)) for c in best[:3]]
        kept = distinct([Candidate(b_H_a=f.b_H_a, score=f.score) for f in finest], a.shape, 2, 3)
        return [f for f in finest if any(f.b_H_a is c.b_H_a for c in kept)]

    def _anywhere(self, a: Orientation, b: Orientation) -> list[Matrix]:
        rough = distinct(self.everywhere(a, b), a.shape, 3, 40)
        return [c.b_H_a for c in distinct(_sharpened(a, b, [c.b_H_a for c in rough], 5), a.shape, 1.5, 8)]

    def _finished(self, pyramid: "_Pyramid", fit: Fit, agreement: Agreement) -> Registration:
        """The model that the pictures support, in full-size pixels."""
        a, b = pyramid.at(3)
        freedoms: tuple[Freedom, ...] = ("affine", "homography")
        model: Freedom = "similarity"
        for freer in freedoms:
            other = Sharpen(freedom=freer)(a, b, fit.b_H_a)
            if other.correlation > (1 + self.gain) * fit.correlation:
                model, fit = freer, other
                agreement = self.agree(a, b, fit.b_H_a)
        px_b = _apply(np.linalg.inv(b.small_S_full), agreement.px + agreement.shift)
        px_a = _apply(np.linalg.inv(b.small_S_full @ full_size(a, b, fit.b_H_a)), agreement.px)
        return Registration(
            model=model, b_H_a=full_size(a, b, fit.b_H_a), px_a=px_a, px_b=px_b,
            evidence=_evidence(agreement, fit),
        )  # fmt: skip


class _Pyramid:
    """Both pictures at the resolutions asked for, made when first needed."""

    def __init__(self, *, a: Usable, b: Usable, sides: Sequence[float]) -> None:
        self._pictures, self._sides = (a, b), sides
        self._levels: dict[int, tuple[Orientation, Orientation]] = {}

    def at(self, level: int) -> tuple[Orientation, Orientation]:
        """a and b."""
        if level not in self._levels:
            a, b = (orientation(p.grey, p.valid, self._sides[level]) for p in self._pictures)
            self._levels[level] = a, b
        return self._levels[level]

    def moved(self, small: Matrix, source: int, target: int) -> Matrix:
        """A transform in px of one resolution in those of another."""
        return between(*self.at(target), full_size(*self.at(source), small))


def _sharpened(a: Orientation, b: Orientation, places: Sequence[Matrix], steps: int) -> list[Candidate]:
    fits = [Sharpen(steps=steps)(a, b, place) for place in places]
    return [Candidate(b_H_a=fit.b_H_a, score=fit.score) for fit in fits]


def _apply(matrix: NDArray, px: NDArray) -> np.ndarray:
    moved = np.c_[px, np.ones(len(px))] @ matrix.T
    return np.asarray(moved[:, :2] / moved[:, 2:])


def _evidence(agreement: Agreement, fit: Fit) -> dict[str, float]:
    return {
        "surprise": round(agreement.surprise, 3),
        "patches": float(agreement.patches),
        "patches_agreeing": float(len(agreement.px)),
        "correlation": round(fit.correlation, 4),
    }


def _doubt(agreement: Agreement, least: float) -> str:
    return (
        f"the best place found is not confirmed: {len(agreement.px)} of {agreement.patches} patches find it by"
        f" themselves, which is worth 10^-{agreement.surprise:.1f} where 10^-{least:g} is asked for"
    )
