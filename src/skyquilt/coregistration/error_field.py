"""How far a registration may be off over the whole picture, from where the patches lie that
confirm it.

Patches that are matched one by one lie off their registered position by their own errors. Their
scatter gives the covariance of a homography fitted to them, and with it the error at any place,
which grows away from the patches. What no scatter can show is added: along the difference of the
registrations by coarse and by fine structure, since the same edge does not lie at quite the same
place in two spectra; and with priors in units of the scatter, the part of the true transform that
the chosen model cannot follow (parallax, lens, perspective), and an error that all patches share.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.agreement import Shifts
from skyquilt.geometry.transforms import transfer
from skyquilt.model.registration import ErrorField, Matrix, offsets

FREE = {"identity": 4, "similarity": 4, "affine": 6, "homography": 8}
"""Parameters of each model, the first ones of `offsets`."""
_FLAT = 100.0
"""Prior of a free parameter, in units of the scatter: none."""
_OUTLIER = 0.5
"""Share of the patches that match elsewhere, at the start."""
_ROUNDS = 30
_NARROWEST = 0.05
"""Smallest width of a peak that is distinguished."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scatter:
    """The errors of patches around a registration."""

    sigma: float
    """Standard deviation of a matching patch along one axis, px."""
    width: float
    """Typical width of a matching patch's correlation peak (`agreement.Agreement`)."""
    share: float
    """Share of the patches that match near the registered position, not anywhere."""
    information: NDArray[np.float64]
    """(8, 8) of the parameters of `offsets` from the patches, for a sigma of 1 px."""
    centre: NDArray[np.float64]
    """(2,) origin of `offsets`, px of b."""
    unit: float
    """Unit of length of `offsets`, px of b."""

    def parameters(
        self, px: NDArray[np.float64], change: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """The (8,) parameters of `offsets` nearest to a change (n, 2) of places (n, 2), px of b."""
        J = offsets(px, self.centre, self.unit).reshape(-1, 8)
        return np.asarray(np.linalg.lstsq(J, change.ravel(), rcond=None)[0], np.float64)


@dataclass(frozen=True, kw_only=True)
class StateError:
    """The error of a registration from the shifts of its patches."""

    dependence: float = 3.5
    """Number of patches that weigh like one independent one: neighbours err alike."""
    misfit: float = 0.5
    """Prior of each parameter beyond the model's, at half b's diagonal, in units of the
    scatter.
    """
    shared: float = 0.8
    """Error that all patches share, in units of the scatter."""
    usual_width: float = 0.3
    """Width of correlation peaks at which all this holds."""
    blur: float = 0.3
    """Exponent of the error in the width relative to the usual one: the more blurred the structure
    that two spectra share, the more of the error is common to all patches, and not seen in their
    scatter.
    """
    usual_share: float = 0.75
    """Share of patches that match at which all this holds."""
    rarity: float = 0.3
    """Exponent of the error in the usual share relative to the share: where few patches match, more
    of those that seem to are there by chance.
    """
    chosen: float = 2.0
    """Error of a homography relative to that of a similarity with the same scatter: it was taken
    because it fits these patches, so that their scatter around it tells too little.
    """
    apart: float = 0.65
    """Standard deviation of the error along the difference of the registrations by coarse and by
    fine structure, of which the mean is taken, relative to it.
    """
    least_px: float = 0.05
    """Scatter expected without any patch, px; it counts as much as `weight` observations."""
    weight: float = 3.0
    """See `least_px`."""
    lens: float = 0.03
    """Prior of each parameter beyond a similarity where a picture was taken through a lens, at the
    furthest corner of what both show, as a share of its distance from the middle: distortion, and
    perspective by a tilt of some degrees.
    """
    alike: float = 10.0
    """`dependence` where a lens is fitted, too: relief bends patches alike over large parts of the
    picture.
    """
    version: ClassVar[int] = 5

    def scatter(
        self, patches: Shifts, *, centre: NDArray[np.float64], unit: float, reach: float, free: int
    ) -> Scatter:
        """Separates patches that match near the registered position from those that match anywhere
        (by expectation maximisation of a normal and a uniform distribution), and measures the
        scatter of the former around a common transform.

        patches: in px of b; centre, unit: of `offsets`; reach: largest shift compared; free:
        parameters of the model.
        """
        J, prior = offsets(patches.px, centre, unit), self._prior(free)
        return self._separated(
            patches, J, lambda _: prior, np.zeros(8), centre=centre, unit=unit, reach=reach
        )[0]

    def bent(
        self,
        patches: Shifts,
        scatter: Scatter,
        usual: NDArray[np.float64],
        corners: NDArray[np.float64],
        reach: float,
        apart: NDArray[np.float64],
    ) -> ErrorField:
        """The error over b, and how far it departs, where a picture was taken through a lens and
        not quite from above: as the patches tell, and where there are none, by what lenses and
        tilts usually do.

        scatter: of the registration; usual: (8,) its parameters from the registration to the
        similarity nearest to it; corners: (n, 2) of what both pictures show; apart: (8,) as in
        `__call__`; all in px of b.
        """
        centre, unit = scatter.centre, scatter.unit
        J = offsets(patches.px, centre, unit, lens=True)
        rim = float(np.linalg.norm(corners - centre, axis=1).max()) / unit
        free, count = FREE["similarity"], J.shape[2]
        powers = np.array([0.0] * 2 + [1] * 4 + [2] * 6 + [3])  # of the distance, by parameter
        deviation = self.lens * unit * rim ** (1 - powers)
        deviation[:free] *= _FLAT
        expected, more = np.zeros(count), np.zeros(count)
        expected[free:8], more[:8] = usual[free:], apart
        known = np.diag(1 / deviation**2)
        own, found = self._separated(
            patches, J, lambda s: known * s**2, expected, centre=centre, unit=unit, reach=reach
        )
        square = self._square(own) * self.alike / self.dependence
        covariance = np.linalg.inv(own.information / square + known)
        return ErrorField(
            centre=centre,
            unit=unit,
            covariance=covariance + self.apart**2 * np.outer(more, more),
            shared=self.shared**2 * square,
            departure=found,
        )

    def _separated(
        self,
        patches: Shifts,
        J: NDArray[np.float64],
        prior_of: Callable[[float], NDArray[np.float64]],
        expected: NDArray[np.float64],
        *,
        centre: NDArray[np.float64],
        unit: float,
        reach: float,
    ) -> tuple[Scatter, NDArray[np.float64]]:
        """The scatter of the patches that match near the registered position, and the parameters
        (k,) that they tell by their derivatives J (n, 2, k); `prior_of`: (k, k) information for a
        sigma of 1 px, by sigma, of parameters that are as `expected`.
        """
        shift, width = patches.shift, patches.width
        near = np.hypot(shift[:, 0], shift[:, 1]) < reach / 4
        typical = float(np.median(width[near])) if near.any() else 1.0
        likely = near.astype(np.float64)
        share, sigma, data = 1 - _OUTLIER, 1.0, np.zeros((len(expected), len(expected)))
        p = expected
        for _ in range(_ROUNDS):
            prior = prior_of(sigma)
            data = np.einsum("n,nij,nik->jk", likely, J, J)
            told = np.einsum("n,nij,ni->j", likely, J, shift) + prior @ expected
            p = np.linalg.solve(data + prior, told)
            off = ((shift - J @ p) ** 2).sum(1)
            used = float(np.trace(np.linalg.solve(data + prior, data)))
            beside = p - expected
            square = float(likely @ off) + float(beside @ prior @ beside)
            square += self.weight * self.least_px**2
            spare = max(2 * float(likely.sum()) - used, 1.0) + self.weight
            sigma = max(float(np.sqrt(square / spare)), self.least_px)
            density = share * np.exp(-off / (2 * sigma**2)) / (2 * np.pi * sigma**2)
            likely = density / (density + (1 - share) / (2 * reach + 1) ** 2)
            share = float(np.clip(likely.mean(), 0.05, 0.98))
        scatter = Scatter(
            sigma=sigma, width=typical, share=share, information=data, centre=centre, unit=unit
        )
        return scatter, p

    def _prior(self, free: int) -> NDArray[np.float64]:
        """(8, 8) information of the prior for a sigma of 1 px."""
        deviation = np.full(8, self.misfit)
        deviation[:free] = _FLAT
        return np.diag(1 / deviation**2)

    def __call__(
        self, scatter: Scatter, free: int, apart: NDArray[np.float64] | None = None
    ) -> ErrorField:
        """The error over b of a model with so many free parameters; `apart` (8,): the parameters by
        which two registrations differ whose mean it is.
        """
        square = self._square(scatter)
        square *= self.chosen**2 if free == FREE["homography"] else 1.0
        covariance = square * np.linalg.inv(scatter.information + self._prior(free))
        if apart is not None:
            covariance = covariance + self.apart**2 * np.outer(apart, apart)
        return ErrorField(
            centre=scatter.centre,
            unit=scatter.unit,
            covariance=np.asarray(covariance, np.float64),
            shared=self.shared**2 * square,
        )

    def _square(self, scatter: Scatter) -> float:
        """Variance in px^2 of what one patch tells."""
        width = max(scatter.width, _NARROWEST) / self.usual_width
        rare = self.usual_share / scatter.share
        square = self.dependence * scatter.sigma**2
        return float(square * width ** (2 * self.blur) * rare ** (2 * self.rarity))

    def determined(
        self, scatter: Scatter, change_px: NDArray[np.float64], at: NDArray[np.float64]
    ) -> float:
        """Largest ratio of a change (n, 2) px of a transform, at px (n, 2) of b, to the standard
        deviation of a homography fitted to the patches.
        """
        J = offsets(at, scatter.centre, scatter.unit)
        inverse = np.linalg.inv(scatter.information + self._prior(FREE["homography"]))
        deviation = scatter.sigma * np.sqrt(np.einsum("nij,jk,nik->n", J, inverse, J) / 2)
        return float((np.linalg.norm(change_px, axis=1) / deviation).max())


def overlap_corners(
    b_H_a: Matrix, shape_a: tuple[int, int], shape_b: tuple[int, int]
) -> NDArray[np.float64]:
    """(n, 2) px of b: corners of the part of b (H, W) that a (H, W) covers; b's own corners if the
    transform maps part of a to infinity or beside b.
    """
    ours, theirs = _frame(shape_b), _frame(shape_a)
    depth = np.c_[theirs, np.ones(4)] @ b_H_a[2]
    if (depth * depth[0] <= 0).any():
        return ours
    there = transfer(b_H_a, theirs)
    if not np.isfinite(there).all() or np.abs(there).max() > 1e6:
        return ours
    _area, found = cv2.intersectConvexConvex(there.astype(np.float32), ours.astype(np.float32))
    return ours if found is None or len(found) < 3 else found.reshape(-1, 2).astype(np.float64)


def _frame(shape: tuple[int, int]) -> NDArray[np.float64]:
    height, width = shape
    low, right, bottom = -0.5, width - 0.5, height - 0.5
    return np.array([[low, low], [right, low], [right, bottom], [low, bottom]])
