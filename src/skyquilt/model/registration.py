"""The registration of two images, or why it failed."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Model = Literal["identity", "similarity", "affine", "homography"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """An image to be registered."""

    values: NDArray[Any]
    """(H, W) or (H, W, 3), as recorded: 8 bit, 16 bit or real numbers, NaN where nothing was
    measured.
    """
    valid: NDArray[np.bool_] | None = None
    """(H, W) where the image has content; None = to be determined from the values."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in px."""
        return self.values.shape[0], self.values.shape[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class Guess:
    """What is known about a registration beforehand: from metadata, or from the positions of two
    maps.
    """

    b_H_a: Matrix
    """(3, 3) the most likely transform of a's pixels to b's."""
    reach: float = 0.15
    """Largest expected shift from it, as a share of b's longer side."""
    rotation_deg: float = 6.0
    """Largest expected rotation from it, degrees."""
    scale: float = 1.25
    """Largest expected change of scale from it, as a factor in either direction."""
    source: str = ""
    """Where it comes from, as a phrase."""


def offsets(
    px: NDArray[np.float64], centre: NDArray[np.float64], unit: float, *, lens: bool = False
) -> Matrix:
    """(n, 2, 8) changes in px of places (n, 2) by the parameters of a small homography: shifts,
    scale and rotation (the similarity), two shears (with them the affine transform), two
    perspectives. Each is in px, at distance `unit` from `centre`. `lens`: (n, 2, 13), what a lens
    changes besides, wherever its middle lies: the other four squares, and the third power of the
    distance.
    """
    x, y = ((px - centre) / unit).T
    one, none = np.ones_like(x), np.zeros_like(x)
    square = x * x + y * y
    columns: tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...] = (
        (one, none),
        (none, one),
        (x, y),
        (-y, x),
        (x, -y),
        (y, x),
        (x * x, x * y),
        (x * y, y * y),
    )
    if lens:
        columns += (
            (x * x, -x * y),
            (-x * y, y * y),
            (y * y, none),
            (none, x * x),
            (x * square, y * square),
        )
    return np.stack([np.stack(column, 1) for column in columns], 2)


ALONG, ROUND = 3.841, 5.991
"""Squared distance that 95 % of normal errors keep, in variances: of errors along one direction,
and of errors equal in all. Between both it is interpolated by the variances along two axes.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorField:
    """How far a registration may be off, at any place of b."""

    centre: NDArray[np.float64]
    """(2,) origin of `offsets`, px of b."""
    unit: float
    """Unit of length of `offsets`, px of b."""
    covariance: NDArray[np.float64]
    """(8, 8) of the parameters of `offsets`, px^2; (13, 13) with those of a lens."""
    shared: float
    """Variance per axis of an error that is the same everywhere, px^2."""
    full_S_own: Matrix = field(default_factory=lambda: np.eye(3))
    """(3, 3) affine: from the px of b in which all this is, to those in which it is asked for."""
    departure: NDArray[np.float64] | None = None
    """(13,) parameters of `offsets` by which b departs from the registration as far as patches tell
    it, px; None: by none.
    """

    def bound_px(self, px: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) distance in px of b within which the registration is right with 95 %, at px (n, 2)
        of b.
        """
        linear, shift = self.full_S_own[:2, :2], self.full_S_own[:2, 2]
        own = (np.asarray(px, np.float64) - shift) @ np.asarray(np.linalg.inv(linear).T, np.float64)
        J = offsets(own, self.centre, self.unit, lens=len(self.covariance) > 8)
        every = np.einsum("nij,jk,nlk->nil", J, self.covariance, J) + self.shared * np.eye(2)
        (xx, xy), (_, yy) = np.einsum("ai,nil,bl->abn", linear, every, linear)
        middle, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
        along, across = middle + half, np.maximum(middle - half, 0)
        bound = np.sqrt(ALONG * along + (ROUND - ALONG) * across)
        if self.departure is not None:
            bound = bound + np.linalg.norm(J @ self.departure @ linear.T, axis=1)
        return np.asarray(bound)

    def moved(self, scale: float, shift: NDArray[np.float64]) -> "ErrorField":
        """The same in other pixels of b: multiplied by a factor, then shifted."""
        x, y = shift
        return self.seen_in(np.array([[scale, 0, x], [0, scale, y], [0, 0, 1.0]]))

    def seen_in(self, full_S_these: Matrix) -> "ErrorField":
        """The same in other pixels of b, to which an affine (3, 3) leads: mirrored, or with sides
        of different length.
        """
        return replace(self, full_S_own=full_S_these @ self.full_S_own)


@dataclass(frozen=True, kw_only=True, eq=False)
class Registration:
    """A registration of two images that show the same ground; a is the reference."""

    model: Model
    """Family of the transform."""
    b_H_a: Matrix
    """(3, 3) takes a's pixels (x, y, centres at integers) to b's."""
    px_a: NDArray[np.float64]
    """(n, 2) inliers in px of a: features, or centres of patches that were matched one by one."""
    px_b: NDArray[np.float64]
    """(n, 2) where they lie in b."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """Figures on which acceptance was decided, by name."""
    note: str = ""
    """A sentence on what is special about this registration."""
    q: float = 0.0
    """Spread of the inliers over a [Yahyanejad 2013, (6.3)], in [0, 1]."""
    error: ErrorField | None = None
    """How far it may be off, over b; None by methods that do not measure it."""
    lens_error: ErrorField | None = None
    """The same where a or b was taken through a lens, which the model leaves out."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RefusedRegistration:
    """Two images could not be registered: false in `if`, carries the reason."""

    reason: str
    """One sentence."""
    inliers: int = 0
    """Number of inliers."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """Figures on which the refusal was decided, by name."""

    def __bool__(self) -> bool:
        return False


Outcome = Registration | RefusedRegistration
"""What a method gives."""


class Registers(Protocol):
    """A method that registers two images."""

    def __call__(self, a: Picture, b: Picture, guess: Guess | None = None) -> Outcome:
        """Registers b to a, in px of the images, or returns why that failed."""
        ...
