"""From which photos a tile of a growing map is drawn: of many, those that show its ground best.
Coarse photos yield to much finer ones, as on the map at the end.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from skyquilt.imaging.blank import around, joined
from skyquilt.imaging.nodes import View, project_all
from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface
from skyquilt.ortho.spoilt import MUCH_FINER, finer_shown

ACROSS = 9
"""Places along a side of a tile at which photos are compared."""


def showing_best(views: Sequence[View], grid: Grid, surface: Surface, most: int) -> list[View]:
    """At most so many of the views of a tile, in their order: one after the other those that show
    most of what the others do not, or from nearer to straight above. The nearest photos need not
    show it at all: those of an orbit look away from what lies below them.
    """
    if len(views) <= most:
        return list(views)
    west, south, east, north = grid.bounds
    x, y = np.meshgrid(np.linspace(west, east, ACROSS), np.linspace(north, south, ACROSS))
    nodes = project_all(views, x, y, surface.at(x, y))
    worth = np.array([np.where(n.seen, 1 / (1 + n.score), 0.0).ravel() for n in nodes])
    chosen, shown = list[int](), np.zeros(worth.shape[1])
    while len(chosen) < most:
        gain = np.maximum(worth - shown, 0).sum(1)
        best = int(np.argmax(gain if gain.any() else worth.sum(1)))
        chosen.append(best)
        shown = np.maximum(shown, worth[best])
        worth[best] = -1.0
    return [views[k] for k in sorted(chosen)]


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
