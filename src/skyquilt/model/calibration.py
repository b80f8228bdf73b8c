"""A calibrated camera, and how well it explains the observed boards."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.camera import PARAMETERS, Camera

Array = NDArray[np.float64]
Marks = Literal["centres", "corners"]
"""What is observed on a board: centres of squares, or corners between them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardPose:
    """Pose of a board: x_cam = cam_R_board @ x_board + cam_t."""

    cam_R_board: Array
    """(3, 3)."""
    cam_t: Array
    """(3,) in m."""

    def __call__(self, board: Array) -> Array:
        """Points (n, 3) of the board, in m, in camera coordinates."""
        return np.asarray(board @ self.cam_R_board.T + self.cam_t)


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Points of the board seen in one view."""

    name: str
    """Of the view."""
    board: Array
    """(n, 3) in m, frame *board*."""
    px: Array
    """(n, 2) in px."""
    rounding_px: Array | float = 0.0
    """(n,) as in `BoardView`; 0 for corners."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """Intrinsics with their standard deviations, a board pose per view, and the residuals."""

    marks: Marks
    """What was observed."""
    camera: Camera
    """The result; `sigmas` are standard deviations, 0 for parameters that were held fixed."""
    free: tuple[str, ...]
    """The parameters that were estimated, in the order of `PARAMETERS`."""
    dropped: tuple[tuple[str, float, float], ...]
    """Name, value and tolerance of each coefficient that was smaller than its tolerance, in the
    order of dropping.
    """
    observations: tuple[Observations, ...]
    """One per view, px of centres corrected for perspective and distortion."""
    poses: tuple[BoardPose, ...]
    """One per view."""
    residuals: tuple[Array, ...]
    """Measured minus predicted (n, 2) in px, one array per view."""

    @property
    def rms_px(self) -> float:
        """Root of the mean squared distance in px between measured and predicted points."""
        return rms(np.concatenate(self.residuals))

    @property
    def mean_error_px(self) -> tuple[float, float]:
        """Mean absolute error in x and in y in px, as in Y Tables 6.2 and 6.3."""
        x, y = np.abs(np.concatenate(self.residuals)).mean(0)
        return float(x), float(y)

    def sigma(self, name: str) -> float:
        """Standard deviation of a parameter; 0 for one that was held fixed."""
        return self.camera.sigmas[PARAMETERS.index(name)] if self.camera.sigmas else 0.0


def rms(residuals: Array) -> float:
    """Root of the mean squared length of residuals (n, 2); NaN for none."""
    return float(np.sqrt((residuals**2).sum(1).mean())) if len(residuals) else float("nan")
