"""Relative rotation of two cameras on one drone, from pairs of photos taken at the same time.

Both cameras have almost the same position, so the pixels of a pair correspond by a rotation alone,
whatever the relief of the ground. Each pair gives a rotation. The rig has a single one, so pairs
that disagree with it are outliers.

Shutters of two cameras are seldom released at once, and a drone flies some centimetres in a
hundredth of a second. Where it flies the same way in all photos as the camera sees it, the rotation
takes that up. Where it does not (the camera keeps its heading on all lines), rotations of pairs
differ, each along its flight: then one delay of the second camera explains them all.

A second camera that exposes by its own clock, several times a second, is late by another time in
each pair. Their recorded times are used where they bring the pairs nearer to one rotation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from skyquilt.geometry.camera import rays
from skyquilt.geometry.frames import angle_deg, median_rotation, turning
from skyquilt.model.camera import Camera
from skyquilt.model.registration import RefusedRegistration

Array = NDArray[np.float64]
_DELAYS = 31
"""Delays that are tried before the best one is refined."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RigPair:
    """Correspondences of two photos taken at the same time."""

    px_a: Array
    """(n, 2) px of the first camera's photo."""
    px_b: Array
    """(n, 2) px of the second's."""
    camera_a: Camera
    """Calibration of the first photo."""
    pace: Array | None = None
    """(n, 3) velocity of the first camera along its own axes over the distance of what each px
    shows, 1/s; None where it is not known.
    """
    late_s: float = 0.0
    """By how much later the second photo says that it was taken, s, beside what is usual."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Looks:
    """What both cameras of a pair see, as unit vectors (n, 3) along their own axes."""

    a: Array
    """By the first one."""
    b: Array
    """By the second one."""
    pace: Array
    """(n, 3) `RigPair.pace`, 0 where it is not known."""
    late_s: float
    """`RigPair.late_s`."""

    def late(self, delay_s: float) -> Array:
        """(n, 3) where the second camera, exposed so much later, sees what the first one shows,
        along the axes of the first.
        """
        return np.asarray(self.a - delay_s * self.pace)

    def as_timed(self) -> "_Looks":
        """The same where the second camera was when its photo says that it was taken."""
        return replace(self, a=self.late(self.late_s), late_s=0.0)


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
    a_t_b: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) where the second camera is, m along the axes of the first."""
    delay_s: float = 0.0
    """How much later than the first camera the second one is exposed, s; 0 where nothing tells."""
    timed: bool = False
    """Whether `RigPair.late_s` comes to that in each pair: the pairs agree better with it."""


@dataclass(frozen=True, kw_only=True)
class FindRig:
    """Finds the rotation on which most pairs agree, and the delay that makes them agree, then fits
    one rotation to all of these pairs.
    """

    free: float = 0.15
    """Share by which the second focal length may change; 0 = it is known."""
    agree_deg: float = 1.0
    """Largest angle to the common rotation for a pair to agree."""
    minimum: int = 3
    """Fewest pairs that must agree."""
    longest_s: float = 3.0
    """Longest delay of either camera that is looked for, s."""
    sure: float = 4.0
    """A delay is taken if it lies that many standard deviations from none, by how much nearer to
    one rotation it brings the pairs.
    """
    told_s: float = 0.0
    """The delay of the second camera that its files tell, s; another one must clearly beat it."""
    version: ClassVar[int] = 4

    def __call__(self, pairs: Sequence[RigPair], camera_b: Camera) -> Rig | RefusedRegistration:
        """The rig, or the reason why there is none."""
        if len(pairs) < self.minimum:
            return RefusedRegistration(
                reason=f"{len(pairs)} pairs taken together could be registered, and {self.minimum}"
                " are needed"
            )
        if self.free > 0:
            camera_b = self._focal(pairs, camera_b)
        looks, timed = self._timed([_looks(p, camera_b) for p in pairs])
        delay = self._delay(looks)
        off = _apart(looks, delay)
        agreeing = [p for p, o in zip(looks, off, strict=True) if o < self.agree_deg]
        if len(agreeing) < max(self.minimum, 0.5 * len(pairs)):
            return RefusedRegistration(
                reason=f"{len(agreeing)} of {len(pairs)} pairs taken together agree on one rotation"
                " of the cameras"
            )
        return Rig(
            b_R_a=_rotation(agreeing, delay),
            camera_b=camera_b,
            agreeing=len(agreeing),
            pairs=len(pairs),
            spread_deg=float(np.median(off[off < self.agree_deg])),
            delay_s=delay,
            timed=timed,
        )

    def _timed(self, looks: Sequence[_Looks]) -> tuple[Sequence[_Looks], bool]:
        """What the pairs see where the second camera was by the recorded times, and True, if that
        brings them clearly nearer to one rotation; else as they are, and False.
        """
        if not any(p.late_s and p.pace.any() for p in looks):
            return looks, False
        by_times = [p.as_timed() for p in looks]
        plain, timed = (_mean_deg(found, self._delay(found)) for found in (looks, by_times))
        if 2 * len(looks) * np.log(plain / timed) > self.sure**2 / 2:
            return by_times, True
        return looks, False

    def _delay(self, looks: Sequence[_Looks]) -> float:
        """The delay in s at which the pairs' rotations lie nearest to a common one; `told_s` where
        none brings them clearly nearer. Where angles r have the density exp(-r/s) / s^2 in the
        plane, the logarithm of the likelihood is -2 n log(mean r), and rises by half the square of
        the number of standard deviations.
        """
        if not any(p.pace.any() for p in looks):
            return 0.0
        tried = np.linspace(-self.longest_s, self.longest_s, _DELAYS)
        mean_deg = partial(_mean_deg, looks)
        near, step = float(min(tried, key=mean_deg)), float(tried[1] - tried[0])
        best = minimize_scalar(
            mean_deg, bounds=(near - step, near + step), method="bounded", options={"xatol": 1e-3}
        ).x
        gain = 2 * len(looks) * np.log(mean_deg(self.told_s) / mean_deg(float(best)))
        return float(best) if gain > self.sure**2 / 2 else self.told_s

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


def _looks(pair: RigPair, camera_b: Camera) -> _Looks:
    a, b = _unit(pair.camera_a, pair.px_a), _unit(camera_b, pair.px_b)
    pace = np.zeros_like(a) if pair.pace is None else pair.pace
    return _Looks(a=a, b=b, pace=pace, late_s=pair.late_s)


def _apart(looks: Sequence[_Looks], delay_s: float) -> Array:
    """(n,) angles in degrees between the rotations of pairs and what most of them agree on."""
    own = [_rotation([p], delay_s) for p in looks]
    common = median_rotation(own)
    return np.array([angle_deg(R, common) for R in own])


def _mean_deg(looks: Sequence[_Looks], delay_s: float) -> float:
    """Mean of these angles."""
    return max(float(_apart(looks, delay_s).mean()), 1e-3)


def _rotation(looks: Sequence[_Looks], delay_s: float) -> Array:
    a = np.concatenate([p.late(delay_s) for p in looks])
    return turning(a, np.concatenate([p.b for p in looks]))


def _misfit(pair: RigPair, camera_b: Camera) -> float:
    """RMS angle in radians between rotated and observed directions of one pair."""
    a, b = _unit(pair.camera_a, pair.px_a), _unit(camera_b, pair.px_b)
    return float(np.sqrt(((a @ turning(a, b).T - b) ** 2).sum(1).mean()))
