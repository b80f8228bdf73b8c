"""Parallax relative to a plane: the height that follows from a disparity after the plane's
homography.

A point P at height h above a plane is seen from a's centre T at the same image point as the plane's
point W, and lies on the segment from W to T: P = (1 - l) W + l T with l = h / (height of a above
the plane). Projecting P and W into photo b gives the disparity exactly, whatever the tilt of b and
the difference of the heights of both.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def heights_above_plane(
    d: Array, w: Array, b_T: Array, depth: Array, height_a: float
) -> tuple[Array, Array, Array]:
    """Heights (n,) above the plane, disparities (n,) along the baseline and (n,) across it.

    `d` (n, 2): disparities in photo b, units of the focal length; `w` (n, 2): positions of the
    points predicted by the plane's homography, same unit, undistorted; `b_T` (3,): centre of photo
    a in camera coordinates of b; `depth` (n,): depth of the plane in b at w, `height_a`: height of
    a above the plane, all in the same unit, which is also that of the heights. NaN where the
    baseline points at the point itself. Disparities are positive for points above the plane.
    """
    g = b_T[:2] - w * b_T[2]
    long = np.linalg.norm(g, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (d * g).sum(1) / long
        across = (d[:, 0] * g[:, 1] - d[:, 1] * g[:, 0]) / long
        s = along / long
        share = s * depth / (1 + s * (depth - b_T[2]))
    return np.asarray(share * height_a), np.asarray(along), np.asarray(across)
