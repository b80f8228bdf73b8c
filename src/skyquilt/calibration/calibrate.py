"""Views of a board -> a calibrated lens, from centres of squares or from corners [Yahyanejad 2013,
6.3].
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.calibration.solve import Solution, solve
from skyquilt.calibration.square_image import centroid_bias
from skyquilt.calibration.start import start_camera, start_pose
from skyquilt.model.board import Board, BoardView
from skyquilt.model.calibration import BoardPose, Calibration, Marks, Observations, rms
from skyquilt.model.camera import PARAMETERS, SQUARE, Camera

Array = NDArray[np.float64]
_OPTIONAL = (("k3",), ("p1", "p2"), ("k2",), ("k1",))
"""Coefficients in the order in which they are dropped: the highest order first, both tangential
ones at once.
"""


_LENGTHS = ("focal", "cx", "cy")


@dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Least squares; coefficients smaller than their tolerance are dropped and the rest is fitted
    again.
    """

    version: ClassVar[int] = 2
    marks: Marks = "centres"
    """Type of points used as observations."""
    tolerance: float = 3.0
    """A coefficient's tolerance in standard deviations, as in the toolbox that the thesis used."""
    rounds: int = 3
    """How many times centroids are corrected for perspective and distortion with the current
    camera.
    """

    def __call__(self, views: Sequence[BoardView], board: Board) -> Calibration:
        """The camera of at least two views of equal size.

        Raises `ValueError` where views differ in size or are fewer.
        """
        if len(views) < 2 or len({(v.width, v.height) for v in views}) != 1:
            raise ValueError(
                "two views or more of one size expected, got"
                f" {[(v.width, v.height) for v in views]}"
            )
        seen = [self.observations(v, board) for v in views]
        start = start_camera(seen, width=views[0].width, height=views[0].height)
        poses = [start_pose(s, start) for s in seen]
        rough = solve(seen, start, poses, ("focal",))
        rough = solve(seen, rough.camera, rough.poses, ("focal", "k1"))
        return self._reduced(seen, rough, board)

    def observations(self, view: BoardView, board: Board) -> Observations:
        """The points of a view that are used."""
        points, px = (
            (board.corners, view.corners)
            if self.marks == "corners"
            else (board.centres, view.centroids)
        )
        known = np.isfinite(px[..., 0])
        if self.marks == "centres":
            known &= board.inner  # the surroundings of the outer squares are unknown [Y 5.1.3]
        return Observations(
            name=view.name,
            board=points[known],
            px=px[known],
            rounding_px=view.rounding_px[known] if self.marks == "centres" else 0.0,
        )

    def _reduced(self, seen: Sequence[Observations], rough: Solution, board: Board) -> Calibration:
        """Fits all parameters, and again without those that are smaller than their tolerance."""
        free, dropped = list(SQUARE), []
        solution, used = self._fit(seen, rough, free, board)
        full = solution.camera
        for names in _OPTIONAL:
            found = [
                (n, getattr(solution.camera, n), self.tolerance * _sigma(solution.camera, n))
                for n in names
            ]
            if any(abs(value) >= tolerance for _, value, tolerance in found):
                if names == ("p1", "p2"):
                    continue  # a radial term may be unnecessary although decentring is not
                break
            dropped += found
            free = [n for n in free if n not in names]
            held = _without(solution.camera, names)
            solution, used = self._fit(seen, replace(solution, camera=held), free, board)
        return Calibration(
            marks=self.marks,
            camera=_widened(solution.camera, full, free),
            free=tuple(free),
            dropped=tuple(dropped),
            observations=tuple(used),
            poses=solution.poses,
            residuals=solution.residuals,
        )

    def _fit(
        self, seen: Sequence[Observations], start: Solution, free: Sequence[str], board: Board
    ) -> tuple[Solution, Sequence[Observations]]:
        """The solution, and the observations corrected with it."""
        solution, used = start, seen
        for _ in range(self.rounds if self.marks == "centres" else 1):
            used = self.corrected(seen, solution.camera, solution.poses, board)
            solution = solve(used, solution.camera, solution.poses, free)
        return solution, used

    def corrected(
        self, seen: Sequence[Observations], camera: Camera, poses: Sequence[BoardPose], board: Board
    ) -> list[Observations]:
        """Converts centroids of square images to images of square centres; corners are not
        changed.
        """
        if self.marks == "corners":
            return list(seen)
        return [
            replace(
                s, px=s.px - centroid_bias(camera, pose, s.board, board.square_m, s.rounding_px)
            )
            for s, pose in zip(seen, poses, strict=True)
        ]

    def left_over(self, view: BoardView, camera: Camera, board: Board) -> Array:
        """Residuals (n, 2) in px of a view that was not used for the camera: only its pose is
        fitted.
        """
        seen = [self.observations(view, board)]
        poses: Sequence[BoardPose] = [start_pose(seen[0], camera)]
        residuals = np.zeros((0, 2))
        for _ in range(self.rounds if self.marks == "centres" else 1):
            solution = solve(self.corrected(seen, camera, poses, board), camera, poses, ())
            poses, residuals = solution.poses, solution.residuals[0]
        return residuals


def _sigma(camera: Camera, name: str) -> float:
    return camera.sigmas[PARAMETERS.index(name)] if camera.sigmas else 0.0


def _without(camera: Camera, names: Sequence[str]) -> Camera:
    """The camera with some of its coefficients set to zero."""
    changed: dict[str, Any] = dict.fromkeys(names, 0.0)
    return replace(camera, **changed)


def _widened(camera: Camera, full: Camera, free: Sequence[str]) -> Camera:
    """The camera with the deviations of focal length and principal point increased by their change
    when coefficients were dropped, since a coefficient below its tolerance is not exactly zero.
    Distortion coefficients are not compared, since their meaning depends on the order of the model.
    """
    moved = np.where(
        [n in free and n in _LENGTHS for n in PARAMETERS], camera.vector - full.vector, 0.0
    )
    return replace(
        camera, sigmas=tuple(np.hypot(camera.sigmas or np.zeros(len(moved)), moved).tolist())
    )


def strangers(calibration: Calibration, *, times: float = 4.0) -> dict[str, float]:
    """Views whose RMS error in px is more than `times` that of the median view: the board was
    moved, or is another one.
    """
    each = np.array([rms(r) for r in calibration.residuals])
    limit = times * float(np.median(each))
    return {
        s.name: float(e) for s, e in zip(calibration.observations, each, strict=True) if e > limit
    }
