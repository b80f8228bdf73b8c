"""How many of its matches an adjustment keeps of each photo: few of one in a false minimum."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.neighbours import nearest
from skyquilt.model.features import Features, Link
from skyquilt.model.poses import Alignment, TiePoints

SAME_PX = 3.0
"""Distance in px of the image searched for features up to which a keypoint is that of a tie
point.
"""


def kept_matches(
    alignment: Alignment, features: Sequence[Features], links: Sequence[Link]
) -> dict[int, float]:
    """Of the tie points that the links of a held photo show it, the share that it is an observation
    of; 1 where they show none. Rays of a photo whose pose is wrong miss most of them, while those
    of the others still meet.
    """
    ties, held = alignment.ties, alignment.held
    shown, kept = dict.fromkeys(held, 0), dict.fromkeys(held, 0)
    points = {i: tie_points_at(ties, i, features[i].px, features[i].scale) for i in held}
    for k in links:
        if k.a in points and k.b in points:
            a, b = points[k.a][k.index_a], points[k.b][k.index_b]
            either = (a >= 0) | (b >= 0)
            same = int(((a == b) & either).sum())
            for photo in (k.a, k.b):
                shown[photo] += int(either.sum())
                kept[photo] += same
    return {i: kept[i] / shown[i] if shown[i] else 1.0 for i in held}


def tie_points_at(
    ties: TiePoints, photo: int, px: NDArray[np.float64], scale: float
) -> NDArray[np.int64]:
    """(n,) the tie point that lies at each place (n, 2) of a photo, -1 where there is none.
    `scale`: px of the photo per px of the image that was searched for features.
    """
    own = np.flatnonzero(ties.photo == photo)
    if not len(own) or not len(px):
        return np.full(len(px), -1)
    away, at = nearest(ties.px[own], px, 1)
    return np.where(away[:, 0] < SAME_PX * scale, ties.point[own[at[:, 0]]], -1)
