"""Two calibrations of one lens from the same views: what they disagree about is not known."""

from dataclasses import replace

import numpy as np

from skyquilt.model.calibration import Calibration
from skyquilt.model.camera import PARAMETERS

_LENGTHS = ("focal", "cx", "cy")


def widened(found: Calibration, other: Calibration) -> Calibration:
    """A calibration whose lengths (focal length, principal point) have deviations grown by the
    difference from another one, from other marks of the same views, over the square root of two.

    Heat moves the edges of squares in the same way in every view, and no residual shows what poses
    and intrinsics have taken up of that; centres and corners take it up differently. Coefficients
    of distortion are left alone: both calibrations may have other orders.
    """
    apart = found.camera.vector - other.camera.vector
    apart = np.where([n in found.free and n in _LENGTHS for n in PARAMETERS], apart, 0.0)
    sigmas = np.hypot(found.camera.sigmas or np.zeros(len(apart)), apart / np.sqrt(2))
    return replace(found, camera=replace(found.camera, sigmas=tuple(sigmas.tolist())))
