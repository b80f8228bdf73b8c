"""Difference between two calibrations of one lens from the same views, as a measure of their
uncertainty.
"""

from dataclasses import replace

import numpy as np

from skyquilt.model.calibration import Calibration
from skyquilt.model.camera import PARAMETERS

_LENGTHS = ("focal", "cx", "cy")


def widened(found: Calibration, other: Calibration) -> Calibration:
    """A calibration whose lengths (focal length, principal point) have deviations increased by the
    difference from another one, from other points of the same views, divided by the square root of
    two.

    Heat moves the edges of squares in the same way in every view. Poses and intrinsics absorb part
    of this, which no residual shows; centres and corners absorb it differently. Distortion
    coefficients are not changed, since the two calibrations may have different orders.
    """
    apart = found.camera.vector - other.camera.vector
    apart = np.where([n in found.free and n in _LENGTHS for n in PARAMETERS], apart, 0.0)
    sigmas = np.hypot(found.camera.sigmas or np.zeros(len(apart)), apart / np.sqrt(2))
    return replace(found, camera=replace(found.camera, sigmas=tuple(sigmas.tolist())))
