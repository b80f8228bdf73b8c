"""What meets the eye at the seams of a finished map: steps of colour, and objects that are cut."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import View, inside, project_nodes
from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface
from skyquilt.ortho.exposure import Exposure, image_place
from skyquilt.ortho.labels import Labels
from skyquilt.quality.seam_points import SeamPoint

PATCH = 5
"""Side in map px of the patches whose mean colours are compared."""
BESIDE = 30
"""Distance in map px of the places beside the seam."""
PhotoPixels = Callable[[int], NDArray[Any]]
"""Full-size pixels of a photo by its index."""


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


def seam_colours(
    points: Sequence[SeamPoint],
    grid: Grid,
    views: Mapping[int, View],
    surface: Surface,
    exposure: Exposure,
    pixels: PhotoPixels,
    gsd: float,
) -> SeamColours:
    """Colours of both photos at seam points of a raster with a grid, balanced, before blending.

    `views`: by label; `gsd`: side of a map pixel in m. Colours are CIE L*a*b*, of sRGB values.
    """
    xy = np.array([(grid.x(np.array(p.column)), grid.y(np.array(p.row))) for p in points])
    xy = xy.reshape(-1, 2)
    places = np.array([(0, 0), (BESIDE, 0), (-BESIDE, 0), (0, BESIDE), (0, -BESIDE)]) * gsd
    colour = np.full((2, len(points), len(places), 3), np.nan)
    for label in sorted({n for p in points for n in (p.a, p.b)}):
        asked = [
            (s, k) for k, p in enumerate(points) for s, n in ((0, p.a), (1, p.b)) if n == label
        ]
        at = np.array([k for _, k in asked])
        found = _colours(
            views[label], surface, exposure, pixels, (xy[at, None] + places).reshape(-1, 2), gsd
        )
        for (side, k), values in zip(asked, found.reshape(len(at), -1, 3), strict=True):
            colour[side, k] = values
    apart = np.linalg.norm(colour[0] - colour[1], axis=-1)
    with np.errstate(invalid="ignore"):
        number = np.isfinite(apart[:, 1:]).sum(1)
        beside = np.where(number > 0, np.nansum(apart[:, 1:], 1) / np.maximum(number, 1), np.nan)
    return SeamColours(at=apart[:, 0], beside=beside)


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
        value = 255 * odds * value / (255 + (odds - 1) * value)
    rgb = np.broadcast_to(value[..., :3], (*n.u.shape, 3)).mean(1)
    lab = cv2.cvtColor(np.asarray(rgb[None] / 255, np.float32), cv2.COLOR_RGB2LAB)[0]
    return np.where(seen[:, None], lab, np.nan).astype(np.float64)


def cut_objects(provenance: NDArray[Any], grid: Grid, labels: Labels) -> float | None:
    """Share of the length of all seams that lies on cells which stand up from the ground; None if
    there are no seams. `provenance` (H, W): the photo of each pixel of a grid, 0 = none.
    """
    total = over = 0
    row, column = labels.cells.nearest(grid)
    tall = labels.tall[row][:, column]
    for a, b, ta, tb in (
        (provenance[1:], provenance[:-1], tall[1:], tall[:-1]),
        (provenance[:, 1:], provenance[:, :-1], tall[:, 1:], tall[:, :-1]),
    ):
        edge = (a != b) & (a != 0) & (b != 0)
        total += int(edge.sum())
        over += int((edge & (ta | tb)).sum())
    return over / total if total else None
