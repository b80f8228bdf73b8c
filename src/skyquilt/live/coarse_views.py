"""Coarse photos on a growing map yield to much finer ones, as on the map at the end."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from skyquilt.imaging.blank import around, joined
from skyquilt.imaging.nodes import View
from skyquilt.model.surface import Surface
from skyquilt.ortho.spoilt import MUCH_FINER, finer_shown


def yielding_to_finer(
    views: Sequence[View], sizes: Mapping[int, float], surface: Surface, gsd: float
) -> list[View]:
    """The views of a tile, those whose photos are coarser than its pixels (`gsd`, in m) marked
    where others show its ground much finer. `sizes`: of a pixel of each photo, by its number, in m
    on the ground straight below.
    """
    size = np.array([sizes[v.photo] for v in views])
    coarse = (size > gsd) & (size > MUCH_FINER * size.min())
    if not coarse.any():  # as on most maps
        return list(views)
    height = float(np.median(surface.z))
    found = list(views)
    for k in np.flatnonzero(coarse).tolist():
        view, finer = views[k], np.flatnonzero(MUCH_FINER * size < size[k])
        others = [views[j] for j in finer.tolist()]
        mask, _ = finer_shown(view, float(size[k]), others, size[finer], height)
        if mask.any():
            mark = around(mask, (view.camera.width, view.camera.height))
            known = view.limits.mark
            mark = mark if known is None else joined(mark, known)
            found[k] = replace(view, limits=replace(view.limits, mark=mark))
    return found
