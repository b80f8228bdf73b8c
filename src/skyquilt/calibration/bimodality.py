"""How well black and white part in a cell [Yahyanejad 2013, (5.1), (5.2)]."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def bimodality(cell: NDArray[Any]) -> float:
    """phi of (5.1): spread of the pixels below the mean plus spread of those above it, over the
    squared distance of the two means. Low is well separated; infinite for a cell without contrast.
    Unit: 1 / unit of the cell.
    """
    values = np.asarray(cell, np.float64).ravel()
    values = values[np.isfinite(values)]
    if not values.size:
        return float("inf")
    middle = values.mean()
    below, above = values[values < middle], values[values > middle]
    if not below.size or not above.size:
        return float("inf")
    return float((below.std() + above.std()) / (below.mean() - above.mean()) ** 2)


def separation(image: NDArray[np.float32], cell_px: int) -> NDArray[np.float64]:
    """1 / phi (m, n) on overlapping cells of an image (H, W), `cell_px` wide at steps of half of
    it.

    phi is low where black and white part well, so its inverse is what a weight must grow with.
    """
    step = max(1, cell_px // 2)
    rows, columns = (max(1, 1 + (size - cell_px + step - 1) // step) for size in image.shape)
    out = np.zeros((rows, columns))
    for i, j in np.ndindex(rows, columns):
        top, left = (
            min(i * step, max(image.shape[0] - cell_px, 0)),
            min(j * step, max(image.shape[1] - cell_px, 0)),
        )
        phi = bimodality(image[top : top + cell_px, left : left + cell_px])
        out[i, j] = 1 / phi if phi > 0 else 0.0
    return out
