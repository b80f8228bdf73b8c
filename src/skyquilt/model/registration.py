"""Two pictures laid on one another, or why they are not."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Model = Literal["identity", "similarity", "affine", "homography"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """What is to be registered."""

    values: NDArray[Any]
    """(H, W) or (H, W, 3), as recorded: 8 bit, 16 bit or real numbers, NaN where nothing was
    measured.
    """
    valid: NDArray[np.bool_] | None = None
    """(H, W) where there is a picture at all; None = to be found out."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in px."""
        return self.values.shape[0], self.values.shape[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class Guess:
    """What is known of a registration beforehand: from metadata, or from the place of two maps."""

    b_H_a: Matrix
    """(3, 3) the most likely transform of a's pixels to b's."""
    reach: float = 0.15
    """Largest shift from it, as a share of b's longer side."""
    rotation_deg: float = 6.0
    """Largest rotation from it, degrees."""
    scale: float = 1.25
    """Largest factor from it, either way."""
    source: str = ""
    """What it was taken from, in words."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Registration:
    """Two pictures that show the same, and how; a is the reference."""

    model: Model
    """Family of the transform."""
    b_H_a: Matrix
    """(3, 3) takes a's pixels (x, y, centres at integers) to b's."""
    px_a: NDArray[np.float64]
    """(n, 2) inliers in px of a: features, or middles of patches that find their place by
    themselves.
    """
    px_b: NDArray[np.float64]
    """(n, 2) where they lie in b."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """What acceptance rests on, by name."""
    note: str = ""
    """A sentence on what is special about it."""
    q: float = 0.0
    """Spread of the inliers over a [Yahyanejad 2013, (6.3)], in [0, 1]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RefusedRegistration:
    """Pictures that could not be laid on one another: false in `if`, carries its reason."""

    reason: str
    """One sentence."""
    inliers: int = 0
    """How many there were."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """What the refusal rests on, by name."""

    def __bool__(self) -> bool:
        return False


class Registers(Protocol):
    """A way to lay two pictures on one another."""

    def __call__(
        self, a: Picture, b: Picture, guess: Guess | None = None
    ) -> Registration | RefusedRegistration:
        """The registration of b to a in px of the pictures, or why there is none."""
        ...
