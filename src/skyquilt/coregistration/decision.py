"""Decides which candidate transform is accepted and with which model, or why none is accepted."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.agreement import Agree, Agreement, Shifts
from skyquilt.coregistration.bent import Bending
from skyquilt.coregistration.error_field import FREE, Scatter, StateError, overlap_corners
from skyquilt.coregistration.orientation import (
    BLUR,
    Orientation,
    Pyramid,
    at_all_shifts,
    between,
    full_size,
    own_radius,
)
from skyquilt.coregistration.refine_registration import grid
from skyquilt.coregistration.repeats import Repeats, Rival
from skyquilt.coregistration.subpixel import Fit, Freedom, SubpixelRefinement
from skyquilt.geometry.transforms import fit as fitted
from skyquilt.geometry.transforms import transfer
from skyquilt.model.registration import (
    ErrorField,
    Matrix,
    Outcome,
    RefusedRegistration,
    Registration,
)


@dataclass(frozen=True, kw_only=True)
class Decide:
    """Accepts the transform that independent patches confirm, and uses a model with more parameters
    if the images support it.
    """

    agree: Agree = field(default_factory=Agree)
    """The test."""
    least_surprise: float = 5.0
    """Agreement below which a registration is refused; docs/methods.md gives the values that occur
    by chance.
    """
    least_beside: float = 2.0
    """The same without patches along straight edges: 1.4 to 1.7 of pairs of other places with roads
    or fields at right angles that were accepted, 2.5 and more of right registrations.
    """
    repeats: Repeats = field(default_factory=Repeats)
    """The comparison with places further away."""
    bent: Bending = field(default_factory=Bending)
    """Whether a lens bends one of the pictures."""
    gain: float = 0.02
    """Relative gain in correlation required for a homography instead of a similarity."""
    determined: float = 3.0
    """Change at a corner required for it, in standard deviations by the patches' scatter: where
    patches cover a part of the picture only, a homography fits them better and the rest worse.
    """
    state: StateError = field(default_factory=StateError)
    """The error over the whole picture."""
    finer: float = 400.0
    """Side in px of the square to whose area images are reduced for the final refinement."""
    finest: float = 640.0
    """The same for images at least as large; they are refined at it by coarser structure first."""
    sharper: float = 0.5
    """Smoothing of its gradients in px, half of that of all before: finer structure."""
    fine: float = 1 / 4
    """Weight of finer structure, the rest is that of coarser one. Alone it is the more exact where
    the bands are alike, and the less exact where they are not, and its error is less certain.
    """
    version: ClassVar[int] = 9

    def __call__(
        self,
        pyramid: Pyramid,
        fits: Sequence[Fit],
        reach: float = float("inf"),
        *,
        told: bool = False,
    ) -> Outcome:
        """The decision on transforms in px of the finest level; `reach`: how far in px of it the
        registration may lie from them; `told`: by what is known beforehand, so that straight edges
        do not lie on each other because such a place was searched for.
        """
        judged = [(self.agree(*pyramid.at(pyramid.last), fit.b_H_a), fit) for fit in fits]
        if not judged:
            return RefusedRegistration(
                reason="no position was found with enough overlap of both images"
            )
        agreement, fit = max(judged, key=lambda j: j[0].surprise)
        if agreement.surprise < self.least_surprise:
            return _refused(_doubt(agreement, self.least_surprise), agreement, fit)
        if not told and agreement.beside_edges < self.least_beside:
            return _refused(_straight(agreement, self.least_beside), agreement, fit)
        agreeing = len(agreement.px) / max(agreement.patches, 1)
        rival = self.repeats(*pyramid.at(pyramid.last), fit.b_H_a, self.agree, reach, agreeing)
        if rival is not None:
            return _refused(_repeated(rival, pyramid), agreement, fit)
        return self._finished(pyramid, fit, agreement)

    def _finished(self, pyramid: Pyramid, fit: Fit, agreement: Agreement) -> Outcome:
        """The registration with the model that the images support, in px of the images; refused
        where none can fit.
        """
        a, b = pyramid.at(pyramid.last)
        model = fit.freedom
        corners = overlap_corners(fit.b_H_a, a.shape, b.shape)
        freer = SubpixelRefinement(freedom="homography")(a, b, fit.b_H_a)
        if freer.correlation > (1 + self.gain) * fit.correlation:
            scatter = self._scatter(agreement.every, corners, b.shape, model)
            change = transfer(freer.b_H_a @ np.linalg.inv(fit.b_H_a), corners) - corners
            if self.state.determined(scatter, change, corners) > self.determined:
                model, fit = freer.freedom, freer
                agreement = self.agree(a, b, fit.b_H_a)
        full, error, lens_error = self._closer(pyramid, fit, model)
        to_full = np.linalg.inv(b.small_S_full)
        found = between(a, b, full)
        apart = self.bent(
            self.agree.shifts(a, b, found), b.shape, overlap_corners(found, a.shape, b.shape)
        )
        if apart is not None:
            return _refused(_is_bent(apart * float(to_full[0, 0])), agreement, fit)
        return Registration(
            model=model,
            b_H_a=full,
            evidence=_evidence(agreement, fit),
            px_a=_apply(np.linalg.inv(full) @ to_full, agreement.px),
            px_b=_apply(to_full, agreement.px + agreement.shift),
            error=error,
            lens_error=lens_error,
        )

    def _closer(
        self, pyramid: Pyramid, coarse: Fit, model: Freedom
    ) -> tuple[Matrix, ErrorField, ErrorField]:
        """The weighted mean of the transforms by coarse and by finer structure, its error, and that
        through a lens, all in px of the images. How far they are apart tells of the error what the
        scatter of the patches does not.
        """
        full, side = pyramid.full(coarse.b_H_a, pyramid.last), self.finer
        if pyramid.least >= self.finest**2:
            side = self.finest
            a, b = pyramid.finer(side, BLUR)
            nearer = SubpixelRefinement(freedom=model, steps=3)(a, b, between(a, b, full))
            full = full_size(a, b, nearer.b_H_a)
        a, b = pyramid.finer(side, self.sharper)
        begun = between(a, b, full)
        fine = SubpixelRefinement(freedom=model, steps=8)(a, b, begun).b_H_a
        patches, corners = self.agree.shifts(a, b, fine), overlap_corners(fine, a.shape, b.shape)
        scatter = self._scatter(patches, corners, b.shape, model)
        px = grid(b.shape)
        apart = transfer(begun @ np.linalg.inv(fine), px) - px
        back = fitted(model, px, px + (1 - self.fine) * apart)
        to_full = np.linalg.inv(b.small_S_full)
        change = scatter.parameters(px, apart)
        usual = scatter.parameters(px, _to_similarity(fine, px))
        bent = self.state.bent(patches, scatter, usual, corners, float(self.agree.reach), change)
        error = self.state(scatter, FREE[model], change)
        scale, shift = float(to_full[0, 0]), np.asarray(to_full[:2, 2], np.float64)
        full = full_size(a, b, fine if back is None else back @ fine)
        return full, error.moved(scale, shift), bent.moved(scale, shift)

    def _scatter(
        self, patches: Shifts, corners: NDArray[np.float64], shape: tuple[int, int], model: Freedom
    ) -> Scatter:
        return self.state.scatter(
            patches,
            centre=corners.mean(0),
            unit=float(np.hypot(*shape)) / 2,
            reach=float(self.agree.reach),
            free=FREE[model],
        )


def _to_similarity(b_H_a: Matrix, px: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 2) change at px (n, 2) of b from a transform to the similarity nearest to it there."""
    px_a = transfer(np.asarray(np.linalg.inv(b_H_a), np.float64), px)
    alike = fitted("similarity", px_a, px)
    return np.zeros_like(px) if alike is None else transfer(alike, px_a) - px


def _apply(matrix: NDArray[Any], px: NDArray[Any]) -> NDArray[Any]:
    moved = np.c_[px, np.ones(len(px))] @ matrix.T
    return np.asarray(moved[:, :2] / moved[:, 2:])


def _evidence(agreement: Agreement, fit: Fit) -> dict[str, float]:
    return {
        "surprise": round(agreement.surprise, 3),
        "patches": float(agreement.patches),
        "patches_agreeing": float(len(agreement.px)),
        "correlation": round(fit.correlation, 4),
    }


def _refused(reason: str, agreement: Agreement, fit: Fit) -> RefusedRegistration:
    return RefusedRegistration(
        reason=reason, inliers=len(agreement.px), evidence=_evidence(agreement, fit)
    )


def _doubt(agreement: Agreement, least: float) -> str:
    return (
        f"the best position found is not confirmed: {len(agreement.px)} of {agreement.patches}"
        " patches agree with"
        f" it, significance 10^-{agreement.surprise:.1f}; 10^-{least:g} is required"
    )


def _straight(agreement: Agreement, least: float) -> str:
    return (
        "only straight edges (roads, borders of fields) lie on each other, as they do in pictures"
        f" of other places, too; beside them the significance is 10^-{agreement.beside_edges:.1f},"
        f" and 10^-{least:g} is required"
    )


def _is_bent(apart: float) -> str:
    return (
        "one of the pictures is bent by its lens (barrel or cushion distortion), and no"
        f" registration follows it: at a corner it would be {apart:.0f} px of B off; take the"
        " distortion out of the pictures first"
    )


def _repeated(rival: Rival, pyramid: Pyramid) -> str:
    scale = float(pyramid.at(pyramid.last)[1].small_S_full[0, 0])
    x, y = (round(s / scale) for s in rival.shift)
    return (
        f"the pictures repeat: moved by ({x}, {y}) px of B they fit as well, and nothing tells"
        " which place is right"
    )


_NEAR = 2
"""Radius in px around the registered position in which its peak is searched."""
_LEAST = 0.3
"""Shifts with a smaller share of the overlap are ignored."""


def distinctness(a: Orientation, b: Orientation, b_H_a: Matrix) -> float:
    """The correlation peak at a registration divided by the RMS over all distant shifts.

    Unlike the correlation it can be compared between images, since smooth images also correlate by
    chance.
    """
    z, far = at_all_shifts(a, b, b_H_a, _LEAST)
    own = np.arange(-own_radius(b.shape), own_radius(b.shape) + 1)
    far[np.ix_(own, own)] = False
    near = np.arange(-_NEAR, _NEAR + 1)
    noise = float(np.sqrt((z[far] ** 2).mean())) if far.any() else 0.0
    return float(z[np.ix_(near, near)].max()) / max(noise, 1e-9)
