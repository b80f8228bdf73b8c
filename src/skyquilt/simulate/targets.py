"""Targets of surveyors on the ground."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skyquilt.simulate import materials as m
from skyquilt.simulate.canvas import Canvas
from skyquilt.simulate.grid import Floats

_TILT = 20.0  # degrees: the quarters of a target are not aligned with the raster


@dataclass(frozen=True, kw_only=True)
class Target:
    """A disc of black and white quarters on the ground."""

    name: str
    """Label."""
    x: float
    """Map x of the centre, m (local)."""
    y: float
    """Map y of the centre, m (local)."""
    radius: float
    """m."""
    check: bool
    """True: a check point."""


def paint_targets(canvas: Canvas, targets: Sequence[Target]) -> None:
    """Paints discs of four quarters, anti-aliased, on the bare ground."""
    for target in targets:
        part = canvas.part(target.x, target.y, 1.4 * target.radius)
        if part.grid.width == 0 or part.grid.height == 0:
            continue
        a, b = part.local(target.x, target.y, _TILT)
        res = part.grid.res
        disc = np.clip((target.radius - np.hypot(a, b)) / res + 0.5, 0, 1)
        white = _step(a / res) * _step(b / res) + (1 - _step(a / res)) * (1 - _step(b / res))
        part.lay(m.TARGET_BLACK, disc)
        part.lay(m.TARGET_WHITE, disc * white)
        part.height[...] += (np.hypot(a, b) < 1.3 * target.radius) * (part.ground - part.height)


def _step(cells: Floats) -> Floats:
    return np.asarray(np.clip(cells + 0.5, 0, 1))
