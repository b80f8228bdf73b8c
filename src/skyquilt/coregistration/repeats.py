"""Whether the pictures fit as well one period further: rows of crops, trees in a grid, tiles.

Patches confirm a registration of regular texture at any of its periods, because each of them
compares small shifts only. Here the registered place is compared with the best of all places
further away.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.agreement import Agree
from skyquilt.coregistration.orientation import Orientation, at_all_shifts, own_radius, warped
from skyquilt.coregistration.subpixel import SubpixelRefinement
from skyquilt.model.registration import Matrix

Correlations = dict[tuple[int, int], float]
"""Correlation of each patch, by its row and column."""


@dataclass(frozen=True, kw_only=True)
class Rival:
    """Another place at which the pictures fit."""

    shift: tuple[float, float]
    """From the registered place to it, along x and y, px of b."""
    lead: float
    """By how much more patches fit at the registered place than here: the mean difference of their
    correlations divided by its standard error. Below 0 they fit better here.
    """


@dataclass(frozen=True, kw_only=True)
class Repeats:
    """Finds places that fit about as well as the registered one.

    Registrations of 34 pairs, each changed in eight ways, correlate elsewhere to 0.77 of their own
    correlation at most; trees in a grid one period away to 0.74 where each stands a little off it,
    and to 0.92 and more where nothing tells the periods apart. Roofs and tanks of other places, in
    grids with gaps, do so to 0.63 to 0.81: of hundreds of periods one has its gaps at the same
    places by chance. There fewer patches agree than at the true place, where no gap contradicts.
    """

    nearly: float = 0.85
    """Correlation of a rival from which `clear` is required, as a share of that at the registered
    place.
    """
    partly: float = 0.75
    """The same from which `preferred` is required."""
    least: float = 0.5
    """The same from which another place is a rival at all, where patches disagree."""
    clear: float = 5.0
    """Lead from which the registered place is the right one all the same. With nothing that tells
    periods apart it was 3.7 at most.
    """
    preferred: float = 1.0
    """Lead with which patches prefer the registered place at all."""
    undisputed: float = 0.7
    """Share of patches that agree, below which the lead required of any rival rises evenly from
    none at `least` to `clear`. It was 0.65 at most at other places, of tanks at the true one 0.92
    at least. Where a rival is none, as in most pictures, no such share is asked for.
    """
    overlap: float = 0.5
    """Least overlap of another place, as a share of that of the registered one."""
    most: int = 3
    """Other places that are tried."""
    fewest: int = 4
    """Patches that both places must have in common, or each of them."""
    version: ClassVar[int] = 3

    def __call__(
        self,
        a: Orientation,
        b: Orientation,
        b_H_a: Matrix,
        agree: Agree,
        reach: float = float("inf"),
        agreeing: float = 1.0,
    ) -> Rival | None:
        """The strongest rival of a transform in px of this resolution, at most `reach` px away;
        None if there is none. `agreeing`: share of patches that agree with the transform.
        """
        starts, found = list(self._places(a, b, b_H_a, agree)), []
        here = _correlations(a, b, b_H_a, agree) if starts else {}
        middle = np.array([b.shape[1] / 2, b.shape[0] / 2, 1.0])
        for share, start in starts:
            fit = SubpixelRefinement(steps=3)(a, b, start)
            moved = fit.b_H_a @ np.linalg.inv(b_H_a) @ middle
            shift = moved[:2] / moved[2] - middle[:2]
            if _own(b.shape, agree) / 2 < np.hypot(*shift) <= reach:
                lead = self._lead(here, _correlations(a, b, fit.b_H_a, agree))
                if lead is not None and lead < self._required(share, agreeing):
                    found.append(Rival(shift=(float(shift[0]), float(shift[1])), lead=lead))
        return min(found, key=lambda r: r.lead, default=None)

    def _required(self, share: float, agreeing: float) -> float:
        """Lead over a rival whose correlation is such a share of that at the registered place."""
        if share >= self.nearly:
            return self.clear
        least = self.preferred if share >= self.partly else -float("inf")
        if agreeing >= self.undisputed:
            return least
        return max(least, self.clear * (share - self.least) / (self.nearly - self.least))

    def _places(
        self, a: Orientation, b: Orientation, b_H_a: Matrix, agree: Agree
    ) -> Iterator[tuple[float, Matrix]]:
        """Other peaks of the correlation, as a share of that at the transform, and the transform
        shifted to each.
        """
        z, _ = at_all_shifts(a, b, b_H_a, self.overlap)
        shape = z.shape
        near = np.arange(-agree.near, agree.near + 1)
        here = float(z[np.ix_(near, near)].max())
        around = np.arange(-_own(b.shape, agree), _own(b.shape, agree) + 1)
        z[np.ix_(around, around)] = 0
        for _ in range(self.most):
            y, x = divmod(int(z.argmax()), shape[1])
            if z[y, x] <= max(self.least * here, 0.0):
                return
            share = float(z[y, x]) / max(here, 1e-9)
            # the warped a at p + (x, y) looks like b at p: a belongs (x, y) further back
            back = [x - shape[1] * (x > shape[1] / 2), y - shape[0] * (y > shape[0] / 2)]
            moved = np.array([[1, 0, -back[0]], [0, 1, -back[1]], [0, 0, 1.0]]) @ b_H_a
            yield share, moved
            z[np.ix_((y + around) % shape[0], (x + around) % shape[1])] = 0

    def _lead(self, here: Correlations, there: Correlations) -> float | None:
        """From patches that are covered at both places, or, where these are too few, as where one
        picture shows a part of the other, from all of either; None where these are, too.
        """
        difference = np.array([here[at] - there[at] for at in here if at in there])
        if len(difference) >= self.fewest:
            return float(difference.mean()) / max(_error(difference), 1e-9)
        if min(len(here), len(there)) < self.fewest:
            return None
        own, other = np.array(list(here.values())), np.array(list(there.values()))
        error = float(np.hypot(_error(own), _error(other)))
        return float(own.mean() - other.mean()) / max(error, 1e-9)


def _error(values: NDArray[np.float64]) -> float:
    """Standard error of the mean of n values."""
    return float(values.std(ddof=1) / np.sqrt(len(values)))


def _own(shape: tuple[int, int], agree: Agree) -> int:
    """Radius in px around a place that belongs to its peak."""
    return own_radius(shape) + agree.near + 1


def _correlations(a: Orientation, b: Orientation, b_H_a: Matrix, agree: Agree) -> Correlations:
    """Best correlation of each patch within `agree.near` px of a transform, by row and column."""
    fields, valid = warped(a, b_H_a, b.shape)
    found = agree.scored(fields, b.fields, valid * b.valid, agree.across[0], agree.near)
    return {(top, left): float(score.max()) for top, left, _, score in found}
