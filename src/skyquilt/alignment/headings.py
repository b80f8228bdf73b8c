"""What the headings of one aircraft have in common: a compass that is off, or a gimbal that counts
from elsewhere, turns all of them by one angle. Taken each by itself, as many of them as there are
photos would turn the map.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.start import Start
from skyquilt.geometry.frames import angle_difference_deg
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Prior

Array = NDArray[np.float64]
GROSS_DEG = 20.0
"""A heading that is off by more is false."""
LOOSEST_DEG = 20.0
"""Deviation of a heading at most, where many share one error."""
ALIKE_DEG = 20.0
"""Headings are off by one angle if most of them are off by about as much."""
LEAST = 3
"""Fewer headings do not tell what they have in common."""


def steered(
    photos: Sequence[Photo], priors: Sequence[Prior], start: Start, yaw_deg: Mapping[int, float]
) -> list[Prior]:
    """The priors, their headings such that all those of one camera and block together count as one
    in the direction of the block, as far as positions tell that better: their errors are common.
    A gross common error from the start's direction (`yaw_deg` of each photo) is taken away.
    """
    out = list(priors)
    for block in start.blocks:
        told = [m for m in block if m in start.georeferenced]
        loose = _direction_deg(
            np.array([priors[m].map_C[:2] for m in told]).reshape(-1, 2),
            np.array([max(priors[m].sigma_C[0], start.sigma_xy[m]) for m in told]),
        )
        for key in dict.fromkeys(photos[m].camera_key for m in block):
            own = [m for m in block if photos[m].camera_key == key]
            headed = [m for m in own if np.isfinite(priors[m].yaw_deg)]
            off = [angle_difference_deg(priors[m].yaw_deg, yaw_deg[m]) for m in headed]
            common = common_error_deg(np.array(off), [photos[m].editor is None for m in headed])
            for m in headed:
                told_deg = priors[m].sigma_yaw_deg
                share = max(0.0, 1 - (loose / told_deg) ** 2)
                looser = told_deg * np.sqrt(1 + share * (len(headed) - 1))
                out[m] = replace(
                    priors[m],
                    yaw_deg=priors[m].yaw_deg - (common if abs(common) > GROSS_DEG else 0.0),
                    sigma_yaw_deg=float(max(told_deg, min(looser, LOOSEST_DEG))),
                )
    return out


def common_error_deg(off_deg: Array, whole: Sequence[bool]) -> float:
    """The angle in degrees by which most of some headings are off; 0 where they are not off alike.

    `off_deg` (n,): reported minus estimated. `whole`: whether each file is as its camera wrote it;
    files that programs rewrote may be turned, so they count only where there are no others, and
    then a half turn is not the compass's.
    """
    own = off_deg[np.array(whole, bool)]
    off = own if len(own) >= LEAST else off_deg
    if len(off) < LEAST:
        return 0.0
    near = np.abs(angle_difference_deg(off[:, None], off)) < ALIKE_DEG
    best = int(np.argmax(near.sum(1)))
    if 2 * near[best].sum() <= len(off):
        return 0.0
    about = angle_difference_deg(off[near[best]], off[best])
    angle = angle_difference_deg(float(off[best]), -float(np.median(about)))
    return 0.0 if off is off_deg and not all(whole) and abs(angle) > 180 - ALIKE_DEG else angle


def _direction_deg(C: Array, sigma_m: Array) -> float:
    """Deviation in degrees of the direction that positions C (n, 2) in m of deviations (n,) tell;
    those that are not known are NaN.
    """
    known = np.isfinite(C).all(1)
    if not known.any():
        return np.inf
    weight = sigma_m[known] ** -2
    reach = C[known] - np.average(C[known], axis=0, weights=weight)
    tells = float((weight * (reach**2).sum(1)).sum())
    return float(np.degrees(1 / np.sqrt(max(tells, 1e-12))))
