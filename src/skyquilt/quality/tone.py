"""How evenly the balanced photos show the same ground."""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import View, project_nodes
from skyquilt.model.surface import Surface
from skyquilt.ortho.exposure import Exposure, image_place

POINTS = 4000
"""Number of cells of ground that are compared."""
SIDE = 5
"""Side in thumbnail px of the window whose mean is a photo's value of a cell."""
CLIPPED = (6.0, 249.0)
"""Grey values beyond these are clipped and do not count."""


def tone_residual(
    views: Sequence[View],
    thumbnails: Mapping[int, NDArray[Any]],
    surface: Surface,
    bounds: tuple[float, float, float, float],
    exposure: Exposure,
) -> dict[str, float | int] | None:
    """Spread (standard deviation) of the balanced photos' means over cells of ground that several
    photos show: median and 95th percentile over the cells, in grey values or in the unit of
    measured values. None if no cell is shared.
    """
    west, south, east, north = bounds
    step = np.sqrt((east - west) * (north - south) / POINTS)
    x, y = np.meshgrid(np.arange(west, east, step), np.arange(south, north, step))
    z = surface.at(x, y)
    number, total, squares = (np.zeros(x.size) for _ in range(3))
    for view in views:
        if view.photo not in thumbnails:
            continue
        nodes = project_nodes(view, x, y, z)
        seen = np.flatnonzero((nodes.seen & nodes.real).ravel())
        if not len(seen):
            continue
        u, v = nodes.u.ravel()[seen], nodes.v.ravel()[seen]
        value, known = _values(thumbnails[view.photo], view, u, v, exposure)
        number[seen[known]] += 1
        total[seen[known]] += value[known]
        squares[seen[known]] += value[known] ** 2
    shared = number > 1
    if not shared.any():
        return None
    mean = total[shared] / number[shared]
    spread = np.sqrt(np.maximum(squares[shared] / number[shared] - mean**2, 0))
    return {
        "median": round(float(np.median(spread)), 3),
        "p95": round(float(np.percentile(spread, 95)), 3),
        "cells": int(shared.sum()),
    }


def _values(
    thumbnail: NDArray[Any], view: View, u: NDArray[Any], v: NDArray[Any], exposure: Exposure
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Balanced values (n,) of a photo at pixels, means over windows, and which of them count."""
    grey = thumbnail if thumbnail.ndim == 2 else thumbnail.reshape(*thumbnail.shape[:2], -1)
    if grey.ndim == 3:
        grey = cv2.cvtColor(grey, cv2.COLOR_RGB2GRAY) if grey.shape[2] == 3 else grey[..., 0]
    smooth = cv2.blur(grey.astype(np.float32), (SIDE, SIDE))
    h, w = smooth.shape
    column = np.clip(np.rint((u + 0.5) * w / view.camera.width - 0.5), 0, w - 1).astype(int)
    row = np.clip(np.rint((v + 0.5) * h / view.camera.height - 0.5), 0, h - 1).astype(int)
    value = smooth[row, column].astype(np.float64)
    if thumbnail.dtype.kind == "f":
        return value + exposure.offsets.get(view.photo, 0.0), np.isfinite(value)
    known = (value > CLIPPED[0] * exposure.level) & (value < CLIPPED[1] * exposure.level)
    if view.photo in exposure.gains:
        odds = exposure.odds(view.photo, *image_place(view, u[None], v[None]))[0].mean(-1)
        value = exposure.brightened(value, odds)
    return value / exposure.level, known
