"""The height surface that photos are orthorectified over."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Heights on a regular grid in the map frame; row 0 is the southernmost."""

    z: NDArray[np.float32]
    """(rows, cols) heights in m above the frame's vertical datum, no gaps."""
    x0: float
    """Easting of column 0 in m (map frame)."""
    y0: float
    """Northing of row 0 in m (map frame)."""
    cell: float
    """Spacing in m."""
    source: str
    """What it was made from: `tie points` or `plane`."""

    def at(self, x: NDArray, y: NDArray) -> NDArray[np.float32]:
        """Heights in m at map coordinates of any shape, bilinear; the rim is continued outwards."""
        shape = np.shape(x)
        column = ((np.asarray(x) - self.x0) / self.cell).astype(np.float32)
        row = ((np.asarray(y) - self.y0) / self.cell).astype(np.float32)
        if column.ndim != 2:
            column, row = column.reshape(1, -1), row.reshape(1, -1)
        parts = []
        for k in range(0, column.shape[1], 30000):  # remap's maps must stay below 32768 columns
            parts.append(
                cv2.remap(
                    self.z,
                    column[:, k : k + 30000],
                    row[:, k : k + 30000],
                    cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE,
                )
            )
        return np.concatenate(parts, 1, dtype=np.float32).reshape(shape)
