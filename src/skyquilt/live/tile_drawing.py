"""Draws the tiles of the growing map. A tile depends only on the photos that cover it, and is
redrawn where those have changed.
"""

import os
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.pixel_cache import PixelCache
from skyquilt.engine.store import Store
from skyquilt.engine.workers import Threads
from skyquilt.imaging.blank import Blank, joined
from skyquilt.imaging.grey import shrink
from skyquilt.imaging.nodes import View
from skyquilt.imaging.view_limits import COARSEST, ViewLimits, limits_for
from skyquilt.imaging.views import footprint
from skyquilt.live.coarse_views import showing_best, yielding_to_finer
from skyquilt.live.failures import concerning
from skyquilt.live.ledger import hit
from skyquilt.live.members import Member
from skyquilt.live.reduced_pictures import SmallPictures, measured
from skyquilt.live.tone import Tone
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Pose
from skyquilt.model.raster import Window
from skyquilt.model.surface import Surface
from skyquilt.ortho.blend import Blend, Feather, First, Float, Layer, Order
from skyquilt.ortho.compose import Composed, Composer
from skyquilt.ortho.exposure import Exposure
from skyquilt.ortho.height_cells import HeightCells
from skyquilt.ortho.occlusion import gentle
from skyquilt.ortho.plan import Plan
from skyquilt.ortho.spoilt import overexposed
from skyquilt.raster.tile_store import SIDE, Address, Tile, TileStore, covering


@dataclass(frozen=True, kw_only=True)
class Newest:
    """The photo taken last is shown, with hard seams."""

    margin: ClassVar[int] = 0
    seam_px: ClassVar[None] = None
    version: ClassVar[int] = 1

    def rank(self, order: Order, score: Float) -> Float:
        """Order of capture, newest first."""
        return np.where(np.isfinite(score), np.float32(-order), np.float32(np.inf))

    def reach(self, gsd: float) -> float:
        """Zero, since only one photo contributes to each pixel."""
        return 0.0

    def merge(self, layers: Sequence[Layer], gsd: float) -> tuple[NDArray[Any], NDArray[np.int32]]:
        """Takes each pixel from the last layer that covers it; layers are in order of capture."""
        return First().merge(list(reversed(layers)), gsd)


MOST_TILES = 4000
"""Largest number of tiles that a photo may cover; the footprint of one that sees the horizon is
larger.
"""
TILES_PER_MP = 512
"""The same per megapixel of the photo: it need not be drawn much larger than it is."""
MOST_CELLS = 1000
"""Largest number of height cells along a side of the surface below a photo."""
NEWEST = "-newest"
"""Suffix of the names of layers that show the newest photo instead of the most vertical view."""
COUNTS, COLOURS = "thermal-counts", "thermal-colours"
"""Layers of thermal photos whose values are of no known unit, and of those that hold the colours of
a palette; `thermal` has degrees Celsius.
"""
RIM = 12
"""Cells around a tile whose heights are looked at, too, so that neighbouring tiles agree."""
MOST_VIEWS = 40
"""Largest number of photos from which a tile is composed."""
LEAST_MOVE = 0.6
"""A photo is drawn again if it has moved by more than this number of map pixels."""
DRAWINGS = 96
"""Number of tiles kept in memory with their composition, so that only the parts of changed photos
are redrawn.
"""
RECENT = 200
"""Number of photos from which the median ground size of a pixel is taken."""
LOOKED_AT = 128
"""Longest side in px of the pictures in which overexposed parts are looked for."""
THREADS = min(2, os.cpu_count() or 1)
"""Number of tiles drawn in parallel."""
WHOLE = Window(row=0, column=0, height=SIDE, width=SIDE)
RULES: dict[str, Blend] = {"": Feather(width_px=2.0), NEWEST: Newest()}


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawing:
    """A tile that was composed."""

    plan: Plan
    """Which photos show where on it."""
    composed: Composed
    """The composed pixels."""


def layer_of(member: Member) -> str:
    """The layer that shows a photo: one per spectral band, and of thermal photos one for each kind
    of values, so that no layer joins degrees, counts and colours.
    """
    photo = member.photo
    if photo.band != "thermal" or photo.unit == "celsius":
        return photo.band
    return COUNTS if photo.unit else COLOURS


def _most_tiles(member: Member) -> float:
    """Largest number of tiles on which a photo is drawn."""
    size = member.photo.width * member.photo.height / 1e6
    return min(MOST_TILES, max(64, TILES_PER_MP * size))


class Canvas:
    """The tiles of the map, and which photos cover which tile."""

    def __init__(
        self,
        tiles: TileStore,
        heights: HeightCells,
        full: PixelCache[NDArray[Any]],
        members: dict[int, Member],
        store: Store,
        max_view_angle: float,
        alike: Callable[[str], tuple[Blank | None, Blank | None]],
        badly: Sequence[Callable[[int], Blank | None]],
    ) -> None:
        """`alike`: where the photos of a camera (its key) all show marks, and where nothing;
        `badly`: what a photo (its number) shows badly, such as all of a blurred one.
        """
        self.tiles, self.heights, self.members = tiles, heights, members
        self.gsd = 0.0
        self.ground = 0.0
        self.max_view_angle = max_view_angle
        self._sizes: dict[int, float] = {}
        self._views: dict[int, View] = {}
        self._seen: dict[int, tuple[Address, ...]] = {}
        self._raised: set[Address] = set()
        self._met: set[Address] = set()
        self._shown: dict[Address, tuple[int, ...]] = {}
        self._kept: OrderedDict[Address, Drawing] = OrderedDict()
        self._by_tile: dict[Address, set[int]] = defaultdict(set)
        self._pictures = SmallPictures(full, members, store)
        self._white: dict[int, Blank | None] = {}
        self._alike, self._badly = alike, badly
        self._marked: dict[str, tuple[Blank | None, ...]] = {}
        self._tone = Tone(self._pictures)

    def place(self, member: Member, camera: Camera) -> set[Address]:
        """Records the pose of a photo; returns the tiles that may look different."""
        assert member.pose is not None
        old = self._seen.get(member.id, ())
        view = self._view(member, camera, member.pose)
        if view is None:
            return self.remove(member.id)
        low, high = view.footprint.min(0), view.footprint.max(0)
        across, along = (high - low) / (SIDE * self.gsd)
        if not across * along < _most_tiles(member):  # the horizon, or an absurd height
            return self.remove(member.id)
        now = tuple(covering(layer_of(member), 0, self.gsd, (low[0], low[1], high[0], high[1])))
        for address in old:
            self._by_tile[address].discard(member.id)
        for address in now:
            self._by_tile[address].add(member.id)
        self._views[member.id], self._seen[member.id] = view, now
        self._settle(member, view, now)
        return set(old) | set(now)

    def _settle(self, member: Member, view: View, tiles: Iterable[Address]) -> None:
        """Brings a photo to the brightness of those that it overlaps."""
        near = {i for address in tiles for i in self._by_tile.get(address, ())} - {member.id}
        others = [v for i in sorted(near) if (v := self._views.get(i)) is not None]
        low, high = view.footprint.min(0), view.footprint.max(0)
        self._tone.settle(
            view,
            others,
            self.surface((low[0], low[1], high[0], high[1])),
            measured=measured(member),
            drift=member.photo.unit == "celsius",
        )

    def level(self, exposure: Exposure) -> list[int]:
        """Takes the brightness of some photos on the map from one that was found for all of them
        together; returns their numbers.
        """
        return self._tone.take(exposure, self._views)

    @property
    def exposure(self) -> Exposure:
        """How the photos are balanced so far, by their numbers."""
        return self._tone.exposure

    def remove(self, number: int) -> set[Address]:
        """Removes a photo; returns the tiles that may look different."""
        old = self._seen.pop(number, ())
        for address in old:
            self._by_tile[address].discard(number)
        self._views.pop(number, None)
        self._tone.forget(number)
        return set(old)

    def _view(self, member: Member, camera: Camera, pose: Pose) -> View | None:
        longest = self._pictures.longest(member, self.gsd, self.ground)
        scale = longest / max(camera.width, camera.height)
        w, h = (
            (round(camera.width * scale), round(camera.height * scale))
            if scale < 1
            else (camera.width, camera.height)
        )
        small = camera.reduced(w, h)
        x, y, z = pose.map_C.tolist()
        reach = min(1.5 * abs(z - self.ground), MOST_CELLS / 2 * self.heights.cell)
        surface = self.surface((x - reach, y - reach, x + reach, y + reach))
        self._sizes[member.id] = abs(z - self.ground) / camera.focal
        limits = self._limits(small, pose, surface)
        fixed, rim = self._alike(member.photo.camera_key)
        if rim is not None:
            limits = replace(limits, blank=replace(rim, size=(w, h)))
        parts = [fixed, self._overexposed(member, (w, h)), *(of(member.id) for of in self._badly)]
        bad = [replace(part, size=(w, h)) for part in parts if part is not None]
        if bad:
            limits = replace(limits, mark=reduce(joined, bad))
        outline = footprint(small, pose, surface, limits=limits)
        return (
            View(photo=member.id, camera=small, pose=pose, footprint=outline, limits=limits)
            if len(outline)
            else None
        )

    def _overexposed(self, member: Member, size: tuple[int, int]) -> Blank | None:
        """Where a photo, drawn at this width and height in px, is overexposed; looked for once."""
        if member.photo.band == "thermal":  # white is warm
            return None
        if member.id not in self._white:
            small = shrink(self._pictures(member.id), LOOKED_AT)[0]
            self._white[member.id] = overexposed(small, size)
        return self._white[member.id]

    def remarked(self, camera: str) -> bool:
        """Whether marks or a rim of a camera's (its key) pictures were found since it was asked."""
        now, before = self._alike(camera), self._marked.get(camera, (None, None))
        self._marked[camera] = now
        return any(a is not b for a, b in zip(now, before, strict=True))

    def is_white(self, number: int) -> bool:
        """Whether a photo is on the map and overexposed in part."""
        return number in self._views and self._white.get(number) is not None

    def white(self) -> list[int]:
        """The photos of which that is true, ascending."""
        return sorted(i for i in self._white if self.is_white(i))

    def _limits(self, camera: Camera, pose: Pose, surface: Surface) -> ViewLimits:
        """What a photo may show: no more than near the heights known now, and near its nadir."""
        native = float(np.median(list(self._sizes.values())[-RECENT:]))
        angle = ViewLimits(angle_deg=self.max_view_angle, coarsest_m=COARSEST * native)
        outline = footprint(camera, pose, surface, limits=angle)
        above = max(float(pose.map_C[2]) - self.ground, 1.0)
        near = limits_for(
            pose.map_C[None], np.zeros((0, 2)), np.array([above]), self.max_view_angle, native
        )
        if not len(outline) or not near.cuts(pose.map_C, outline, surface.at(*outline.T)):
            return angle  # most photos: what they show lies near their nadir
        low, high = outline.min(0) - above, outline.max(0) + above
        known = self.heights.places((low[0], low[1], high[0], high[1]))
        return limits_for(
            np.concatenate([known, pose.map_C[None, :2]]),
            np.zeros((0, 2)),
            np.array([above]),
            self.max_view_angle,
            native,
        )

    def surface(self, bounds: Iterable[float]) -> Surface:
        """Ground heights in m within bounds (m, map frame)."""
        return self.heights.surface(bounds, self.ground)

    def tiles_of(self, number: int) -> tuple[Address, ...]:
        """Tiles of level 0 that a photo may show in."""
        return self._seen.get(number, ())

    def outline(self, number: int) -> NDArray[np.float64] | None:
        """Footprint (k, 2) in m of a photo on the map."""
        view = self._views.get(number)
        return None if view is None else view.footprint

    def moved(self, member: Member, drawn: Pose) -> bool:
        """Whether a photo has moved visibly since it was drawn."""
        assert member.pose is not None
        camera = member.photo
        above = max(float(drawn.map_C[2]) - self.ground, 1.0)
        shift = np.abs(member.pose.map_C - drawn.map_C).max()
        turn = (
            np.abs(member.pose.cam_R_map - drawn.cam_R_map).max()
            * above
            * (1 + camera.width / 2 / camera.focal.px)
        )
        return bool(max(shift, turn) > LEAST_MOVE * self.gsd)

    def covering(self, x: float, y: float) -> list[int]:
        """Photos whose footprint contains a point (m, map frame), the most vertical view first."""
        found = []
        for layer in {a.layer for a in self._by_tile}:
            for address in covering(layer, 0, self.gsd, (x, y, x, y)):
                found += list(self._by_tile.get(address, ()))
        return sorted(set(found))

    def draw(self, dirty: Mapping[Address, Collection[int]], rule: str = "") -> list[Address]:
        """Draws tiles of level 0 (addresses of the plain layer) on which these photos have changed.

        A tile is not changed if none of them was or is visible on it. Returns the tiles written;
        `finish` draws the coarser levels.
        """
        drawn = list(Threads(THREADS).each(lambda a: self._drawn(a, dirty[a], rule), list(dirty)))
        for at, drawing, _ in drawn:
            self._keep(at, drawing)
        written = [(at, tile) for at, _, tile in drawn if tile is not None]
        newest = (
            [at for at, _, _ in drawn]
            if rule
            else [replace(a, layer=a.layer + NEWEST) for a in dirty]
        )
        self.tiles.put(written, owing=() if rule else newest)
        hit("tiles written")
        self._met.update(newest if rule else ())
        self._raised.update(at for at, _ in written)
        return [at for at, _ in written]

    def _drawn(
        self, address: Address, changed: Collection[int], rule: str
    ) -> tuple[Address, "Drawing | None", Tile | None]:
        """The tile's address in its own layer, its composition and its pixels; None = unchanged."""
        # an error of drawing is blamed on the newest of the photos that made it necessary
        with concerning(max(changed or self._by_tile.get(address) or {0})):
            return self._composed(address, changed, rule)

    def _composed(
        self, address: Address, changed: Collection[int], rule: str
    ) -> tuple[Address, "Drawing | None", Tile | None]:
        at = replace(address, layer=address.layer + rule)
        compose, kept = self._composer(address, RULES[rule]), self._kept.get(at)
        plan = compose.plan(WHOLE, earlier=kept.plan if kept else None) if compose else None
        shown = tuple(plan.shown) if plan else ()
        if self._shown.get(at) == shown and not set(shown).intersection(changed):
            return at, kept, None
        self._shown[at] = shown
        if compose is None or plan is None or not shown:
            return at, None, self._empty(address.layer) if self.tiles.version(at) > 0 else None
        composed = compose.redrawn(plan, kept.plan, kept.composed) if kept else compose.drawn(plan)
        tile = self._tile(composed)
        if tile is None and self.tiles.version(at) > 0:
            tile = self._empty(address.layer)
        return at, Drawing(plan=plan, composed=composed), tile

    def _keep(self, at: Address, drawing: "Drawing | None") -> None:
        self._kept.pop(at, None)
        if drawing is not None:
            self._kept[at] = drawing
        while len(self._kept) > DRAWINGS:
            self._kept.popitem(last=False)

    def finish(self, rule: str = "") -> int:
        """Draws the coarser tiles above all tiles drawn since the last call; returns how many."""
        changed = {a for a in self._raised if a.layer.endswith(NEWEST) == bool(rule)}
        met = self._met if rule else set[Address]()
        self._raised -= changed
        raised = self.tiles.raise_levels(changed, drawn=met) if changed or met else 0
        self._met -= met
        return raised

    def owed(self) -> list[Address]:
        """Tiles (addresses of the plain layer) whose counterparts in the newest-on-top layer are
        out of date.
        """
        return [replace(a, layer=a.layer.removesuffix(NEWEST)) for a in self.tiles.owed()]

    def _composer(self, address: Address, blend: Blend) -> Composer | None:
        """The composer of a tile; None if no photo covers it."""
        grid = address.grid(self.gsd)
        inside = [
            v
            for i in sorted(self._by_tile.get(address, ()))
            if (v := self._views.get(i)) is not None
        ]
        if not inside:
            return None
        west, south, east, north = grid.bounds
        rim = RIM * self.heights.cell
        surface = self.surface((west - rim, south - rim, east + rim, north + rim))
        inside = showing_best(inside, grid, surface, MOST_VIEWS)
        surface = gentle(surface, np.array([v.pose.map_C for v in inside]))
        values = measured(self.members[inside[0].photo])
        return Composer(
            grid=grid,
            views=yielding_to_finer(inside, self._sizes, surface, self.gsd),
            surface=surface,
            blend=blend,
            pixels=self._pictures,
            bands=1 if values else 3,
            dtype=np.dtype(np.float32 if values else np.uint8),
            exposure=self.exposure,
        )

    @staticmethod
    def _tile(done: Composed) -> Tile | None:
        shown = done.photo >= 0
        if done.pixels.dtype.kind == "f":
            shown &= np.isfinite(done.pixels[..., 0])
        return Tile(pixels=np.nan_to_num(done.pixels), shown=shown) if shown.any() else None

    def _empty(self, layer: str) -> Tile:
        thermal = layer.removesuffix(NEWEST) in ("thermal", COUNTS)
        pixels = (
            np.zeros((SIDE, SIDE, 1), np.float32)
            if thermal
            else np.zeros((SIDE, SIDE, 3), np.uint8)
        )
        return Tile(pixels=pixels, shown=np.zeros((SIDE, SIDE), bool))
