"""The whole terrain as rasters: colours and temperatures under sunlight, and surface heights."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.simulate.canvas import Canvas
from skyquilt.simulate.fields import (
    paint_borders,
    paint_parcels,
    paint_ponds,
    paint_roads,
    paint_shape,
)
from skyquilt.simulate.grid import Floats, Grid
from skyquilt.simulate.ground import Ground
from skyquilt.simulate.landscape import landscape
from skyquilt.simulate.layout import Layout
from skyquilt.simulate.light import lit, shadow_reach, shine
from skyquilt.simulate.noise import Noise
from skyquilt.simulate.panels import paint_panels
from skyquilt.simulate.targets import Target, paint_targets
from skyquilt.simulate.terrain import Terrain
from skyquilt.simulate.things import paint_things
from skyquilt.simulate.weather import Weather

_BLOCK = 1536
_IN_MEMORY = 60_000_000  # cells; larger scenes are kept in files


@dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """Settings of the terrain."""

    kind: Terrain = "landscape"
    """What the land is like; `simulate.terrain` describes the kinds."""
    relief: float = 6.0
    """Height between low and high places of a site, m."""
    base: float = 440.0
    """Height of the base level above the sea, m."""
    latitude: float = 46.6
    """Latitude of the map origin, degrees."""
    longitude: float = 14.3
    """Longitude of the map origin, degrees."""
    square: float = 2.0
    """Side of a chess-board square, m."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Rasters of the terrain; row 0, column 0 of the arrays is that of the grid."""

    grid: Grid
    """Position and cell size."""
    height: Floats
    """(h, w) surface with houses and trees, m above the base."""
    rgb: NDArray[np.uint8]
    """(h, w, 3) the true orthophoto."""
    thermal: NDArray[np.uint16] | None
    """(h, w) apparent temperature in hundredths of a kelvin."""
    look: NDArray[np.float16] | None = None
    """(h, w, 4) colours and temperatures without sunlight, where other hours will be wanted."""
    water: float | None = None
    """Level of water whose waves move, m above the base; None: there is none."""

    def at_hour(self, part: Grid, weather: Weather) -> NDArray[np.uint8]:
        """Colours (h, w, 3) of a part under the sunlight of another moment.

        Raises ValueError where the scene was drawn without `look`.
        """
        if self.look is None:
            raise ValueError("the scene was drawn for one moment only")
        lighted = _lighted(self, self.look, part, weather, flat=False)
        return np.asarray(np.clip(lighted[..., :3] + 0.5, 0, 255), np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class Country:
    """The terrain before it is drawn: cheap to compute, and exact at any point."""

    settings: SceneSettings
    """Its settings."""
    bounds: tuple[float, float, float, float]
    """x0, y0, x1, y1 in the local map frame, m."""
    seed: int
    """Equal seeds give equal terrain."""
    targets: tuple[Target, ...] = field(default=())
    """Targets of control points on the ground."""

    @cached_property
    def layout(self) -> Layout:
        """Parcels, roads and objects."""
        if self.settings.kind == "chessboard":
            return Layout()
        return landscape(self.bounds, self.seed, self.settings.kind).on(self._land.stands)

    @cached_property
    def noise(self) -> Noise:
        """The noise of the terrain."""
        return Noise(seed=self.seed)

    @cached_property
    def ground(self) -> Ground:
        """The bare ground."""
        return replace(self._land, shores=self.layout.ponds)

    @cached_property
    def _land(self) -> Ground:
        """The ground without ponds."""
        return Ground(noise=self.noise, relief=self.settings.relief, kind=self.settings.kind)

    def grid(self, res: float) -> Grid:
        """The raster over the bounds; its corner is at a multiple of the cell size."""
        x0, y0, x1, y1 = self.bounds
        left, top = np.floor(x0 / res) * res, np.ceil(y1 / res) * res
        width, height = int(np.ceil((x1 - left) / res)), int(np.ceil((top - y0) / res))
        return Grid(left=float(left), top=float(top), res=res, width=width, height=height)

    def paint(self, grid: Grid, weather: Weather) -> Canvas:
        """Paints one block without sunlight."""
        ground = self.ground.heights(grid)
        look = np.zeros((grid.height, grid.width, 4), dtype=np.float32)
        canvas = Canvas(
            grid=grid,
            look=look,
            height=ground.copy(),
            ground=ground,
            noise=self.noise,
            weather=weather,
        )
        if self.settings.kind == "chessboard":
            _paint_squares(canvas, self.settings.square)
        else:
            canvas.height[...] += (
                np.float32(0.035) * canvas.patchy + np.float32(0.012) * canvas.fine
            )
            paint_parcels(canvas, self.layout)
            paint_borders(canvas, self.layout)
            paint_roads(canvas, self.layout)
            paint_ponds(canvas, self.layout)
            paint_shape(canvas, self.settings.kind)
            paint_panels(canvas, self.layout)
            paint_things(canvas, self.layout, self.ground)
        paint_targets(canvas, self.targets)
        return canvas

    def draw(
        self, scene: Scene, weather: Weather, *, scratch: Path, done: int = 0
    ) -> Iterator[tuple[int, int]]:
        """Fills a scene, first its surfaces, then their light, block by block; yields (done,
        total). `done`: steps of it that are done already, for a scene that has its `look`.
        """
        looks = scene.look
        if looks is None:
            looks = _room(scene.grid, (4,), np.float16, scratch / "look")
        scene, total = replace(scene, look=looks), 2 * self.blocks(scene)
        for step in range(done, total):
            self.draw_step(scene, weather, step)
            yield step + 1, total

    def blocks(self, scene: Scene) -> int:
        """Number of blocks in which a scene is drawn, each in two steps."""
        return len(scene.grid.blocks(_BLOCK))

    def draw_step(self, scene: Scene, weather: Weather, step: int) -> None:
        """Draws one block: its surface or, when all surfaces are drawn, its light. Steps of the
        same half may be done in any order.

        Raises ValueError for a scene without `look`.
        """
        if scene.look is None:
            raise ValueError("surfaces need a place for their look until light falls on them")
        blocks = scene.grid.blocks(_BLOCK)
        block = blocks[step % len(blocks)]
        if step < len(blocks):
            canvas = self.paint(block, weather)
            scene.height[block.slices], scene.look[block.slices] = canvas.height, canvas.look
        else:
            _light(scene, scene.look, block, weather, flat=self.settings.kind == "chessboard")


def empty_scene(
    grid: Grid, *, thermal: bool, scratch: Path, hours: bool = False, water: float | None = None
) -> Scene:
    """Allocates a scene, in memory or in files below `scratch`; `hours`: for several moments,
    `water`: level of water with waves, m above the base.
    """
    return Scene(
        grid=grid,
        height=_room(grid, (), np.float32, scratch / "height"),
        rgb=_room(grid, (3,), np.uint8, scratch / "rgb"),
        thermal=_room(grid, (), np.uint16, scratch / "thermal") if thermal else None,
        look=_room(grid, (4,), np.float16, scratch / "look") if hours else None,
        water=water,
    )


def _light(
    scene: Scene, looks: NDArray[np.float16], block: Grid, weather: Weather, *, flat: bool
) -> None:
    """Computes the light of one block."""
    out = _lighted(scene, looks, block, weather, flat=flat)
    scene.rgb[block.slices] = np.clip(out[..., :3] + 0.5, 0, 255).astype(np.uint8)
    if scene.thermal is not None:
        kelvin = cv2.GaussianBlur(out[..., 3], (0, 0), 0.12 / scene.grid.res) + 273.15
        scene.thermal[block.slices] = np.clip(kelvin * 100 + 0.5, 0, 65535).astype(np.uint16)


def _lighted(
    scene: Scene, looks: NDArray[np.float16], block: Grid, weather: Weather, *, flat: bool
) -> Floats:
    """(h, w, 4) colours and temperatures of one block under sunlight, shadows from outside
    included.
    """
    margin = int(np.ceil(shadow_reach(weather) / scene.grid.res)) + 4
    wide = scene.grid.window(
        block.row - margin, block.col - margin, block.height + 2 * margin, block.width + 2 * margin
    )
    look = looks[block.slices].astype(np.float32)
    if flat:
        direct = np.ones(look.shape[:2], dtype=np.float32)
    else:
        direct = lit(scene.height[wide.slices], scene.grid.res, weather)[wide.inside(block)]
    return shine(look, direct, weather)


def _paint_squares(canvas: Canvas, square: float) -> None:
    """Paints a chess-board with slight noise."""
    x, y = canvas.grid.xs, canvas.grid.ys
    odd = (np.floor(x / square)[None, :] + np.floor(y / square)[:, None]) % 2
    canvas.look[..., :3] = (70 + 120 * odd[..., None]) * (
        1 + 0.03 * canvas.fine + 0.02 * canvas.grain
    )[..., None]
    canvas.look[..., 3] = 20 + 6 * odd


def _room(grid: Grid, tail: tuple[int, ...], dtype: type, path: Path) -> NDArray[Any]:
    """Allocates an array for the whole grid, in a file where it is large."""
    shape = (grid.height, grid.width, *tail)
    if grid.height * grid.width <= _IN_MEMORY:
        return np.zeros(shape, dtype=dtype)
    path.parent.mkdir(parents=True, exist_ok=True)
    return np.lib.format.open_memmap(path.with_suffix(".npy"), mode="w+", dtype=dtype, shape=shape)
