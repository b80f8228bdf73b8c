"""Small orthorectified pieces of single photos."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import View, inside, project_nodes
from skyquilt.model.surface import Surface
from skyquilt.ortho.compose import PhotoPixels

SIDE = 64
"""Pixels of a patch's side."""
COARSE = 8
"""Pixels between exactly projected points of a patch."""


def grey_patches(
    view: View,
    surface: Surface,
    pixels: PhotoPixels,
    xy: NDArray[Any],
    gsd: float,
    *,
    side: int = SIDE,
) -> list[NDArray[np.float32] | None]:
    """Orthorectified grey patches (side, side) of a photo around map points xy (n, 2) in m, north
    up; None where the photo does not cover the whole patch.
    """
    nodes = (np.arange(-1, side // COARSE + 1) + 0.5) * COARSE - side / 2
    shape = (len(xy), len(nodes), len(nodes))
    gx = np.broadcast_to(xy[:, 0, None, None] + nodes * gsd, shape)
    gy = np.broadcast_to(xy[:, 1, None, None] - nodes[:, None] * gsd, shape)
    n = project_nodes(view, gx, gy, surface.at(gx, gy))
    whole = np.asarray(inside(view.camera, n.u, n.v).all((1, 2)))
    return [
        _cut_out(view, pixels, n.u[k], n.v[k], side) if whole[k] else None for k in range(len(xy))
    ]


def _cut_out(
    view: View, pixels: PhotoPixels, nu: NDArray[Any], nv: NDArray[Any], side: int
) -> NDArray[np.float32]:
    """The grey patch (side, side) with its nodes at these photo pixels."""
    size = ((side // COARSE + 2) * COARSE,) * 2
    inner = slice(COARSE, COARSE + side)
    u, v = (cv2.resize(m, size, interpolation=cv2.INTER_LINEAR)[inner, inner] for m in (nu, nv))
    x0, y0 = int(u.min()) - 1, int(v.min()) - 1
    part = pixels(view.photo)[y0 : int(v.max()) + 3, x0 : int(u.max()) + 3]
    if part.ndim == 3:
        part = cv2.cvtColor(part, cv2.COLOR_RGB2GRAY) if part.shape[2] == 3 else part[..., 0]
    return np.asarray(
        cv2.remap(
            part.astype(np.float32),
            u - x0,
            v - y0,
            cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )
