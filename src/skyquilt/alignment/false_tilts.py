"""Tilts that files report and pictures contradict: those of a camera fixed to its aircraft, whose
files say that it looked straight down. Believed to a degree, they bend the map.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from skyquilt.alignment.determined import STATED_DEG
from skyquilt.alignment.priors import empty_prior
from skyquilt.geometry.frames import angles_from_cam_R_map, cam_R_map_from_angles
from skyquilt.model.poses import Alignment, Prior

FEWEST = 6
"""Photos that are needed to judge tilts."""
FALSE_DEG = 3.0
"""Half of the axes are further from where files tell than this, and further
"""
FALSE_DEVIATIONS = 3.0
"""than so many of the deviations stated."""
MOST_DEG = 20.0
"""Largest deviation from the vertical that such photos are given."""
NOTE = (
    "The reported tilts of the camera contradict the pictures: half of the photos look more than"
    " {0:.0f} degrees away from where they say (a camera that is fixed to its aircraft?). They were"
    " not used."
)


def told_no_tilt(found: Alignment, priors: Sequence[Prior]) -> tuple[Sequence[Prior], str]:
    """The priors without the tilts that they report, and a note, where an alignment contradicts
    these as a whole; otherwise the priors themselves and an empty text.
    """
    stated = [i for i in found.held if priors[i].sigma_tilt_deg <= STATED_DEG]
    if len(stated) < FEWEST or 2 * len(stated) < len(found.held):
        return priors, ""
    cosine = []
    for i in stated:
        prior, R = priors[i], found.poses[i].cam_R_map
        yaw = angles_from_cam_R_map(R)[0]  # that of files may be wrong by itself
        told = cam_R_map_from_angles(yaw, prior.pitch_deg, prior.roll_deg)
        cosine.append(float(R[2] @ told[2]))
    apart = np.arccos(np.clip(cosine, -1, 1))
    usual = float(np.degrees(np.median(apart)))
    sigma = float(np.median([priors[i].sigma_tilt_deg for i in stated]))
    if usual <= max(FALSE_DEG, FALSE_DEVIATIONS * sigma):
        return priors, ""
    loose = float(np.clip(usual, empty_prior().sigma_tilt_deg, MOST_DEG))
    return [
        replace(p, pitch_deg=0.0, roll_deg=0.0, sigma_tilt_deg=loose) for p in priors
    ], NOTE.format(usual)
