"""Test of a registration: do patches that are matched independently confirm it?

The overlap is cut into patches. Each patch is correlated on its own with the other image over small
shifts. The rank of the registered position among all shifts is a p-value that needs no noise model:
for unrelated images the registered position is as good as any other, and ranks are uniform.
Fisher's method combines all ranks to one number. If the position was chosen as the best of
thousands, this number is no longer a probability; the values that occur by chance were therefore
measured on unrelated images (docs/methods.md).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

from skyquilt.coregistration.orientation import Fields, Orientation, warped
from skyquilt.model.registration import Matrix


@dataclass(frozen=True, kw_only=True, eq=False)
class Shifts:
    """Where each of n patches matches best, in px of b at the resolution of the test."""

    px: NDArray[np.float64]
    """(n, 2) centres of the patches."""
    shift: NDArray[np.float64]
    """(n, 2) b's content is at px + shift."""
    width: NDArray[np.float64]
    """(n,) height of each correlation peak `_BESIDE` px beside it, as a share of its height: 0 for
    a needle, 1 for a plateau.
    """

    @classmethod
    def of(cls, table: NDArray[np.float64]) -> "Shifts":
        """From rows of x, y, shift along x, along y, width."""
        return cls(px=table[:, :2], shift=table[:, 2:4], width=table[:, 4])


@dataclass(frozen=True, kw_only=True, eq=False)
class Agreement:
    """Result of the test."""

    surprise: float
    """-log10 of Fisher's p-value, averaged over all patch sizes."""
    beside_edges: float
    """The same without patches that match as well further along a straight edge. Roads or borders
    of fields at right angles lie on each other in any two pictures that have them, and all patches
    along one confirm that at once, as if they were independent.
    """
    patches: int
    """Number of patches of the smaller size that were tested."""
    px: NDArray[np.float64]
    """(n, 2) centres of the patches that agree, in px of b at the resolution of the test."""
    shift: NDArray[np.float64]
    """(n, 2) shift in px at which each patch matches best: b's content is at px + shift."""
    every: "Shifts"
    """Of all patches of that size, agreeing or not."""


@dataclass(frozen=True, kw_only=True)
class Agree:
    """The test; patches are squares in b's frame."""

    across: tuple[int, ...] = (6, 8)
    """Patches along the side of a square of b's area, one test each."""
    reach: int = 12
    """Largest shift in px along each axis that is compared with the registered position."""
    near: int = 2
    """Largest distance in px from the registered position at which a patch agrees."""
    filled: float = 0.6
    """Least share of a patch that both images must cover."""
    straight: float = 0.6
    """Height of a patch's correlation further along its peak, as a share of that of the peak, from
    which it is that of a straight edge.
    """
    version: ClassVar[int] = 2

    def __call__(self, a: Orientation, b: Orientation, b_H_a: Matrix) -> Agreement:
        """Tests a transform in px of this resolution."""
        fields, valid = warped(a, b_H_a, b.shape)
        both = valid * b.valid
        surprises, beside, rows, count = [], [], [], 0
        for across in self.across:
            found = list(self._patches(fields, b.fields, both, across))
            ranks = np.array([f[0] for f in found])
            surprises.append(_fisher(ranks))
            beside.append(_fisher(ranks[[f[1] < self.straight for f in found]]))
            if across == self.across[0]:
                rows, count = [f[2:] for f in found], len(found)
        table = np.array(rows, np.float64).reshape(-1, 5)
        near = table[np.hypot(table[:, 2], table[:, 3]) <= self.near]
        return Agreement(
            surprise=float(np.mean(surprises)),
            beside_edges=float(np.mean(beside)),
            patches=count,
            px=near[:, :2],
            shift=near[:, 2:4],
            every=Shifts.of(table),
        )

    def shifts(self, a: Orientation, b: Orientation, b_H_a: Matrix) -> Shifts:
        """The shifts of the patches of the smaller size, and of those that lie half a patch further
        right and down, between them: their scatter is known better from both.
        """
        fields, valid = warped(a, b_H_a, b.shape)
        across = self.across[0]
        half = int(np.sqrt(b.shape[0] * b.shape[1]) / across) // 2
        found = [
            f[2:]
            for first in (0, half)
            for f in self._patches(fields, b.fields, valid * b.valid, across, first)
        ]
        return Shifts.of(np.array(found, np.float64).reshape(-1, 5))

    def _patches(
        self, fields: Fields, target: Fields, both: NDArray[Any], across: int, first: int = 0
    ) -> Iterator[tuple[float, float, float, float, float, float, float]]:
        """Rank, height further along the peak, centre, shift and width of the peak of each patch,
        from row and column `first`.
        """
        reach = self.reach
        for top, left, side, score in self.scored(fields, target, both, across, reach, first):
            x, y = summit(score)
            yield (
                self._rank(score),
                _along(score),
                left + (side - 1) / 2,
                top + (side - 1) / 2,
                reach - x,
                reach - y,
                _width(score),
            )

    def scored(
        self,
        fields: Fields,
        target: Fields,
        both: NDArray[Any],
        across: int,
        reach: int,
        first: int = 0,
    ) -> Iterator[tuple[int, int, int, NDArray[np.float32]]]:
        """Row, column and side of each patch of the target that both images cover, and its
        correlation with the fields at all shifts up to `reach` px, from row and column `first`.
        """
        height, width = both.shape
        side = int(np.sqrt(height * width) / across)
        padded = cv2.copyMakeBorder(
            fields, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=(0,) * 4
        )
        for top in range(first, height - side + 1, side):
            for left in range(first, width - side + 1, side):
                part = (slice(top, top + side), slice(left, left + side))
                if both[part].mean() < self.filled:
                    continue
                around = padded[top : top + side + 2 * reach, left : left + side + 2 * reach]
                yield top, left, side, scores(around, target[part] * both[part][..., None])

    def _rank(self, score: NDArray[Any]) -> float:
        """Share of positions at least as good as the registered one, each with its
        neighbourhood.
        """
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * self.near + 1, 2 * self.near + 1))
        best = np.asarray(cv2.dilate(score, disc))
        rivals = best[self.near : -self.near, self.near : -self.near]
        own = best[self.reach, self.reach]
        return float((1 + (rivals >= own).sum()) / (1 + rivals.size))


def scores(around: Fields, patch: Fields) -> NDArray[np.float32]:
    """Normalised correlation of a patch (h, w, 4) at every position in its surroundings."""
    high, wide = patch.shape[:2]
    energy = cv2.boxFilter(
        np.einsum("ijk,ijk->ij", around, around),
        -1,
        (wide, high),
        anchor=(0, 0),
        normalize=False,
        borderType=cv2.BORDER_CONSTANT,
    )
    rows, columns = around.shape[0] - high + 1, around.shape[1] - wide + 1
    product = np.zeros((rows, columns), np.float32)
    for k in range(around.shape[2]):
        one = np.ascontiguousarray(around[..., k])
        product += cv2.matchTemplate(one, np.ascontiguousarray(patch[..., k]), cv2.TM_CCORR)
    own = float((patch * patch).sum())
    return np.asarray(
        product / np.sqrt(np.asarray(energy)[:rows, :columns] * own + 1e-6), np.float32
    )


def summit(score: NDArray[np.float32]) -> tuple[float, float]:
    """Column and row of the maximum, with subpixel interpolation by a parabola along each axis."""
    row, column = divmod(int(score.argmax()), score.shape[1])
    return (
        column + _between(score[row, max(column - 1, 0) : column + 2]),
        row + _between(score[max(row - 1, 0) : row + 2, column]),
    )


_BESIDE = 3
"""Distance in px from a peak at which its height measures its width."""
_ALONG = ((0, 4), (4, 0), (3, 3), (3, -3))
"""Rows and columns from a peak at which its height tells whether it is a ridge."""


def _width(score: NDArray[np.float32]) -> float:
    """Height of the correlation beside its peak as a share of that at the peak, both above the
    median.
    """
    across, along = _beside(score, ((0, _BESIDE), (_BESIDE, 0)))
    return (across + along) / 2


def _along(score: NDArray[np.float32]) -> float:
    """The same on the line through the peak on which it is highest."""
    return max(_beside(score, _ALONG))


def _beside(score: NDArray[np.float32], steps: Sequence[tuple[int, int]]) -> list[float]:
    """Mean height of the correlation on both sides of its peak, as a share of that at the peak."""
    most = max(max(abs(y), abs(x)) for y, x in steps)
    row, column = (
        int(np.clip(at, most, size - 1 - most))
        for at, size in zip(divmod(int(score.argmax()), score.shape[1]), score.shape, strict=True)
    )
    ground = float(np.median(score))
    peak = max(float(score[row, column]) - ground, 1e-6)
    sides = [float(score[row + y, column + x] + score[row - y, column - x]) / 2 for y, x in steps]
    return [(side - ground) / peak for side in sides]


def _between(three: NDArray[np.float32]) -> float:
    """Position of the maximum of a parabola through three values, relative to the middle one; 0 at
    the border.
    """
    if len(three) < 3:
        return 0.0
    bend = float(three[0] - 2 * three[1] + three[2])
    return float(three[0] - three[2]) / (2 * bend) if bend < -1e-9 else 0.0


def _fisher(ranks: NDArray[np.float64]) -> float:
    """-log10 of the p-value for independent uniform ranks to be this small together; 0 without
    ranks.

    -2 times the sum of logs is chi-squared with 2 n degrees of freedom; its tail is a sum of n
    Poisson terms.
    """
    if not len(ranks):
        return 0.0
    half, k = -float(np.log(ranks).sum()), np.arange(len(ranks))
    return (
        float((half - logsumexp(k * np.log(half) - gammaln(k + 1))) / np.log(10))
        if half > 0
        else 0.0
    )
