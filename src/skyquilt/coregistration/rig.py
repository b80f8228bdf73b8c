"""Relative rotation of two cameras on one drone, from pairs of photos taken at the same time.

Both cameras have almost the same position, so the pixels of a pair correspond by a rotation alone,
whatever the relief of the ground. Each pair gives a rotation. The rig has a single one, so pairs
that disagree with it are outliers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from skyquilt.geometry.camera import rays
from skyquilt.geometry.frames import angle_deg, median_rotation, turning
from skyquilt.model.camera import Camera
from skyquilt.model.registration import RefusedRegistration

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class RigPair:
    """Correspondences of two photos taken at the same time."""

    px_a: Array
    """(n, 2) px of the first camera's photo."""
    px_b: Array
    """(n, 2) px of the second's."""
    camera_a: Camera
    """Calibration of the first photo."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """The second camera relative to the first."""

    b_R_a: Array
    """(3, 3) takes camera coordinates of a to those of b."""
    camera_b: Camera
    """The second camera, with the estimated focal length if it was free."""
    spread_deg: float
    """Median angle between the pairs' own rotations and the common one."""
    agreeing: int
    """Number of pairs used."""
    pairs: int
    """Number of pairs registered."""


@dataclass(frozen=True, kw_only=True)
class FindRig:
    """Finds the rotation on which most pairs agree, then fits one to all of these pairs."""

    free: float = 0.15
    """Share by which the second focal length may change; 0 = it is known."""
    agree_deg: float = 1.0
    """Largest angle to the common rotation for a pair to agree."""
    minimum: int = 3
    """Fewest pairs that must agree."""
    version: ClassVar[int] = 1

    def __call__(self, pairs: Sequence[RigPair], camera_b: Camera) -> Rig | RefusedRegistration:
        """The rig, or the reason why there is none."""
        if len(pairs) < self.minimum:
            return RefusedRegistration(
                reason=f"{len(pairs)} pairs taken together could be registered, and {self.minimum}"
                " are needed"
            )
        if self.free > 0:
            camera_b = self._focal(pairs, camera_b)
        own = [_rotation([p], camera_b) for p in pairs]
        common = median_rotation(own)
        off = np.array([angle_deg(R, common) for R in own])
        agreeing = [p for p, o in zip(pairs, off, strict=True) if o < self.agree_deg]
        if len(agreeing) < max(self.minimum, 0.5 * len(pairs)):
            return RefusedRegistration(
                reason=f"{len(agreeing)} of {len(pairs)} pairs taken together agree on one rotation"
                " of the cameras"
            )
        R = _rotation(agreeing, camera_b)
        return Rig(
            b_R_a=R,
            camera_b=camera_b,
            agreeing=len(agreeing),
            pairs=len(pairs),
            spread_deg=float(np.median(off[off < self.agree_deg])),
        )

    def _focal(self, pairs: Sequence[RigPair], camera_b: Camera) -> Camera:
        """The camera with the focal length that minimises the median misfit of directions over the
        pairs.
        """

        def misfit(log: float) -> float:
            camera = replace(camera_b, focal=camera_b.focal * float(np.exp(log)))
            return float(np.median([_misfit(p, camera) for p in pairs]))

        reach = float(np.log1p(self.free))
        found = minimize_scalar(
            misfit, bounds=(-reach, reach), method="bounded", options={"xatol": 1e-4}
        )
        return replace(camera_b, focal=camera_b.focal * float(np.exp(found.x)))


def _unit(camera: Camera, px: Array) -> Array:
    found = rays(camera, px)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _rotation(pairs: Sequence[RigPair], camera_b: Camera) -> Array:
    a = np.concatenate([_unit(p.camera_a, p.px_a) for p in pairs])
    b = np.concatenate([_unit(camera_b, p.px_b) for p in pairs])
    return turning(a, b)


def _misfit(pair: RigPair, camera_b: Camera) -> float:
    """RMS angle in radians between rotated and observed directions of one pair."""
    a, b = _unit(pair.camera_a, pair.px_a), _unit(camera_b, pair.px_b)
    return float(np.sqrt(((a @ turning(a, b).T - b) ** 2).sum(1).mean()))
