"""Which part of each photo a map shows: no more of it needs to be kept while the map is drawn, so
that photos are decoded once or twice where not all fit into memory.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.pixel_cache import Box
from skyquilt.imaging.nodes import STEP, View, projected
from skyquilt.model.surface import Surface
from skyquilt.ortho.compose import PIECE
from skyquilt.ortho.labels import Labels

SAMPLE_PX = 32
"""Map pixels between the places whose labels and heights are looked at."""
RING = 2
"""Such places around one that shows a photo, at which it may be drawn, too."""
RIM_PX = 8
"""Photo pixels around the part, which interpolation looks at."""
EAST, NORTH = np.array([-1, 1, -1, 1]), np.array([-1, -1, 1, 1])
"""Corners of a square."""


def shown_parts(
    labels: Labels, views: Sequence[View], surface: Surface, block: int
) -> dict[int, dict[tuple[int, int], Box]]:
    """What the blocks of a map, of `block` px, show of photos: by the photo's index, and by the
    first row and column of the block. Whole pieces, as they are drawn, at all their heights; strips
    narrower than `SAMPLE_PX` may be missed.
    """
    step = max(1, SAMPLE_PX // labels.factor)
    side = max(1, PIECE // (step * labels.factor))
    samples, pieces = labels.cells.coarser(step), labels.cells.coarser(step * side)
    x, y = samples.x(np.arange(samples.width)), samples.y(np.arange(samples.height))
    z = surface.at(*np.meshgrid(x, y))
    low, high = _lowest(z, side), -_lowest(-z, side)
    px = step * side * labels.factor
    reach = (0.5 + 1.5 * STEP / px) * pieces.gsd  # to the outermost nodes of a piece
    out: dict[int, dict[tuple[int, int], Box]] = {}
    for view, r, c in _shown_at(labels.photo[step // 2 :: step, step // 2 :: step], views):
        rows, columns = (
            np.clip(np.add.outer(at, (-RING, 0, RING)), 0, n - 1) // side
            for at, n in ((r, samples.height), (c, samples.width))
        )
        number = rows[:, :, None] * pieces.width + columns[:, None]
        r, c = np.divmod(np.unique(number), pieces.width)
        x, y = pieces.x(c)[:, None] + reach * EAST, pieces.y(r)[:, None] + reach * NORTH
        levels = np.stack([low[r, c], high[r, c]])[..., None]
        u, v, real = projected(view, *np.broadcast_arrays(x, y, levels))
        own = out.setdefault(view.photo, {})
        at = np.stack([r, c], 1) * px // block * block
        for row, column in np.unique(at, axis=0).tolist():
            here = (at == (row, column)).all(1)
            if (some := real[:, here]).any():
                own[row, column] = (
                    _span(v[:, here][some], view.camera.height),
                    _span(u[:, here][some], view.camera.width),
                )
    return out


def _lowest(z: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Minima of blocks of `side` rows and columns."""
    rows, columns = (np.arange(0, n, side) for n in z.shape)
    return np.asarray(np.minimum.reduceat(np.minimum.reduceat(z, rows, 0), columns, 1))


def _shown_at(
    photo: NDArray[np.int32], views: Sequence[View]
) -> Iterator[tuple[View, NDArray[np.intp], NDArray[np.intp]]]:
    """The views that an array of photos (h, w) shows anywhere, with the rows and columns of these
    places.
    """
    order = np.argsort(photo, axis=None, kind="stable")
    label, index = photo.ravel()[order], [v.photo for v in views]
    first, last = np.searchsorted(label, index), np.searchsorted(label, index, side="right")
    for view, start, stop in zip(views, first.tolist(), last.tolist(), strict=True):
        if stop > start:
            yield view, *np.divmod(order[start:stop], photo.shape[1])


def _span(at: NDArray[Any], size: int) -> slice:
    """The pixels, at least one of `size`, between places in a photo, and a rim."""
    start = int(np.clip(np.floor(at.min()) - RIM_PX, 0, size - 1))
    return slice(start, int(np.clip(np.ceil(at.max()) + RIM_PX + 1, start + 1, size)))
