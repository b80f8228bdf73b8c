"""Dense heights with gaps where images disagree, for the registration of one survey to another.

A surface for the orthomosaic is smoothed and has no gaps, which moves the outlines of buildings and
trees. Here only heights on which two images agree are used: first from a coarse search over a large
height range, then from a fine one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from skyquilt.imaging.nodes import View
from skyquilt.model.raster import Grid
from skyquilt.model.surface import HeightField, Surface
from skyquilt.ortho.sweep import GreyPicture, Sweep


@dataclass(frozen=True, kw_only=True)
class Dense:
    """A coarse sweep that finds roofs and tree crowns, then a fine one around it whose heights are
    not smoothed.
    """

    coarse: Sweep = field(
        default_factory=lambda: Sweep(sides=(400,), above=0.2, smoothing_cells=0.7)
    )
    """Finds objects up to a fifth of the flying height."""
    fine: Sweep = field(default_factory=lambda: Sweep(window=7, agree=0.5))
    """Refines the heights."""
    longest: int = 1000
    """Longest side in px of the images used for the fine sweep."""
    reach: float = 4.0
    """Search range around the coarse surface in px of disparity."""
    version: ClassVar[int] = 1

    def __call__(
        self, surface: Surface, views: Sequence[View], grid: Grid, grey: GreyPicture
    ) -> HeightField | None:
        """The heights on a map's grid; None if fewer than two photos look down."""
        height = float(np.median([v.pose.map_C[2] for v in views] or [0.0]) - np.median(surface.z))
        if len(views) < 2 or height <= 0:
            return None
        rough = self.coarse(surface, views, grid, grey)
        longest = [max(v.camera.width, v.camera.height) for v in views]
        side = int(min(self.longest, np.median(longest)))
        gsd = (
            float(
                np.median(
                    [height / v.camera.focal * n for v, n in zip(views, longest, strict=True)]
                )
            )
            / side
        )
        work, z, trust = self.fine.searched(
            rough, views, grid, grey, side, gsd, height, (-self.reach, self.reach), relative=True
        )
        return HeightField(
            z=np.ascontiguousarray(z[::-1]),
            known=np.ascontiguousarray(trust[::-1] > 0),
            x0=float(work.x(np.array(0))),
            y0=float(work.y(np.array(work.height - 1))),
            cell=gsd,
        )
