"""Registration of two blocks by their ground heights [Yahyanejad 2013, 5.2.3, (5.8)].

The approximate transform is found from images of both surfaces, as for other images. The exact one
is found from heights that are measured again, as densely as the photos allow.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.heights import AlignHeights
from skyquilt.errors import PhotoFailedError
from skyquilt.model.raster import Grid
from skyquilt.model.registration import Matrix, RefusedRegistration, Registration
from skyquilt.model.surface import HeightField
from skyquilt.ortho.dense import Dense
from skyquilt.workflows.flow import Scene


def finer(
    visual: Scene,
    thermal: Scene,
    outcome: Registration,
    dense: Dense | None = None,
    align: AlignHeights | None = None,
) -> Registration | RefusedRegistration:
    """A registration of the maps (px of the visual to px of the thermal map) refined by heights, or
    the reason why heights do not confirm it.
    """
    fields = [_heights(scene, dense or Dense()) for scene in (visual, thermal)]
    if fields[0] is None or fields[1] is None:
        return RefusedRegistration(
            reason="fewer than two photos of a map look down, so heights cannot be measured"
        )
    metres = [_metres_of_px(scene.ground.grid) for scene in (visual, thermal)]
    start = metres[1] @ outcome.b_H_a @ np.linalg.inv(metres[0])
    fit = (align or AlignHeights())(fields[0], fields[1], start)
    if isinstance(fit, RefusedRegistration):
        return fit
    matrix = np.linalg.inv(metres[1]) @ fit.b_H_a @ metres[0]
    told = {
        "cells": float(fit.cells),
        "residual_m": round(fit.residual_m, 4),
        "halves_apart_m": round(fit.apart_m, 4),
    }
    return replace(
        outcome,
        model="similarity",
        b_H_a=matrix / matrix[2, 2],
        evidence={**outcome.evidence, **told},
    )


def _heights(scene: Scene, dense: Dense) -> HeightField | None:
    held = set(scene.aligned.alignment.held)
    views = [v for v in scene.ground.views if v.photo in held and v.pose.cam_H_map is None]
    while True:
        try:
            return dense(scene.ground.surface, views, scene.ground.grid, scene.aligned.grey)
        except PhotoFailedError as error:  # both maps are drawn: it tells no heights any more
            views = [v for v in views if scene.aligned.photos[v.photo].name != error.photo]


def _metres_of_px(grid: Grid) -> Matrix:
    """(3, 3) from px of a block's map to m in its frame."""
    x, y = (float(f(np.array(0))) for f in (grid.x, grid.y))
    found: NDArray[np.float64] = np.array([[grid.gsd, 0, x], [0, -grid.gsd, y], [0, 0, 1.0]])
    return found
