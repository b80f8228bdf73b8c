"""Final refinement of an accepted registration: by colour where colour is reliable, otherwise by
brightness.

The registration is known to a few pixels before this step. If the sun has different directions in
the two images, shading and shadows bias a refinement by brightness. Log-chromaticity hardly depends
on illumination, so it is used wherever the patch test (by which registrations are accepted)
confirms its result. Images without colour (a grey camera, snow, asphalt, haze) are refined by
brightness.
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
"""Side in px of the square to whose area images are reduced for the patch test, as in `auto`."""


@dataclass(frozen=True, kw_only=True)
class RefineRegistration:
    """Refines by colour or by brightness. The model is as rigid as the difference between two
    adjusted blocks.
    """

    side: float = 1000.0
    """Side in px of the square to whose area the images are reduced."""
    rigid: SubpixelRefinement = field(
        default_factory=lambda: SubpixelRefinement(freedom="similarity", steps=25)
    )
    """The refinement."""
    free: SubpixelRefinement | None = None
    """A refinement with more parameters, used if it gains enough; None = none."""
    gain: float = 0.02
    """Relative gain in correlation required for it."""
    agree: Agree = field(default_factory=Agree)
    """The patch test that the result by colour must pass."""
    least_surprise: float = 5.0
    """Agreement below which the result by colour is not used."""
    reach: float = 0.02
    """Largest shift (RMS) as a share of the longer side. The accepted registration is right to half
    of that.
    """
    version: ClassVar[int] = 3

    def __call__(self, a: Picture, b: Picture, outcome: Registration) -> Registration:
        """The refined registration; unchanged if no better fit is found near it."""
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
        """The transform from colours alone at the decision level, and the agreement of the patches
        with it.
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
        """The transform refined from `begin`, in px of the target, and the refinement used; None if
        it is far from the start.
        """
        begun = between(fields, target, start)
        found, way = self.rigid(fields, target, between(fields, target, begin)), self.rigid
        if self.free is not None:
            freer = self.free(fields, target, found.b_H_a)
            if freer.correlation > (1 + self.gain) * found.correlation:
                found, way = freer, self.free
        px = grid(fields.shape)
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
        error=None,  # that of the registration before the refinement
    )


def stiff(b_H_a: Matrix, shape: tuple[int, int]) -> Matrix:
    """The similarity (3, 3) nearest to a transform over an image (H, W)."""
    px = grid(shape)
    found = fit("similarity", px, transfer(b_H_a, px))
    return b_H_a if found is None else found


def grid(shape: tuple[int, int]) -> np.ndarray:
    """(25, 2) px distributed over an image (H, W)."""
    x, y = (np.linspace(0, n - 1, 5) for n in (shape[1], shape[0]))
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


DARK = 1 / 64
"""Share of the largest value that is added to all values, since ratios of dark values are noise."""


def chromaticity(rgb: NDArray[Any]) -> NDArray[np.float32]:
    """Logarithms (h, w, 3) of an RGB image's values minus their mean over the bands; independent of
    brightness.
    """
    largest = float(np.iinfo(rgb.dtype).max) if rgb.dtype.kind == "u" else float(np.nanmax(rgb))
    logarithm = np.log(
        np.maximum(rgb.astype(np.float32), 0) / np.float32(max(largest, 1e-9)) + np.float32(DARK)
    )
    return np.asarray(logarithm - logarithm.mean(2, keepdims=True), np.float32)


def chromatic(picture: Picture, valid: NDArray[np.bool_], side: float) -> Orientation | None:
    """Fields of an image's colours, reduced as in `orientation`; None if it has no colours."""
    values = picture.values
    if values.ndim != 3 or values.shape[2] != 3:
        return None
    kind = values.dtype
    known = np.where(valid[..., None], values, kind.type(0))
    if kind.kind != "u":
        known = known.astype(np.float32)
    small, whole, small_S_full = shrunken(known, valid, side)
    return of_bands(chromaticity(small), whole, small_S_full)
