"""How one image lies on another, and by what evidence."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """A transformation that enough matches agree on."""

    model: str
    """`translation`, `similarity`, `affine` or `homography`."""
    b_H_a: NDArray[np.float64]
    """(3, 3) takes a's pixels to b's; last element 1."""
    inliers: NDArray[np.bool_]
    """(N,) the matches that agree."""
    ste_per_inlier: float
    """Mean symmetric transfer error of the inliers, a sum of squares both ways, px^2 [A (15)]."""
    iterations: int
    """Samples tried."""
    capped: bool
    """True when the search ended at its cap, before its confidence was reached."""
    method: str
    """Which step found it: `RANSAC`, `LMedS`, `MAGSAC`, `RANSAC-1-OPT`, `RANSAC-2-OPT`."""

    @property
    def count(self) -> int:
        """Number of inliers."""
        return int(self.inliers.sum())

    @property
    def share(self) -> float:
        """Inliers over matches [A (14)]."""
        return self.count / len(self.inliers)


@dataclass(frozen=True, kw_only=True, eq=False)
class NoEstimate:
    """No transformation that could be trusted: false in `if`, carries its reason."""

    reason: str
    """`too few matches (7 of 8)`, `weak inliers (5 of 80 matches)`, `weak peak (0.12 of 0.3)`, ...
    """

    def __bool__(self) -> bool:
        return False


@dataclass(frozen=True, kw_only=True, eq=False)
class Registration:
    """A transformation that the pixels themselves agree on."""

    model: str
    """`translation`, `similarity`, `euclidean`, `affine` or `homography`."""
    b_H_a: NDArray[np.float64]
    """(3, 3) takes a's pixels to b's; last element 1."""
    score: float
    """What was maximised, where it is highest: a correlation (at most 1), normalised mutual
    information, or the response of a phase correlation.
    """
    overlap: float
    """Share of a's pixels that lie on b."""
    method: str
    """`NCC`, `phase`, `ECC` or `MI`."""
