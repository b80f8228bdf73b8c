"""Composition of a window of the map from the photos that see it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.views import STEP, Nodes, View, cut, densify, inside_everywhere, window_nodes
from skyquilt.model.raster import Grid, Window
from skyquilt.model.surface import Surface
from skyquilt.render.blend import Blend, Layer
from skyquilt.render.exposure import NEUTRAL, Exposure, image_place, with_odds

PhotoPixels = Callable[[int], NDArray]
"""Gives the full-size pixels (H, W[, bands]) of a photo by its index."""
PIECE = 512
"""Pixels of a piece composed at a time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Composed:
    """A window of the map."""

    pixels: NDArray
    """(h, w, bands)."""
    photo: NDArray[np.int32]
    """(h, w) index of the photo that leads each pixel, -1 = none."""
    views: NDArray[np.uint16]
    """(r, c) number of photos that see each STEP x STEP cell."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Composer:
    """Everything that composition needs, but the window."""

    grid: Grid
    """The map's grid."""
    views: Sequence[View]
    """Placed photos."""
    surface: Surface
    """Heights."""
    blend: Blend
    """Merge rule."""
    pixels: PhotoPixels
    """Source of photo pixels."""
    bands: int
    """Bands of the map."""
    dtype: np.dtype
    """Type of the map's pixels."""
    exposure: Exposure = NEUTRAL
    """Gains."""

    def __call__(self, window: Window) -> Composed:
        """The window, piece by piece."""
        out = np.full(
            (window.height, window.width, self.bands), np.nan if self.dtype.kind == "f" else 0, self.dtype
        )
        photo = np.full((window.height, window.width), -1, np.int32)
        margin = -(-self.blend.margin // STEP) * STEP
        wide = window.grown(margin)
        nodes = window_nodes(self.views, self.grid, self.surface, wide)
        for row in range(0, window.height, PIECE):
            for column in range(0, window.width, PIECE):
                h, w = min(PIECE, window.height - row), min(PIECE, window.width - column)
                piece = [cut(n, row, column, h + 2 * margin, w + 2 * margin) for n in nodes]
                merged = self._piece(piece, h + 2 * margin, w + 2 * margin)
                if merged is not None:
                    inner = (slice(margin, margin + h), slice(margin, margin + w))
                    out[row : row + h, column : column + w] = merged[0][inner]
                    photo[row : row + h, column : column + w] = merged[1][inner]
        return Composed(pixels=out, photo=photo, views=self._counted(nodes, margin, window))

    def _counted(self, nodes: Sequence[Nodes], margin: int, window: Window) -> NDArray[np.uint16]:
        rows, columns = -(-window.height // STEP), -(-window.width // STEP)
        count = np.zeros((rows, columns), np.uint16)
        k = margin // STEP
        for n in nodes:
            count += n.seen[k + 1 : k + 1 + rows, k + 1 : k + 1 + columns]
        return count

    def _piece(self, nodes: Sequence[Nodes], h: int, w: int) -> tuple[NDArray, NDArray[np.int32]] | None:
        chosen = self._needed(nodes)
        if not chosen:
            return None
        layers = [self._layer(n, h, w, alone=len(chosen) == 1) for n in chosen]
        return self.blend.merge(layers, self.grid.gsd)

    def _needed(self, nodes: Sequence[Nodes]) -> list[Nodes]:
        """The photos that can show in a piece, in order of capture."""
        seen = [n for n in nodes if n.seen.any()]
        if not seen:
            return []
        scores = [np.where(n.seen, n.score, np.float32(np.inf)) for n in seen]
        ranks = np.stack([self.blend.rank(k, score) for k, score in enumerate(scores)])
        height = min(n.height for n in seen)
        slack = self.blend.reach(self.grid.gsd) / max(height, 1e-3)
        # a node sees only itself: what is invisible at a node may win between it and the next one
        best = cv2.dilate(ranks.min(0), np.ones((3, 3), np.uint8)) if np.isfinite(slack) else np.inf
        near = np.stack([cv2.erode(r, np.ones((3, 3), np.uint8)) for r in ranks])
        return [n for n, r in zip(seen, near, strict=True) if (np.isfinite(r) & (r <= best + slack)).any()]

    def _layer(self, n: Nodes, h: int, w: int, *, alone: bool) -> Layer:
        """One photo over a piece."""
        u, v = densify(n.u, h, w), densify(n.v, h, w)
        image = self.pixels(n.view.photo)
        # a photo may see a node of the ring around the piece and nothing of the piece itself: a pixel is kept then
        x0 = min(max(int(u.min()) - 2, 0), image.shape[1] - 1)
        y0 = min(max(int(v.min()) - 2, 0), image.shape[0] - 1)
        x1, y1 = max(int(np.ceil(u.max())) + 3, 1), max(int(np.ceil(v.max())) + 3, 1)
        part = image[y0:y1, x0:x1]  # remap works in 16 bits: a cut-out keeps its coordinates small
        warped = cv2.remap(part, u - x0, v - y0, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        warped = warped.reshape(h, w, -1)
        score = np.zeros((h, w), np.float32) if alone else densify(n.score, h, w)
        if not n.seen.all():
            score = np.where(inside_everywhere(n, u, v), score, np.float32(np.inf))
        return Layer(
            photo=n.view.photo, pixels=self._exposed(n, u, v, warped), score=score,
            centre=(float(n.view.pose.map_C[0]), float(n.view.pose.map_C[1])), height=n.height,
        )  # fmt: skip

    def _exposed(self, n: Nodes, u: NDArray, v: NDArray, warped: NDArray) -> NDArray:
        photo = n.view.photo
        if photo in self.exposure.offsets and warped.dtype.kind == "f":
            return warped + np.float32(self.exposure.offsets[photo])
        if photo not in self.exposure.gains or warped.dtype != np.uint8:
            return warped
        if self.exposure.uneven(photo):
            odds = self.exposure.odds(photo, *image_place(n.view, n.u, n.v))
            return with_odds(warped, densify(odds, *warped.shape[:2]).reshape(warped.shape))
        table = self.exposure.table(photo)
        return warped if table is None else np.asarray(cv2.LUT(warped, table)).reshape(warped.shape)
