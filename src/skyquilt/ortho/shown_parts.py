"""Which part of each photo a map shows: no more of it needs to be kept while the map is drawn, so
that photos are decoded once or twice where not all fit into memory.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.pixel_cache import Box
from skyquilt.imaging.nodes import STEP, View, projected
from skyquilt.model.surface import Surface
from skyquilt.ortho.compose import PIECE
from skyquilt.ortho.labels import Labels

SHOWN_SAMPLE_PX = 32
"""Map pixels between the places whose labels and heights are looked at."""
SHOWN_REACH_PX = 64
"""Map pixels around a place that shows a photo over which it may be drawn, too."""
SHOWN_NODES_PX = 1.5 * STEP
"""Map pixels beyond a block at which photos are projected."""
SHOWN_RIM_PX = 8
"""Photo pixels around the part, which interpolation looks at."""


def shown_parts(
    labels: Labels, views: Sequence[View], surface: Surface, block: int
) -> dict[int, dict[tuple[int, int], Box]]:
    """What the blocks of a map, of `block` px, show of photos: by the photo's index, and by the
    first row and column of the block. Strips narrower than `SHOWN_SAMPLE_PX` may be missed.
    """
    step = max(1, SHOWN_SAMPLE_PX // labels.factor)
    side = max(1, PIECE // (step * labels.factor))
    samples, pieces = labels.cells.coarser(step), labels.cells.coarser(step * side)
    x, y = samples.x(np.arange(samples.width)), samples.y(np.arange(samples.height))
    z = surface.at(*np.meshgrid(x, y))
    # a piece is drawn over the rectangle of what it shows, and of the cells around
    around = np.ones((3, 3), np.uint8)
    levels = np.stack([cv2.erode(_lowest(z, side), around), -cv2.erode(_lowest(-z, side), around)])
    px = step * labels.factor
    reach = np.array([-SHOWN_REACH_PX, px + SHOWN_REACH_PX])
    out: dict[int, dict[tuple[int, int], Box]] = {}
    for view, r, c in _shown_at(labels.photo[step // 2 :: step, step // 2 :: step], views):
        piece = r // side * pieces.width + c // side
        order = np.argsort(piece, kind="stable")
        first = np.flatnonzero(np.diff(piece[order], prepend=-1))
        rows, columns = (  # first and last px of the map, by piece
            np.stack([end.reduceat(at[order], first) for end in (np.minimum, np.maximum)], 1) * px
            + reach
            for at in (r, c)
        )
        over = levels[:, *np.divmod(piece[order][first], pieces.width), None]
        own = out.setdefault(view.photo, {})
        for row, column in _blocks(rows, columns, block, samples.height * px, samples.width * px):
            y, x = (
                np.clip(at, corner - SHOWN_NODES_PX, corner + block + SHOWN_NODES_PX) / px - 0.5
                for at, corner in ((rows, row), (columns, column))
            )
            here = (y[:, 1] > y[:, 0]) & (x[:, 1] > x[:, 0])
            corners = samples.x(x[here][:, [0, 1, 0, 1]]), samples.y(y[here][:, [0, 0, 1, 1]])
            u, v, real = projected(view, *np.broadcast_arrays(*corners, over[:, here]))
            if real.any():
                own[row, column] = (
                    _span(v[real], view.camera.height),
                    _span(u[real], view.camera.width),
                )
    return out


def _blocks(
    rows: NDArray[Any], columns: NDArray[Any], block: int, height: int, width: int
) -> list[tuple[int, int]]:
    """First rows and columns of the blocks of a map (height, width) that rectangles touch, given by
    their first and last rows and columns (n, 2).
    """
    at = [
        np.clip(edges, 0, size - 1) // block * block
        for edges, size in ((rows, height), (columns, width))
    ]
    touched = [np.stack([at[0][:, i], at[1][:, j]], 1) for i in (0, 1) for j in (0, 1)]
    return [(r, c) for r, c in np.unique(np.concatenate(touched), axis=0).tolist()]


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
    start = int(np.clip(np.floor(at.min()) - SHOWN_RIM_PX, 0, size - 1))
    return slice(start, int(np.clip(np.ceil(at.max()) + SHOWN_RIM_PX + 1, start + 1, size)))
