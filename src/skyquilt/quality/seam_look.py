"""What meets the eye at the seams of a finished map: steps of colour, and objects that are cut."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.raster import Grid
from skyquilt.model.surface import STRIP
from skyquilt.ortho.labels import Labels


@dataclass(frozen=True, kw_only=True, eq=False)
class SeamColours:
    """Difference in colour (CIE 1976) of the two photos that meet at points of seams."""

    at: NDArray[np.float64]
    """(n,) at the seam; NaN where not both photos see it."""
    beside: NDArray[np.float64]
    """(n,) mean over the places beside it."""

    @property
    def figures(self) -> dict[str, Any]:
        """What metrics.json says."""
        at, beside = self.at[np.isfinite(self.at)], self.beside[np.isfinite(self.beside)]
        return {
            "median": _rounded(at, 50),
            "p95": _rounded(at, 95),
            "beside_median": _rounded(beside, 50),
            "beside_p95": _rounded(beside, 95),
            "measured": len(at),
        }


def _rounded(values: NDArray[Any], share: float) -> float | None:
    return round(float(np.percentile(values, share)), 3) if len(values) else None


def seam_colours(lab: NDArray[np.float64]) -> SeamColours:
    """Steps of colour between both photos (2, n, 5, 3), see `SeamViews.lab`."""
    apart = np.linalg.norm(lab[0] - lab[1], axis=-1)
    with np.errstate(invalid="ignore"):
        number = np.isfinite(apart[:, 1:]).sum(1)
        beside = np.where(number > 0, np.nansum(apart[:, 1:], 1) / np.maximum(number, 1), np.nan)
    return SeamColours(at=apart[:, 0], beside=beside)


def cut_objects(provenance: NDArray[Any], grid: Grid, labels: Labels) -> float | None:
    """Share of the length of all seams that lies on cells which stand up from the ground; None if
    there are no seams. `provenance` (H, W): the photo of each pixel of a grid, 0 = none.
    """
    total = over = 0
    row, column = labels.cells.nearest(grid)
    for first in range(0, len(provenance), STRIP):  # masks of large maps would fill the memory
        here, rows = provenance[first : first + STRIP + 1], row[first : first + STRIP + 1]
        tall = labels.tall[rows][:, column]
        for a, b, ta, tb in (
            (here[1:], here[:-1], tall[1:], tall[:-1]),
            (here[:STRIP, 1:], here[:STRIP, :-1], tall[:STRIP, 1:], tall[:STRIP, :-1]),
        ):
            edge = (a != b) & (a != 0) & (b != 0)
            total += int(edge.sum())
            over += int((edge & (ta | tb)).sum())
    return over / total if total else None
