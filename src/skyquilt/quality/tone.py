"""How evenly the balanced photos show the same ground."""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import View, even_places, project_nodes
from skyquilt.model.surface import Surface
from skyquilt.ortho.exposure import Exposure, image_place

POINTS = 4000
"""Number of cells of ground that are compared."""
SIDE = 5
"""Side in thumbnail px of the window whose mean is a photo's value of a cell."""
LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in a grey value (ITU-R BT.601)."""
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
    x, y, z = even_places(surface, bounds, POINTS)
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
    bands = thumbnail.reshape(*thumbnail.shape[:2], -1)
    bands = bands if bands.shape[2] == 3 else bands[..., :1]
    smooth = np.asarray(cv2.blur(bands.astype(np.float32), (SIDE, SIDE))).reshape(bands.shape)
    h, w = thumbnail.shape[:2]
    column = np.clip(np.rint((u + 0.5) * w / view.camera.width - 0.5), 0, w - 1).astype(int)
    row = np.clip(np.rint((v + 0.5) * h / view.camera.height - 0.5), 0, h - 1).astype(int)
    shown = smooth[row, column].astype(np.float64)
    value = _grey(shown)
    if thumbnail.dtype.kind == "f":
        return value + exposure.offsets.get(view.photo, 0.0), np.isfinite(value)
    known = (value > CLIPPED[0] * exposure.level) & (value < CLIPPED[1] * exposure.level)
    if view.photo in exposure.gains:
        odds = exposure.odds(view.photo, *image_place(view, u[None], v[None]))[0]
        odds = odds if odds.shape == shown.shape else odds.mean(-1, keepdims=True)
        value = _grey(exposure.brightened(shown, odds))
    return value / exposure.level, known


def _grey(bands: NDArray[np.float64]) -> NDArray[np.float64]:
    """Grey values (n,) of colours (n, 3), or of one band (n, 1)."""
    return np.asarray(bands @ LUMA if bands.shape[1] == 3 else bands[:, 0])
