"""One or two views of a board -> a lens with priors, as the thesis's single heated board.

One view of a plane tells the focal length from its foreshortening only, and can hardly tell the
principal point from a tilt. The thesis held the principal point and all coefficients but k1
[Yahyanejad 2013, 6.3, Tables 6.2 and 6.3], which leaves what is assumed out of the deviations. Here
every parameter has a prior, and the result is the maximum of the posterior with its deviations:
what the views do not determine keeps the prior's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.calibrate import Calibrate
from skyquilt.calibration.deviations import linearised
from skyquilt.calibration.start import start_pose
from skyquilt.model.board import Board, BoardView
from skyquilt.model.calibration import BoardPose, Calibration, Marks, Observations, rms
from skyquilt.model.camera import PARAMETERS, Camera

Array = NDArray[np.float64]
FREE = ("focal", "cx", "cy", "k1", "k2")
"""Parameters that are estimated; k3, p1 and p2 stay zero."""
PRINCIPAL = 0.015
"""Standard deviation of a principal point about the middle, as a share of the longer side."""
RADIAL = (0.4, 0.2)
"""Standard deviations of k1 and k2 about zero."""
REPEATED = 2.0
"""Factor on the deviations of the observations: heat shifts neighbouring squares alike, and one
view cannot tell such errors from perspective.
"""
_STEPS = 60
"""Largest number of steps of a fit."""
_LEAST_PX = 0.02
"""Least deviation of an observation in px."""


@dataclass(frozen=True, kw_only=True)
class FewViews:
    """The maximum of the posterior by Levenberg-Marquardt, and its covariance to first order."""

    version: ClassVar[int] = 1
    marks: Marks = "centres"
    """Type of points used as observations."""
    focal_px: float
    """Prior of the focal length, px."""
    sigma_px: float
    """Its standard deviation, px; used as a relative one, since a focal length is positive."""
    rounds: int = 3
    """How many times centroids are corrected for perspective and distortion, and the noise
    estimated.
    """

    def __call__(self, views: Sequence[BoardView], board: Board) -> Calibration:
        """The camera, with deviations of what was assumed too.

        Raises `ValueError` for no view, or views that differ in size.
        """
        if not views or len({(v.width, v.height) for v in views}) != 1:
            raise ValueError(
                f"views of one size expected, got {[(v.width, v.height) for v in views]}"
            )
        way = Calibrate(marks=self.marks)
        seen = [way.observations(v, board) for v in views]
        camera = Camera.ideal(width=views[0].width, height=views[0].height, focal=self.focal_px)
        poses, used, sigma = [start_pose(s, camera) for s in seen], seen, 0.3
        for _ in range(self.rounds):
            camera, poses = self._fit(used, camera, poses, sigma)
            used = way.corrected(seen, camera, poses, board)
            sigma = max(_LEAST_PX, REPEATED * self._noise(used, camera, poses))
        camera, poses = self._fit(used, camera, poses, sigma)
        left = [linearised(s, camera, p, ())[1] for s, p in zip(used, poses, strict=True)]
        sigmas = self._sigmas(used, camera, poses, sigma)
        return Calibration(
            marks=self.marks,
            camera=replace(camera, sigmas=tuple(sigmas.get(n, 0.0) for n in PARAMETERS)),
            free=FREE,
            dropped=(),
            observations=tuple(used),
            poses=tuple(poses),
            residuals=tuple(left),
        )

    def prior(self, camera: Camera) -> tuple[Array, Array]:
        """Expected values and standard deviations (5,) of `FREE`, the focal length's as its
        logarithm.
        """
        off = PRINCIPAL * max(camera.width, camera.height)
        middle = (camera.width - 1) / 2, (camera.height - 1) / 2
        return (
            np.array([np.log(self.focal_px), *middle, 0.0, 0.0]),
            np.array([self.sigma_px / self.focal_px, off, off, *RADIAL]),
        )

    def _fit(
        self, seen: Sequence[Observations], camera: Camera, poses: Sequence[BoardPose], sigma: float
    ) -> tuple[Camera, list[BoardPose]]:
        """The maximum of the posterior for observations with a deviation of `sigma` px."""
        poses, damping = list(poses), 1e-3
        normal, gradient, cost = self._equations(seen, camera, poses, sigma)
        for _ in range(_STEPS):
            damped = normal + damping * np.diag(np.diag(normal))
            step = np.asarray(np.linalg.solve(damped, gradient), np.float64)
            new = _moved(camera, poses, step)
            equations = self._equations(seen, *new, sigma)
            if not np.isfinite(equations[2]) or equations[2] > cost:
                damping *= 8
                if damping > 1e9:
                    break
                continue
            gained = cost - equations[2]
            (camera, poses), (normal, gradient, cost) = new, equations
            damping = max(damping / 5, 1e-12)
            if gained < 1e-10 * max(cost, 1e-9):
                break
        return camera, poses

    def _equations(
        self, seen: Sequence[Observations], camera: Camera, poses: Sequence[BoardPose], sigma: float
    ) -> tuple[Array, Array, float]:
        """Normal matrix, right side and cost in units of deviations; intrinsics first (focal length
        as its logarithm), then six per view.
        """
        own, size = len(FREE), len(FREE) + 6 * len(seen)
        normal, gradient = np.zeros((size, size)), np.zeros(size)
        expected, deviation = self.prior(camera)
        here = np.array([np.log(camera.focal), *(getattr(camera, n) for n in FREE[1:])])
        off = (expected - here) / deviation
        normal[:own, :own] = np.diag(deviation**-2.0)
        gradient[:own], cost = off / deviation, float(off @ off)
        columns = [PARAMETERS.index(n) for n in FREE]
        for k, (view, pose) in enumerate(zip(seen, poses, strict=True)):
            J, r = linearised(view, camera, pose, columns)
            J = J.copy()
            J[:, :, 0] *= camera.focal  # by the logarithm
            flat, e = J.reshape(-1, own + 6) / sigma, r.ravel() / sigma
            where = np.r_[0:own, own + 6 * k : own + 6 * k + 6]
            normal[np.ix_(where, where)] += flat.T @ flat
            gradient[where] += flat.T @ e
            cost += float(e @ e)
        return normal, gradient, cost

    def _noise(
        self, seen: Sequence[Observations], camera: Camera, poses: Sequence[BoardPose]
    ) -> float:
        """Deviation of an observation in px per axis, from the residuals."""
        left = [linearised(s, camera, p, ())[1] for s, p in zip(seen, poses, strict=True)]
        count = 2 * sum(len(r) for r in left)
        spare = max(count - 6 * len(seen) - len(FREE), 1)
        return rms(np.concatenate(left)) * float(np.sqrt(count / 2 / spare))

    def _sigmas(
        self, seen: Sequence[Observations], camera: Camera, poses: Sequence[BoardPose], sigma: float
    ) -> dict[str, float]:
        normal, _, _ = self._equations(seen, camera, poses, sigma)
        found = np.sqrt(np.diag(np.linalg.inv(normal))[: len(FREE)])
        found[0] *= camera.focal
        return dict(zip(FREE, found.tolist(), strict=True))


def _moved(
    camera: Camera, poses: Sequence[BoardPose], step: Array
) -> tuple[Camera, list[BoardPose]]:
    """Camera and poses after a step."""
    own = len(FREE)
    values: dict[str, Any] = {
        n: float(getattr(camera, n) + d) for n, d in zip(FREE[1:], step[1:own], strict=True)
    }
    moved = replace(camera, focal=float(camera.focal * np.exp(np.clip(step[0], -1, 1))), **values)
    turned = []
    for pose, d in zip(poses, step[own:].reshape(-1, 6), strict=True):
        R = np.asarray(cv2.Rodrigues(d[:3])[0], np.float64) @ pose.cam_R_board
        turned.append(BoardPose(cam_R_board=R, cam_t=pose.cam_t + d[3:]))
    return moved, turned


_OPEN = 0.7
"""A parameter whose deviation is still this share of the prior's is not determined by the views."""
_WORDS = {
    "focal": "the focal length",
    "cx": "the principal point in x",
    "cy": "the principal point in y",
    "k1": "k1",
    "k2": "k2",
}


def cannot_know(found: Calibration, way: FewViews) -> tuple[str, ...]:
    """What so few views leave open, as sentences for the page and calibration.json."""
    expected, deviation = way.prior(found.camera)
    deviation[0] *= found.camera.focal
    left = [
        _WORDS[n]
        for n, before in zip(FREE, deviation.tolist(), strict=True)
        if found.sigma(n) > _OPEN * before
    ]
    first = (
        f"Hardly determined by the views, and so mostly assumed: {', '.join(left)}."
        if left
        else "The views determine all that was estimated better than it was assumed."
    )
    return (
        first,
        f"Assumed were a focal length of {np.exp(expected[0]):.0f} px within"
        f" {100 * way.sigma_px / way.focal_px:.0f} %, a principal point in the middle within"
        f" {deviation[1]:.0f} px, k1 and k2 of zero within {RADIAL[0]:g} and {RADIAL[1]:g}.",
        "k3, p1 and p2 are zero, not measured.",
        "No view was kept out, so the error on other views is unknown; take three tilted views or"
        " more to know it.",
    )
