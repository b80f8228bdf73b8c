"""The transformation between two images, and the evidence for it."""

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
    """True when the search reached its limit of iterations before its confidence was reached."""
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
    """No transformation was reliable: false in `if`, carries the reason."""

    reason: str
    """`too few matches (7 of 8)`, `weak inliers (5 of 80 matches)`, `weak peak (0.12 of 0.3)`, ...
    """

    def __bool__(self) -> bool:
        return False


@dataclass(frozen=True, kw_only=True, eq=False)
class Registration:
    """A transformation estimated from the pixels themselves."""

    model: str
    """`translation`, `similarity`, `euclidean`, `affine` or `homography`."""
    b_H_a: NDArray[np.float64]
    """(3, 3) takes a's pixels to b's; last element 1."""
    score: float
    """Maximum of the similarity measure: a correlation (at most 1), normalised mutual information,
    or the response of a phase correlation.
    """
    overlap: float
    """Share of a's pixels that fall inside b."""
    method: str
    """`NCC`, `phase`, `ECC` or `MI`."""
