"""Additional rasters of a map: the source photo of each place, the number of photos that cover it,
and a preview.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.grey import averaged
from skyquilt.imaging.nodes import STEP
from skyquilt.model.poses import Alignment
from skyquilt.model.raster import Grid
from skyquilt.ortho.compose import Composed, Composer

PROVENANCE = 4
"""Map pixels per provenance pixel, along a side; more for large maps, see `provenance_step`."""
MOST_NUMBERS = 6e7
"""Most pixels of a provenance raster: it is in memory as a whole."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockExtras:
    """Data of a map block for the additional rasters."""

    provenance: NDArray[np.uint32]
    """Shot numbers from 1, 0 = none, every `provenance_step`-th pixel."""
    views: NDArray[np.uint16]
    """Number of photos that cover each STEP-pixel cell."""
    preview: NDArray[Any]
    """(h, w, bands) the block, area-averaged to every `preview_factor`-th pixel."""
    shown: NDArray[np.uint8]
    """(h, w) opacity of the preview, 0 to 255."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """The additional rasters of a finished map."""

    provenance: NDArray[np.uint32]
    """As in provenance.tif."""
    provenance_grid: Grid
    """Its grid."""
    views: NDArray[np.uint16]
    """As in views.tif."""
    views_grid: Grid
    """Its grid."""
    preview: NDArray[np.uint8]
    """(h, w, 4) the map, reduced, RGBA."""
    preview_grid: Grid
    """Its grid."""
    preview_range: tuple[float, float] | None
    """Values of the first and the last colour of the preview; None for photos."""


def shot_numbers(compose: Composer) -> NDArray[np.uint32]:
    """Number of each photo in shots.geojson. The last entry is 0, so that index -1 (no photo) gives
    0.
    """
    number = {v.photo: k + 1 for k, v in enumerate(sorted(compose.views, key=lambda v: v.photo))}
    table = np.zeros(max(number) + 2, np.uint32)
    table[list(number)] = list(number.values())
    return table


def provenance_step(grid: Grid) -> int:
    """Map pixels per provenance pixel, along a side: `PROVENANCE`, doubled until no more than
    `MOST_NUMBERS` pixels are left.
    """
    step = PROVENANCE
    while grid.width * grid.height / step**2 > MOST_NUMBERS:
        step *= 2
    return step


def extras_of(
    composed: Composed, valid: NDArray[np.bool_], table: NDArray[np.uint32], grid: Grid
) -> BlockExtras:
    """The additional data of a composed block of a map on a grid; `table`: shot numbers by
    photo.
    """
    step = provenance_step(grid)
    preview, shown = reduced(composed.pixels, valid, preview_factor(grid))
    numbers = table[np.where(_thinned(valid, step), _thinned(composed.photo, step), -1)]
    return BlockExtras(provenance=numbers, views=composed.views, preview=preview, shown=shown)


def _thinned(numbers: NDArray[Any], step: int) -> NDArray[Any]:
    """Every `step`-th pixel in both directions, taken at the middle of its cell."""
    rows, columns = (
        np.minimum(np.arange(step // 2, size + step // 2, step), size - 1) for size in numbers.shape
    )
    return np.asarray(numbers[rows][:, columns])


def preview_factor(grid: Grid) -> int:
    """Map pixels per preview pixel: a power of two that brings the longest side to 1600 px or
    less.
    """
    factor = 1
    while max(grid.width, grid.height) / factor > 1600 and factor < 2048:
        factor *= 2
    return factor


def reduced(
    pixels: NDArray[Any], valid: NDArray[np.bool_], factor: int
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Area averages of the valid pixels (h, w, bands), and how much of each cell is valid (0 to
    255).
    """
    opaque = valid.view(np.uint8) * np.uint8(255)
    size = (-(-pixels.shape[1] // factor), -(-pixels.shape[0] // factor))
    share = np.asarray(averaged(opaque, size), np.uint8)
    solid = np.nan_to_num(pixels) if pixels.dtype.kind == "f" else pixels
    mean = averaged(solid, size).reshape(*share.shape, -1)
    partly = (share > 0) & (share < 255)  # invalid pixels are zero: divide by the valid share
    if partly.any():
        whole = mean[partly].astype(np.float32) * (255.0 / share[partly])[:, None]
        mean = mean.copy()  # at a factor of 1 it shares its memory with the pixels
        mean[partly] = np.minimum(whole, 255) if pixels.dtype == np.uint8 else whole
    return mean, share


def coloured(preview: NDArray[Any], shown: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """RGBA (h, w, 4) of a preview: photos unchanged, measured values in the colour map inferno."""
    if preview.dtype == np.uint8 and preview.shape[2] == 3:
        return np.dstack([preview, shown])
    value = preview[..., 0].astype(np.float32)
    low, high = colour_range(preview, shown)
    index = np.clip((value - low) / max(float(high - low), 1e-6) * 255, 0, 255).astype(np.uint8)
    if preview.dtype == np.uint8:
        return np.dstack([preview[..., :1]] * 3 + [shown])
    return np.dstack([cv2.applyColorMap(index, cv2.COLORMAP_INFERNO)[..., ::-1], shown])


def colour_range(preview: NDArray[Any], shown: NDArray[np.uint8]) -> tuple[float, float]:
    """Values of the first and the last colour of measured values: their 1st and 99th percentile."""
    seen = preview[..., 0].astype(np.float32)[shown > 127]
    low, high = np.percentile(seen, [1, 99]) if seen.size else (0.0, 1.0)
    return float(low), float(high)


class Companions:
    """Provenance, views and preview, assembled from blocks."""

    def __init__(self, grid: Grid, bands: int, dtype: np.dtype, photos: int) -> None:
        self.grid, self.factor = grid, preview_factor(grid)
        self._step = provenance_step(grid)
        self.fine, self.coarse, small = (
            grid.coarser(self._step),
            grid.coarser(STEP),
            grid.coarser(self.factor),
        )
        numbers = np.uint16 if photos < 2**16 else np.uint32
        self.provenance = np.zeros((self.fine.height, self.fine.width), numbers)
        self.views = np.zeros((self.coarse.height, self.coarse.width), np.uint16)
        self.preview = np.zeros((small.height, small.width, bands), dtype)
        self.shown = np.zeros((small.height, small.width), np.uint8)

    def add(self, row: int, column: int, extras: BlockExtras) -> None:
        """Inserts the data of a block whose first pixel is at (row, column) of the map."""
        for target, part, step in (
            (self.provenance, extras.provenance, self._step),
            (self.views, extras.views, STEP),
            (self.preview, extras.preview, self.factor),
            (self.shown, extras.shown, self.factor),
        ):
            r, c = row // step, column // step
            target[r : r + part.shape[0], c : c + part.shape[1]] = part


def geotransform(
    grid: Grid, alignment: Alignment
) -> tuple[float, float, float, float, float, float]:
    """The six numbers of a north-up raster in the output CRS."""
    x, y = alignment.frame.origin
    return grid.gsd, 0.0, grid.west + x, 0.0, -grid.gsd, grid.north + y
