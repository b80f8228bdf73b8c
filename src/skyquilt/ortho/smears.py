"""Where a photo's pixels are smeared over the ground, or show it badly, it yields to others."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import STEP, Nodes
from skyquilt.imaging.view_limits import ground_sizes

Mask = NDArray[np.bool_]
AROUND = np.ones((3, 3), np.uint8)


def smeared(nodes: Nodes, gsd: float) -> Mask:
    """(r, c) where a photo's pixels are larger on the ground than its limits prefer; `gsd`: m per
    map pixel.
    """
    limit, focal = nodes.view.limits.coarsest_m, nodes.view.camera.focal
    # off its axis an image is finer than this
    most = nodes.height / focal * (1 + nodes.score)
    possible = nodes.seen & (most > limit)
    if not possible.any():
        return possible
    return np.asarray(possible & (ground_sizes(nodes.u, nodes.v, STEP * gsd) > limit))


def badly_shown(nodes: Nodes, gsd: float) -> Mask:
    """(r, c) where a photo is smeared, or shows a mark of its limits; `gsd`: m per map pixel."""
    found, mark = smeared(nodes, gsd), nodes.view.limits.mark
    return found if mark is None else found | (nodes.seen & (mark.at(nodes.u, nodes.v) < 0))


def yielding(nodes: Nodes, smear: Mask, others: Sequence[tuple[Nodes, Mask | None]]) -> Nodes:
    """The nodes of a photo without those where it is smeared and another one, with its own smears
    given, is not, there and at all nodes around.
    """
    sharp = np.zeros(smear.shape, np.bool_)
    for other, blurred in others:
        shows = other.seen if blurred is None else other.seen & ~blurred
        sharp |= cv2.erode(shows.view(np.uint8), AROUND).view(np.bool_)
    left = ~(smear & sharp)
    return replace(nodes, seen=nodes.seen & left, real=nodes.real & left)
