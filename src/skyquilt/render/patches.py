"""Small orthorectified pieces of single photos."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.views import View, inside, project_nodes
from skyquilt.model.surface import Surface
from skyquilt.render.compose import PhotoPixels

SIDE = 64
"""Pixels of a patch's side."""
COARSE = 8
"""Pixels between exactly projected points of a patch."""


def grey_patch(
    view: View, surface: Surface, pixels: PhotoPixels, x: float, y: float, gsd: float, *, side: int = SIDE
) -> NDArray[np.float32] | None:
    """What a photo shows around map coordinates x, y in m: grey (side, side), north up;
    None if not all of it.
    """
    nodes = (np.arange(-1, side // COARSE + 1) + 0.5) * COARSE - side / 2
    gx, gy = np.meshgrid(x + nodes * gsd, y - nodes * gsd)
    n = project_nodes(view, gx, gy, surface.at(gx, gy))
    if not inside(view.camera, n.u, n.v).all():
        return None
    size = ((side // COARSE + 2) * COARSE,) * 2
    inner = slice(COARSE, COARSE + side)
    u, v = (cv2.resize(m, size, interpolation=cv2.INTER_LINEAR)[inner, inner] for m in (n.u, n.v))
    x0, y0 = int(u.min()) - 1, int(v.min()) - 1
    part = pixels(view.photo)[y0 : int(v.max()) + 3, x0 : int(u.max()) + 3]
    if part.ndim == 3:
        part = cv2.cvtColor(part, cv2.COLOR_RGB2GRAY) if part.shape[2] == 3 else part[..., 0]
    return np.asarray(
        cv2.remap(part.astype(np.float32), u - x0, v - y0, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    )


def grey_pairs(
    first: Sequence[View],
    second: Sequence[View],
    xy: NDArray,
    surface: Surface,
    pixels: PhotoPixels,
    gsd: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Patches (n, 64, 64) of two photos each around map points (n, 2), and whether both see them whole."""
    a = np.zeros((len(xy), SIDE, SIDE), np.float32)
    b = np.zeros_like(a)
    seen = np.zeros(len(xy), bool)
    for k, (one, other, (x, y)) in enumerate(zip(first, second, xy, strict=True)):
        pa = grey_patch(one, surface, pixels, float(x), float(y), gsd)
        pb = grey_patch(other, surface, pixels, float(x), float(y), gsd) if pa is not None else None
        if pa is not None and pb is not None:
            a[k], b[k], seen[k] = pa, pb, True
    return a, b, seen
