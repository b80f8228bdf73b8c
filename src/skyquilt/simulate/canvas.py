"""A block of the terrain during painting."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.simulate.grid import Doubles, Floats, Grid
from skyquilt.simulate.materials import Material
from skyquilt.simulate.noise import Noise
from skyquilt.simulate.weather import Weather

WARM_K = np.float32(1.5)
"""Temperature difference in K of a surface twice as bright as its material."""
_SHIFT = 4  # fractional bits of polygon vertices


@dataclass(frozen=True, kw_only=True, eq=False)
class Canvas:
    """Arrays that painters write into; the record itself does not change."""

    grid: Grid
    """Position of the block."""
    look: Floats
    """(h, w, 4) red, green, blue in 0-255 and temperature in degrees Celsius, all before light and
    shadow.
    """
    height: Floats
    """(h, w) surface above the base, m."""
    ground: Floats
    """(h, w) bare ground above the base, m; must not be written to."""
    noise: Noise
    """Noise of the scene."""
    weather: Weather
    """Weather of the scene."""

    @cached_property
    def grain(self) -> Floats:
        """White noise per cell, slightly smoothed."""
        return np.asarray(
            cv2.GaussianBlur(self.noise.grain(self.grid, 5), (0, 0), 0.6)
        ) * np.float32(1.9)

    @cached_property
    def fine(self) -> Floats:
        """Noise with wavelengths from a few cells to half a metre: tufts and clods."""
        return self.noise.fractal(self.grid, 0.5, 0.12, 0.8, 6)

    @cached_property
    def patchy(self) -> Floats:
        """Noise with wavelengths of one to several metres: patches."""
        return self.noise.fractal(self.grid, 4.0, 0.9, 0.7, 7)

    @cached_property
    def broad(self) -> Floats:
        """Noise with wavelengths of tens of metres."""
        return self.noise.fractal(self.grid, 45.0, 11.0, 0.7, 8)

    def polygon(self, outline: Doubles) -> Floats:
        """Coverage (h, w) of a map polygon, 0-1, with soft edges."""
        mask = np.zeros(self.height.shape, dtype=np.uint8)
        cv2.fillPoly(mask, [self._fixed(outline)], 255, cv2.LINE_AA, _SHIFT)
        return mask.astype(np.float32) / np.float32(255)

    def line(self, lines: Doubles | list[Doubles], width: float) -> Floats:
        """Coverage (h, w) of map polylines, with a width in m."""
        mask = np.zeros(self.height.shape, dtype=np.uint8)
        thick = max(1, round(width / self.grid.res))
        fixed = [self._fixed(line) for line in (lines if isinstance(lines, list) else [lines])]
        cv2.polylines(mask, fixed, False, 255, thick, cv2.LINE_AA, _SHIFT)
        return mask.astype(np.float32) / np.float32(255)

    def touches(self, points: Doubles, margin: float) -> bool:
        """Whether the bounding box of map points is within `margin` m of the block."""
        if self.grid.width == 0 or self.grid.height == 0:
            return False
        low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
        x0, x1, y0, y1 = self.grid.span
        return bool(low[0] <= x1 and high[0] >= x0 and low[1] <= y0 and high[1] >= y1)

    def near(self, places: Doubles, reach: float) -> NDArray[np.bool_]:
        """(n,) which of map points (n, 2) may have cells of the block within `reach` m; some have
        none.
        """
        x0, x1, y0, y1 = self.grid.span
        far = reach + 4 * self.grid.res
        x, y = places[:, 0], places[:, 1]
        return np.asarray((x > x0 - far) & (x < x1 + far) & (y > y1 - far) & (y < y0 + far))

    def part(self, x: float, y: float, reach: float) -> "Canvas":
        """A canvas with views of the cells within `reach` m of a map point; may be empty."""
        grid = self.grid.around(x, y, reach)
        at = self.grid.inside(grid)
        part = Canvas(
            grid=grid,
            look=self.look[at],
            height=self.height[at],
            ground=self.ground[at],
            noise=self.noise,
            weather=self.weather,
        )
        for name in ("grain", "fine", "patchy", "broad"):
            part.__dict__[name] = getattr(self, name)[at]
        return part

    def local(self, x: float, y: float, angle_deg: float) -> tuple[Floats, Floats]:
        """Coordinates (h, w) in m along and across a direction (degrees from map x) about a map
        point.
        """
        c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
        dx = (self.grid.xs - x).astype(np.float32)[None, :]
        dy = (self.grid.ys - y).astype(np.float32)[:, None]
        return np.float32(c) * dx + np.float32(s) * dy, np.float32(c) * dy - np.float32(s) * dx

    def lay(
        self, material: Material, cover: Floats | NDArray[np.bool_], texture: Floats | float = 0.0
    ) -> None:
        """Paints a material where `cover` (h, w, 0-1) is above 0; `texture` is a relative change of
        brightness.
        """
        cells = self.cells(cover > 0)
        cells.lay(
            material,
            cover[cells.at].astype(np.float32),
            texture[cells.at] if isinstance(texture, np.ndarray) else np.float32(texture),
        )

    def cells(self, where: NDArray[np.bool_]) -> "Cells":
        """Some of the block's cells."""
        return Cells(canvas=self, at=np.unravel_index(np.flatnonzero(where), where.shape))

    def _fixed(self, points: Doubles) -> NDArray[np.int32]:
        pixels = np.clip(self.grid.pixels(points), -30000, 30000)
        return np.asarray(np.round(pixels * 2**_SHIFT).astype(np.int32))


@dataclass(frozen=True, kw_only=True, eq=False)
class Cells:
    """Some cells of a block as lists (n,): strips cover little of it, and cost what they cover."""

    canvas: Canvas
    """The block."""
    at: tuple[NDArray[np.intp], ...]
    """Rows and columns (n,) of the cells."""

    @cached_property
    def grain(self) -> Floats:
        """(n,) as the canvas's, like all that follow."""
        return np.asarray(self.canvas.grain[self.at])

    @cached_property
    def fine(self) -> Floats:
        """(n,)."""
        return np.asarray(self.canvas.fine[self.at])

    @cached_property
    def patchy(self) -> Floats:
        """(n,)."""
        return np.asarray(self.canvas.patchy[self.at])

    @cached_property
    def broad(self) -> Floats:
        """(n,)."""
        return np.asarray(self.canvas.broad[self.at])

    def lay(self, material: Material, share: Floats, texture: Floats | np.float32) -> None:
        """Paints a material that covers shares (n,) of the cells; `texture` as for `Canvas.lay`."""
        colour = material.look(self.canvas.weather)
        old = self.canvas.look[self.at]
        for band in range(4):
            new = colour[band] * (1 + texture) if band < 3 else colour[band] + WARM_K * texture
            old[:, band] += share * (new - old[:, band])
        self.canvas.look[self.at] = old

    def flatten(self, share: Floats) -> None:
        """Brings the surface down to the bare ground by shares (n,) of its height."""
        height = self.canvas.height[self.at]
        self.canvas.height[self.at] = height + share * (self.canvas.ground[self.at] - height)
