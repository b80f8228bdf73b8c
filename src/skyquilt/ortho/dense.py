"""Heights at nearly every pixel, with gaps where pictures disagree: what tells one survey's place
on another's.

A surface for drawing fills its gaps and is smoothed, which moves the outlines of what stands up.
Here only what two pictures agree on counts, first coarsely over everything that may stand on the
ground, then at full sharpness.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from skyquilt.imaging.views import View
from skyquilt.model.raster import Grid
from skyquilt.model.surface import HeightField, Surface
from skyquilt.ortho.sweep import GreyPicture, Sweep


@dataclass(frozen=True, kw_only=True)
class Dense:
    """A coarse sweep that finds roofs and crowns, then a fine one about it, its heights left as
    they are.
    """

    coarse: Sweep = field(
        default_factory=lambda: Sweep(sides=(400,), above=0.2, smoothing_cells=0.7)
    )
    """Finds what stands up, to a fifth of the flying height."""
    fine: Sweep = field(default_factory=lambda: Sweep(window=7, agree=0.5))
    """Measures it."""
    longest: int = 1000
    """Longest side in px of the pictures that are measured in."""
    reach: float = 4.0
    """Px of disparity about the coarse surface."""
    version: ClassVar[int] = 1

    def __call__(
        self, surface: Surface, views: Sequence[View], grid: Grid, grey: GreyPicture
    ) -> HeightField | None:
        """The heights over a map's grid; None where fewer than two photos look down."""
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
