"""What both photos show at points of seams: patches, and colours at and beside the seam."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.workers import HERE, Workers
from skyquilt.imaging.nodes import View, inside, project_nodes
from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface
from skyquilt.ortho.compose import PhotoPixels
from skyquilt.ortho.exposure import Exposure, image_place
from skyquilt.ortho.patches import SIDE, grey_patches
from skyquilt.quality.seam_points import SeamPoint
from skyquilt.quality.seams import PatchPairs

PATCH = 5
"""Side in map px of the patches whose mean colours are compared."""
BESIDE = 30
"""Distance in map px of the places beside the seam."""
PLACES = np.array([(0, 0), (BESIDE, 0), (-BESIDE, 0), (0, BESIDE), (0, -BESIDE)])
"""(5, 2) places east and north of a point in map px whose colours are compared."""
XYZ = np.array(
    [(0.412453, 0.357580, 0.180423), (0.212671, 0.715160, 0.072169), (0.019334, 0.119193, 0.950227)]
)
"""(3, 3) X, Y and Z of linear sRGB values; white has the sums of its rows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeamViews:
    """What both photos show at n points of seams."""

    pairs: PatchPairs
    """Grey patches."""
    lab: NDArray[np.float64] | None
    """(2, n, 5, 3) CIE L*a*b* of the photos' sRGB values, balanced, before blending, at `PLACES`;
    NaN where a photo does not cover a place. None without an exposure.
    """


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """Cuts out what a photo shows at places."""

    surface: Surface
    """The ground."""
    pixels: PhotoPixels
    """Decodes photos."""
    exposure: Exposure | None
    """Balances their colours; None = no colours are asked for."""
    native_gsd: float
    """Side in m of a pixel of the grey patches."""
    gsd: float
    """Side in m of a map pixel."""

    def __call__(
        self, asked: tuple[View, NDArray[Any]]
    ) -> tuple[list[NDArray[np.float32] | None], NDArray[np.float64] | None]:
        """Patches and colours of a view around map points (n, 2) in m."""
        view, xy = asked
        patches = grey_patches(view, self.surface, self.pixels, xy, self.native_gsd)
        if self.exposure is None:
            return patches, None
        places = (xy[:, None] + PLACES * self.gsd).reshape(-1, 2)
        lab = _colours(view, self.surface, self.exposure, self.pixels, places, self.gsd)
        return patches, lab.reshape(len(xy), len(PLACES), 3)


def views_at(
    points: Sequence[SeamPoint],
    grid: Grid,
    views: Mapping[int, View],
    look: Look,
    workers: Workers = HERE,
) -> SeamViews:
    """What both photos show at seam points of a raster with a grid; `views`: by label.

    All places of a photo are taken together, so that it is decoded once.
    """
    xy = np.array([(grid.x(np.array(p.column)), grid.y(np.array(p.row))) for p in points])
    xy = xy.reshape(-1, 2)
    patches = np.zeros((2, len(points), SIDE, SIDE), np.float32)
    seen = np.zeros((2, len(points)), np.bool_)
    lab = np.full((2, len(points), len(PLACES), 3), np.nan)
    asked: dict[int, list[tuple[int, int]]] = {}
    for k, point in enumerate(points):
        for side, label in enumerate((point.a, point.b)):
            asked.setdefault(label, []).append((side, k))
    items = [(views[label], xy[[k for _, k in own]]) for label, own in asked.items()]
    for own, (cut, colours) in zip(asked.values(), workers.each(look, items), strict=True):
        for number, ((side, k), patch) in enumerate(zip(own, cut, strict=True)):
            if patch is not None:
                patches[side, k], seen[side, k] = patch, True
            if colours is not None:
                lab[side, k] = colours[number]
    pairs = PatchPairs(a=patches[0], b=patches[1], seen=np.asarray(seen.all(0)))
    return SeamViews(pairs=pairs, lab=None if look.exposure is None else lab)


def _colours(
    view: View,
    surface: Surface,
    exposure: Exposure,
    pixels: PhotoPixels,
    xy: NDArray[Any],
    gsd: float,
) -> NDArray[np.float64]:
    """(n, 3) mean L*a*b* of a photo around places (n, 2) in m; NaN where it does not cover them."""
    step = (np.arange(PATCH) - PATCH // 2) * gsd
    x = xy[:, 0, None] + np.tile(step, PATCH)
    y = xy[:, 1, None] - np.repeat(step, PATCH)
    n = project_nodes(view, x, y, surface.at(x, y))
    seen = np.asarray((inside(view.camera, n.u, n.v) & n.real).all(1))
    image = pixels(view.photo)
    value = cv2.remap(image, n.u, n.v, cv2.INTER_LINEAR).reshape(*n.u.shape, -1).astype(np.float32)
    if view.photo in exposure.gains:
        odds = exposure.odds(view.photo, *image_place(view, n.u, n.v))
        value = exposure.brightened(value, odds)
    rgb = np.broadcast_to(value[..., :3], (*n.u.shape, 3)).mean(1)
    return np.where(seen[:, None], lab_of(rgb / 255), np.nan)


def lab_of(rgb: NDArray[Any]) -> NDArray[np.float64]:
    """CIE L*a*b* (n, 3), D65, of sRGB values (n, 3) from 0 to 1. OpenCV first fills tables, which
    takes longer than all else that is measured of a small map.
    """
    rgb = np.asarray(rgb, np.float64)
    linear = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    share = linear @ (XYZ / XYZ.sum(1, keepdims=True)).T
    fx, fy, fz = np.where(share > 0.008856, np.cbrt(share), 7.787 * share + 16 / 116).T
    return np.stack([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)], 1)
