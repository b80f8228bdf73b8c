"""The last pixels of a believed registration: found by colour where colour is reliable, else by
brightness.

A registration is known to a few pixels by then. Shading and shadows pull brightness aside where the
sun stands differently in the two pictures. Log-chromaticity hardly changes with the light, so it
decides wherever the patch test (the one that registrations are accepted by) confirms it. Pictures
without colour (a grey lens, snow, asphalt, haze) are refined by brightness.
"""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.agreement import Agree
from skyquilt.coregistration.orientation import (
    Orientation,
    between,
    full_size,
    of_bands,
    orientation,
    shrunken,
)
from skyquilt.coregistration.subpixel import Fit, SubpixelRefinement
from skyquilt.coregistration.usable import Usable, both_usable
from skyquilt.geometry.transforms import fit, transfer
from skyquilt.model.registration import Matrix, Picture, RefusedRegistration, Registration

_JUDGED = 256.0
"""Px of the square whose area pictures have where patches judge, as in `auto`."""


@dataclass(frozen=True, kw_only=True)
class RefineRegistration:
    """Sharpens by colours, or by brightness, as stiffly as two adjusted blocks differ."""

    side: float = 1000.0
    """Px of the square whose area the pictures are shrunken to."""
    rigid: SubpixelRefinement = field(
        default_factory=lambda: SubpixelRefinement(freedom="similarity", steps=25)
    )
    """How they are sharpened."""
    free: SubpixelRefinement | None = None
    """A freer way, taken where it pays; None where there is none."""
    gain: float = 0.02
    """Relative gain in correlation that the freer way must bring."""
    agree: Agree = field(default_factory=Agree)
    """What colours must pass."""
    least_surprise: float = 5.0
    """Agreement below which colours tell nothing."""
    reach: float = 0.02
    """Share of the longer side by which the place may move (RMS): what was believed is right to
    half of that.
    """
    version: ClassVar[int] = 1

    def __call__(self, a: Picture, b: Picture, outcome: Registration) -> Registration:
        """The registration at its exact place; as it was where the pictures show nothing near
        it.
        """
        pair = both_usable(a, b)
        if isinstance(pair, RefusedRegistration):
            return outcome
        one, other = pair
        start = stiff(outcome.b_H_a, a.shape)
        target = orientation(other.grey, other.valid, self.side)
        confirmed = self._confirmed(chromatic(a, one.valid, _JUDGED), other, start)
        colours = chromatic(a, one.valid, self.side) if confirmed is not None else None
        if confirmed is not None and colours is not None:
            begin, surprise = confirmed
            if (found := self._fitted(colours, target, begin, start)) is not None:
                told = {"by_colour": 1.0, "colour_surprise": round(surprise, 3)}
                return _placed(outcome, colours, target, found, told)
        grey = orientation(one.grey, one.valid, self.side)
        refined = self._fitted(grey, target, start, start)
        told = {"by_colour": 0.0} if a.values.ndim == 3 else {}
        return outcome if refined is None else _placed(outcome, grey, target, refined, told)

    def _confirmed(
        self, colours: Orientation | None, other: Usable, start: Matrix
    ) -> tuple[Matrix, float] | None:
        """Where colours alone put the picture at the resolution of the verdict, and how clearly
        patches agree on it.
        """
        if colours is None:
            return None
        target = orientation(other.grey, other.valid, _JUDGED)
        found = self.rigid(colours, target, between(colours, target, start)).b_H_a
        surprise = self.agree(colours, target, found).surprise
        return (
            (full_size(colours, target, found), surprise)
            if surprise >= self.least_surprise
            else None
        )

    def _fitted(
        self, fields: Orientation, target: Orientation, begin: Matrix, start: Matrix
    ) -> tuple[Fit, SubpixelRefinement] | None:
        """The place found from `begin`, in px of the target, and the way; None where it lies far
        from the start.
        """
        begun = between(fields, target, start)
        found, way = self.rigid(fields, target, between(fields, target, begin)), self.rigid
        if self.free is not None:
            freer = self.free(fields, target, found.b_H_a)
            if freer.correlation > (1 + self.gain) * found.correlation:
                found, way = freer, self.free
        px = _grid(fields.shape)
        moved = transfer(found.b_H_a, px) - transfer(begun, px)
        furthest = self.reach * max(target.shape)
        return (found, way) if np.sqrt((moved**2).sum(1).mean()) <= furthest else None


def _placed(
    outcome: Registration,
    fields: Orientation,
    target: Orientation,
    found: tuple[Fit, SubpixelRefinement],
    told: dict[str, float],
) -> Registration:
    fit, way = found
    return replace(
        outcome,
        model=way.freedom,
        b_H_a=full_size(fields, target, fit.b_H_a),
        evidence={**outcome.evidence, "likeness": round(fit.correlation, 4), **told},
    )


def stiff(b_H_a: Matrix, shape: tuple[int, int]) -> Matrix:
    """The similarity (3, 3) nearest to a transform over a picture (H, W)."""
    px = _grid(shape)
    found = fit("similarity", px, transfer(b_H_a, px))
    return b_H_a if found is None else found


def _grid(shape: tuple[int, int]) -> np.ndarray:
    """(25, 2) px spread over a picture (H, W)."""
    x, y = (np.linspace(0, n - 1, 5) for n in (shape[1], shape[0]))
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


DARK = 1 / 64
"""Share of the largest value that is added to all: the ratios of black are noise."""


def chromaticity(rgb: NDArray[Any]) -> NDArray[np.float32]:
    """Logarithms (h, w, 3) of an RGB picture's values, less their mean over the bands: the same for
    any brightness.
    """
    largest = float(np.iinfo(rgb.dtype).max) if rgb.dtype.kind == "u" else float(np.nanmax(rgb))
    logarithm = np.log(
        np.maximum(rgb.astype(np.float32), 0) / np.float32(max(largest, 1e-9)) + np.float32(DARK)
    )
    return np.asarray(logarithm - logarithm.mean(2, keepdims=True), np.float32)


def chromatic(picture: Picture, valid: NDArray[np.bool_], side: float) -> Orientation | None:
    """Fields of a picture's colours, shrunken as `orientation` does; None where it has no
    colours.
    """
    values = picture.values
    if values.ndim != 3 or values.shape[2] != 3:
        return None
    kind = values.dtype
    known = np.where(valid[..., None], values, kind.type(0))
    if kind.kind != "u":
        known = known.astype(np.float32)
    small, whole, small_S_full = shrunken(known, valid, side)
    return of_bands(chromaticity(small), whole, small_S_full)
