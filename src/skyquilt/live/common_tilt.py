"""What the tilts that a drone reports have in common beside those found: a gimbal that is off, or
a camera that is mounted aslant. It is foreseen for the next photo.
"""

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.false_tilts import FEWEST, LEAST_INSIDE, common_turn

Array = NDArray[np.float64]


def common_tilt(told: Array, found: Array) -> Array:
    """The rotation (3, 3) by which cameras turn from where they are told to look (n, 3, 3) to where
    they were found to (n, 3, 3), both `cam_R_map` with the headings found; the identity where they
    are few, or do not agree, by the rules of whole flights (`false_tilts.common_tilts`).
    """
    axes = np.einsum("nij,nj->ni", told, found[:, 2]) if len(told) else np.zeros((0, 3))
    axes = axes[axes[:, 2] > LEAST_INSIDE]
    if len(axes) < FEWEST:
        return np.eye(3)
    tangents = axes[:, :2] / axes[:, 2:]
    middle = np.median(tangents, axis=0)
    common = common_turn(middle, np.linalg.norm(tangents - middle, axis=1))
    return np.eye(3) if common is None else common[1].T
