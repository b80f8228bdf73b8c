"""Keeps the frame of a map without a place: without positions every adjustment of a block ends in
a frame of its own, at another place, turned, and of another size.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.poses import Alignment, Pose

Array = NDArray[np.float64]
RAYS = np.array([[0, 0, 1], [-0.4, -0.3, 1], [0.4, -0.3, 1], [0.4, 0.3, 1], [-0.4, 0.3, 1]])
"""Rays of a camera along which it is compared where it looks."""
LEAST_DROP = 0.3
"""Steepness down to which a ray is followed to the ground; one that is flatter ends there."""


def in_frame_of(done: Alignment, before: Mapping[int, Pose], ground: float) -> Alignment | None:
    """An alignment in the frame of former poses `before`, in which the ground is `ground` high (m):
    moved, turned about the vertical and scaled, so that the photos of both stand and look where
    they did. None where they have no photo in common, or no scale joins them.
    """
    common = [i for i in done.poses if i in before]
    if not common or not len(done.ties.xyz):
        return None
    level = float(np.median(done.ties.xyz[:, 2]))
    a = np.concatenate([_seen(done.poses[i], level) for i in common])
    b = np.concatenate([_seen(before[i], ground) for i in common])
    middle_a, middle_b = a.mean(0), b.mean(0)
    p, q = a - middle_a, b - middle_b
    across = complex(
        (p[:, 0] * q[:, 0] + p[:, 1] * q[:, 1]).sum(), (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()
    )
    scale = float((abs(across) + (p[:, 2] * q[:, 2]).sum()) / (p**2).sum())
    if not np.isfinite(scale) or scale <= 0 or across == 0:
        return None
    c, s = across.real / abs(across), across.imag / abs(across)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return done.carried(turn, scale, middle_a, middle_b)


def _seen(pose: Pose, level: float) -> Array:
    """(6, 3) the centre of a camera, and where its rays meet a ground of this height."""
    rays = RAYS @ pose.cam_R_map
    fall = (level - pose.map_C[2]) / np.minimum(rays[:, 2], -LEAST_DROP)
    return np.concatenate([pose.map_C[None], pose.map_C + rays * fall[:, None]])
