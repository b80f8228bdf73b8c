"""Whether a lens bends one picture against the other, which no homography can follow: patches then
match ever further from their places towards the rim, all inwards or all outwards.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.agreement import Shifts

Doubles = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Bending:
    """Fits a similarity and a radial term (third power of the radius) to what patches tell, with
    patches that match elsewhere down-weighted.
    """

    certain: float = 2.2
    """Standard deviations by which the radial term must differ from 0: true registrations of 31
    pairs reached 1.4, and less than this in 102 variations of them. With a barrel distortion of 15
    or 20 % in one of the pictures wrong ones reached 3.5 at least, with one of 30 % 1.9.
    """
    harmful: float = 0.025
    """Departure at a corner that is too much, as a share of the picture's diagonal."""
    scale: float = 1.5
    """Residual in px at which a patch weighs a quarter."""
    floor: float = 0.05
    """Least variance of a shift in px^2: their rounding."""
    dependence: float = 3.5
    """Patches that weigh like one independent one, as in `error_field`."""
    fewest: int = 8
    """Patches that must fit."""
    rounds: int = 20
    """Rounds of reweighting."""
    version: ClassVar[int] = 1

    def __call__(
        self, patches: Shifts, shape: tuple[int, int], corners: NDArray[np.float64]
    ) -> float | None:
        """How far in px the picture (of this shape) departs from a registration at the worst of the
        corners (n, 2), where it is bent for certain and by too much; else None.
        """
        centre = (np.array(shape[::-1], np.float64) - 1) / 2
        unit = float(np.hypot(*shape)) / 2
        X = _design((patches.px - centre) / unit)
        y = patches.shift.T.ravel()
        count, found = len(patches.px), np.zeros(X.shape[1])
        weight: Doubles = np.ones(len(y))
        if count < self.fewest:
            return None
        for _ in range(self.rounds):
            normal = (X * weight[:, None]).T @ X + 1e-9 * np.eye(X.shape[1])
            found = np.asarray(np.linalg.solve(normal, X.T @ (weight * y)))
            left = y - X @ found
            far = np.hypot(left[:count], left[count:])
            weight = np.tile(1 / (1 + (far / self.scale) ** 2) ** 2, 2)
        fitting = float(weight.sum())
        if fitting / 2 < self.fewest:
            return None
        variance = max(float(weight @ left**2) / max(fitting - len(found), 1), self.floor)
        spread = np.linalg.inv((X * weight[:, None]).T @ X) * variance * self.dependence
        if abs(found[-1]) <= self.certain * float(np.sqrt(spread[-1, -1])):
            return None
        apart = (_design((corners - centre) / unit) @ found).reshape(2, -1)
        worst = float(np.hypot(*apart).max())
        return worst if worst > self.harmful * 2 * unit else None


def _design(q: Doubles) -> Doubles:
    """(2 n, 5) shifts along x, then y, at places q (n, 2), by the parameters: a shift along x and
    y, an enlargement, a turn, a radial term.
    """
    (x, y), one, none = q.T, np.ones(len(q)), np.zeros(len(q))
    square = x**2 + y**2
    rows = np.c_[one, none, x, -y, x * square], np.c_[none, one, y, x, y * square]
    return np.asarray(np.concatenate(rows), np.float64)
