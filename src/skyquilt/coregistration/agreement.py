"""Whether a registration is to be believed: do patches that know nothing of it find the same place?

The overlap is cut into patches. Each is correlated alone with the other picture over small shifts;
the rank of the registered place among all of them is a p-value that needs no model of noise: for
pictures that have nothing in common, the place is as good as any other, and ranks are uniform.
Fisher's method makes one number of all ranks. It is not a probability any more once the place was
chosen as the best of thousands; what chance reaches then is measured on pictures that show
different things (docs/methods.md).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

from skyquilt.coregistration.orientation import Fields, Orientation, warped
from skyquilt.model.registration import Matrix


@dataclass(frozen=True, kw_only=True, eq=False)
class Agreement:
    """What the patches say."""

    surprise: float
    """-log10 of Fisher's p-value, the mean over all patch sizes."""
    patches: int
    """Patches of the smaller size asked for."""
    px: NDArray[np.float64]
    """(n, 2) middles of the patches that agree, in px of b's resolution as registered."""
    shift: NDArray[np.float64]
    """(n, 2) px by which each would rather lie: b's content lies at px + shift."""


@dataclass(frozen=True, kw_only=True)
class Agree:
    """The test; patches are squares in b's frame."""

    across: tuple[int, ...] = (6, 8)
    """Patches along the side of a square of b's area, one test each."""
    reach: int = 12
    """Px of shift along each axis that compete with the registered place."""
    near: int = 2
    """Px within which a patch agrees."""
    filled: float = 0.6
    """Least share of a patch that both pictures cover."""
    version: ClassVar[int] = 1

    def __call__(self, a: Orientation, b: Orientation, b_H_a: Matrix) -> Agreement:
        """Agreement on a transform in px of this resolution."""
        fields, valid = warped(a, b_H_a, b.shape)
        both = valid * b.valid
        surprises, rows, count = [], [], 0
        for across in self.across:
            found = list(self._patches(fields, b.fields, both, across))
            ranks = np.array([f[0] for f in found])
            surprises.append(_fisher(ranks))
            if across == self.across[0]:
                rows, count = [f[1:] for f in found], len(found)
        table = np.array(rows, np.float64).reshape(-1, 4)
        table = table[np.hypot(table[:, 2], table[:, 3]) <= self.near]
        return Agreement(
            surprise=float(np.mean(surprises)), patches=count, px=table[:, :2], shift=table[:, 2:]
        )

    def _patches(
        self, fields: Fields, target: Fields, both: NDArray[Any], across: int
    ) -> Iterator[tuple[float, float, float, float, float]]:
        """Rank, middle and shift of each patch."""
        height, width = both.shape
        side = int(np.sqrt(height * width) / across)
        reach = self.reach
        padded = cv2.copyMakeBorder(
            fields, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=(0,) * 4
        )
        for top in range(0, height - side + 1, side):
            for left in range(0, width - side + 1, side):
                part = (slice(top, top + side), slice(left, left + side))
                if both[part].mean() < self.filled:
                    continue
                around = padded[top : top + side + 2 * reach, left : left + side + 2 * reach]
                score = _scores(around, target[part] * both[part][..., None])
                x, y = _summit(score)
                yield (
                    self._rank(score),
                    left + (side - 1) / 2,
                    top + (side - 1) / 2,
                    reach - x,
                    reach - y,
                )

    def _rank(self, score: NDArray[Any]) -> float:
        """Share of places at least as good as the registered one, each with its neighbourhood."""
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * self.near + 1, 2 * self.near + 1))
        best = np.asarray(cv2.dilate(score, disc))
        rivals = best[self.near : -self.near, self.near : -self.near]
        own = best[self.reach, self.reach]
        return float((1 + (rivals >= own).sum()) / (1 + rivals.size))


def _scores(around: Fields, patch: Fields) -> NDArray[np.float32]:
    """Normalised correlation of a patch (s, s, 4) at every place of its surroundings."""
    side = patch.shape[0]
    energy = cv2.boxFilter(
        np.einsum("ijk,ijk->ij", around, around),
        -1,
        (side, side),
        anchor=(0, 0),
        normalize=False,
        borderType=cv2.BORDER_CONSTANT,
    )
    rows, columns = (size - side + 1 for size in around.shape[:2])
    product = np.zeros((rows, columns), np.float32)
    for k in range(around.shape[2]):
        one = np.ascontiguousarray(around[..., k])
        product += cv2.matchTemplate(one, np.ascontiguousarray(patch[..., k]), cv2.TM_CCORR)
    own = float((patch * patch).sum())
    return np.asarray(
        product / np.sqrt(np.asarray(energy)[:rows, :columns] * own + 1e-6), np.float32
    )


def _summit(score: NDArray[np.float32]) -> tuple[float, float]:
    """Column and row of the highest place, between pixels by a parabola along each axis."""
    row, column = divmod(int(score.argmax()), score.shape[1])
    return (
        column + _between(score[row, max(column - 1, 0) : column + 2]),
        row + _between(score[max(row - 1, 0) : row + 2, column]),
    )


def _between(three: NDArray[np.float32]) -> float:
    """Where a parabola through three values is highest, from the middle one; 0 at the border."""
    if len(three) < 3:
        return 0.0
    bend = float(three[0] - 2 * three[1] + three[2])
    return float(three[0] - three[2]) / (2 * bend) if bend < -1e-9 else 0.0


def _fisher(ranks: NDArray[np.float64]) -> float:
    """-log10 of the p-value of independent uniform ranks being this small together; 0 without any.

    -2 sum of logs is chi-squared with 2 n degrees of freedom, whose tail is a sum of n terms of
    Poisson's.
    """
    if not len(ranks):
        return 0.0
    half, k = -float(np.log(ranks).sum()), np.arange(len(ranks))
    return (
        float((half - logsumexp(k * np.log(half) - gammaln(k + 1))) / np.log(10))
        if half > 0
        else 0.0
    )
