"""Which photo is shown in each cell of a map, and what that means for its pixels."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import STEP, densify
from skyquilt.model.raster import Grid, Window

Float = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class Labels:
    """Which photo is shown in each cell of the map."""

    cells: Grid
    """The cells."""
    factor: int
    """Map pixels along a side of a cell: 8, or a larger power of two."""
    photo: NDArray[np.int32]
    """(rows, columns) index of the photo, -1 = none."""
    hidden: Mask
    """(rows, columns) whether no photo sees the place: then the most vertical one is shown."""
    tall: Mask
    """(rows, columns) whether the place stands up from the bare ground."""

    def around(self, window: Window, ring: int) -> NDArray[np.int32]:
        """Labels of the cells of a window of the map, which starts at a cell's corner, and of a
        ring of cells around it; beyond the map those at its rim.
        """
        f, (rows, columns) = self.factor, self.photo.shape
        r, c = (
            np.arange(at // f - ring, -(-(at + size) // f) + ring)
            for at, size in ((window.row, window.height), (window.column, window.width))
        )
        return self.photo[np.clip(r, 0, rows - 1)][:, np.clip(c, 0, columns - 1)]

    def ring(self, width_px: float) -> int:
        """Cells beyond a seam that a ramp of a width in px can reach."""
        return 1 + int(np.ceil(width_px / self.factor / 2))

    def near(self, window: Window, width_px: float) -> dict[int, Mask]:
        """Photos that show in a window of the map, with ramps of a width in px, and where: (r + 2,
        c + 2) for its cells of STEP px with one ring around them.
        """
        # the ring of STEP cells in cells, and the reach of ramps beyond it
        more = max(STEP // self.factor, 1) + self.ring(width_px)
        labels = self.around(window, more)
        kernel = np.ones((2 * self.ring(width_px) + 1,) * 2, np.uint8)
        rows, columns = (-(-n // STEP) + 2 for n in (window.height, window.width))
        out = {}
        for photo in np.unique(labels[labels >= 0]).tolist():
            wide = cv2.dilate((labels == photo).view(np.uint8), kernel)
            mask = np.zeros((rows, columns), np.bool_)
            for r in (0.25, 0.75):
                for c in (0.25, 0.75):
                    i, j = (
                        np.clip(
                            more + np.floor((np.arange(n) - 1 + q) * STEP / self.factor), 0, m - 1
                        ).astype(np.intp)
                        for n, q, m in ((rows, r, wide.shape[0]), (columns, c, wide.shape[1]))
                    )
                    mask |= wide[i][:, j] > 0
            out[photo] = mask
        return out

    def share(self, photo: int, window: Window, width_px: float) -> Float:
        """(h, w) how much each pixel of a window belongs to a photo, 0 to 1: ramps across seams, of
        at least the width in px and at least a cell.
        """
        ring = self.ring(width_px)
        mine = (self.around(window, ring) == photo).astype(np.float32)
        if (side := self.ramp_cells(width_px)) > 1:
            mine = cv2.blur(mine, (side, side))
        inner = mine[ring - 1 : mine.shape[0] - ring + 1, ring - 1 : mine.shape[1] - ring + 1]
        return densify(np.ascontiguousarray(inner), window.height, window.width, self.factor)

    def ramp_cells(self, width_px: float) -> int:
        """Width in cells of the ramps of `share`: an odd number."""
        return 2 * round((width_px / self.factor - 1) / 2) + 1 if width_px > self.factor else 1

    def slope(self, width_px: float) -> float:
        """Change per px, across a seam, of the difference of two photos' shares."""
        return 2.0 / (self.factor * self.ramp_cells(width_px))
