"""Dense heights by multi-view matching: pairs of photos, fused on cells of the map.

Several pairs see every place; the median of their heights is kept, as Hirschmueller and Bucher
(2010) do. The search is coarse to fine: small pictures over the whole range of heights find crowns
and roofs as wholes; larger ones are matched where that shows relief, and believed where they agree
with it. Where no pair gives a height, the coarser one stays; where none has any, heights go over to
the plane through what is around, and further away to the heights of tie points, where two photos
see the ground.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.kept import Keep
from skyquilt.engine.workers import Ahead
from skyquilt.geometry.neighbours import pairs_within
from skyquilt.imaging.nodes import View
from skyquilt.model.raster import Grid, meet
from skyquilt.model.surface import Surface, least_cell
from skyquilt.ortho.fill import crowns, lowered, nearest_known, settled
from skyquilt.ortho.fusion import (
    Cells,
    agreed,
    inside,
    splatted,
    surface_of,
    with_coarse,
    without_specks,
)
from skyquilt.ortho.leaves import calmed
from skyquilt.ortho.pair_matching import Float, Footprints, Mask, Pair, matched_points, pair_of

GreyPicture = Callable[[int, int], NDArray[np.uint8]]
"""Gives the grey image (h, w) of a photo (index), reduced to the given px on its longest side."""
TILE = 512
"""Cells along a side of the pieces in which heights are fused."""
NEW = 0.25
"""Share of the ground of a pair that must still lack pairs for it to be matched."""
NEW_WIDE = 0.35
"""The same of a pair with a long baseline: share that no other pair shows."""
EDGES = 0.003
"""Share of a pair's ground that has edges where things stand on it."""


@dataclass(frozen=True, kw_only=True)
class Level:
    """One round of matching."""

    longest: int
    """Longest side in px of the photos' images."""
    window: int
    """Side in px of the window that is compared."""
    wanted: int
    """Number of pairs that should see a place."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Round:
    """What a round of matching works with."""

    cells: Grid
    """Cells of its heights."""
    low: Surface
    """Lowest height searched, by place."""
    high: Surface
    """Highest height searched."""
    grey: GreyPicture
    """Source of the photos' grey images."""
    agree: float
    """Heights of different pairs that agree differ by less than this in m."""
    held_bytes: float
    """Bytes of heights of pairs, about, that wait in memory for later tiles."""


@dataclass(frozen=True, kw_only=True)
class Stereo:
    """Coarse-to-fine semi-global matching of pairs, fused by medians."""

    coarse: Level = Level(longest=250, window=7, wanted=6)
    """Finds objects over the whole range of heights."""
    fine: Level = Level(longest=500, window=3, wanted=3)
    """Refines them."""
    finest: int = 720
    """The same where things stand: longest side in px of the photos' images."""
    below: float = 0.03
    """Search range below the lowest tie points around, as a share of the flying height."""
    above: float = 0.4
    """Search range above the tie points, as a share of the flying height."""
    agree: float = 0.03
    """Fine heights may leave the range of the coarse ones around them by this share of the flying
    height.
    """
    edges: float = 0.0
    """Edges are sought within this share of the flying height: fine heights may lie in the range of
    the coarse ones as far around, since ground that shows between crowns lies far below these, and
    gaps beside steps are filled from the lower side. 0 = fine heights keep to the coarse ones above
    them, and gaps are filled by the nearest: real leaves need that where few photos see them.
    """
    whole: float = 0.05
    """Size of crowns and of gaps between them, as a share of the flying height."""
    both_ways: bool = False
    """Pairs that show things which stand are matched a second time, from the other photo: a side of
    a crown that is narrow in one photo is wide in the other, and where both hold they are two
    heights of a place. It doubles the cost.
    """
    relief: float = 0.02
    """A pair with less relief than this share of the flying height is not matched finely, and
    things that stand are at least as high; 0 = every pair is.
    """
    base: tuple[float, float] = (0.08, 0.65)
    """Least and greatest ratio of baseline to the distance of what a pair shows: its height where
    photos look straight down, more where they look aslant.
    """
    best_base: float = 0.25
    """The ratio that is preferred."""
    widest: float = 1.2
    """Greatest ratio of a pair where no other one shows the ground: photos that overlap little."""
    held_mb: float = 64.0
    """Heights of pairs in MB, about, that wait in memory for later tiles: pairs that do not fit are
    matched again.
    """
    cell: float = 2.0
    """Side of a cell in pixels of the finest pictures that are matched, within `cell_px`."""
    cell_px: tuple[int, int] = (4, 8)
    """Least and greatest side of a cell in map pixels."""
    version: ClassVar[int] = 10

    def __call__(
        self, surface: Surface, views: Sequence[View], grid: Grid, grey: GreyPicture, keep: Keep
    ) -> Surface:
        """The surface with the heights found; the former one where the photos give none. `keep`:
        each tile is a part; its workers match the pairs.
        """
        views = [v for v in views if v.pose.cam_H_map is None]
        height = float(np.median([v.pose.map_C[2] for v in views] or [0.0]) - np.median(surface.z))
        if len(views) < 2 or height <= 0:
            return surface
        cameras = [v.camera for v in views]
        extent = height * float(np.median([max(c.width, c.height) / c.focal for c in cameras]))
        rough, support = self._coarse(surface, views, grid, grey, keep, height, extent)
        if not support.any():
            return surface
        least = self.relief * height
        pairs = self._matched(views, rough, extent, height, least, grid)
        gsd = min((p.gsd for p, _ in pairs), default=extent / self.fine.longest)
        cells = grid.coarser(
            max(int(np.clip(round(self.cell * gsd / grid.gsd), *self.cell_px)), least_cell(grid))
        )
        step, far = self.agree * height, self.edges * height
        given = _Round(
            cells=cells,
            low=_stretched(rough, max(3 * gsd, far), cv2.MORPH_ERODE, -step),
            high=_stretched(rough, max(3 * gsd, far / 2), cv2.MORPH_DILATE, step),
            grey=grey,
            agree=0.015 * height,
            held_bytes=1e6 * self.held_mb,
        )
        z, agree = _fused(given, pairs, "fine", keep), given.agree
        del given, pairs  # large surveys have rasters of 100 MB
        known = without_specks(z, 0.01 * height, 6)
        if known.any():
            z = nearest_known(z, known)
            if far > 0:
                z = lowered(z, known, round(far / 2 / cells.gsd), agree)
        side = 2 * round(self.whole * height / cells.gsd / 2) + 1
        z = with_coarse(z, known, rough, cells, side)
        return surface_of(calmed(z, known, cells.gsd, side), cells)

    def _coarse(
        self,
        surface: Surface,
        views: Sequence[View],
        grid: Grid,
        grey: GreyPicture,
        keep: Keep,
        height: float,
        extent: float,
    ) -> tuple[Surface, Mask]:
        """Heights from small pictures, without gaps, and the cells that have some of their own."""
        gsd = extent / self.coarse.longest
        pairs = [
            (p, self.coarse)
            for a, b in self.pairs(views, height, self.coarse.wanted)
            if (p := _over(a, b, surface, gsd)) is not None
        ]
        gsd = min((p.gsd for p, _ in pairs), default=gsd)
        cells = grid.coarser(max(1, round(1.5 * gsd / grid.gsd), least_cell(grid)))
        given = _Round(
            cells=cells,
            low=_stretched(surface, 0.2 * height, cv2.MORPH_ERODE, -self.below * height),
            high=replace(surface, z=surface.z + np.float32(self.above * height)),
            grey=grey,
            agree=0.04 * height,
            held_bytes=1e6 * self.held_mb,
        )
        z = _fused(given, pairs, "coarse", keep)
        known = without_specks(z, 0.02 * height, 12)
        if not known.any():
            return surface, known
        del given  # large surveys have rasters of 100 MB
        side = 2 * round(self.whole * height / cells.gsd) + 1
        whole = crowns(nearest_known(z, known), known, side, 0.02 * height)
        around = cv2.morphologyEx(
            known.astype(np.uint8),
            cv2.MORPH_CLOSE,
            cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (15, 15)),
        )
        others = partial(_seen_twice, surface, Footprints.of(views, height), cells)
        # at once: photos drawn on a slope between crowns and the plane would become streaks
        return surface_of(settled(whole, around > 0, others), cells), known

    def pairs(self, views: Sequence[View], height: float, wanted: int) -> list[tuple[View, View]]:
        """The pairs that are matched, of photos `height` m above ground: those with good baselines
        first, until every place is seen by `wanted` of them.
        """
        centre = np.array([v.pose.map_C[:2] for v in views])
        away = np.array([_away(v, height) for v in views])
        i, j = pairs_within(centre, self.widest * float(away.max()))
        ratio = np.hypot(*(centre[j] - centre[i]).T) / ((away[i] + away[j]) / 2)
        apart = (ratio >= self.base[0]) & (ratio <= self.widest)
        i, j, ratio = i[apart], j[apart], ratio[apart]
        order = np.lexsort((j, i, np.round(np.abs(np.log(ratio / self.best_base)), 1)))
        i, j, wide = i[order], j[order], ratio[order] > self.base[1]
        seen = Footprints.of(views, height)
        counts = np.zeros(seen.shape, np.int16)
        chosen = []

        def choose(some: NDArray[np.bool_], needed: int, share: float) -> None:
            for a, b in zip(i[some].tolist(), j[some].tolist(), strict=True):
                (rows, columns), both = seen.common(a, b)
                part = counts[rows, columns]
                new = both & (part < needed)
                if new.any() and new.sum() > share * both.sum():
                    part += both
                    chosen.append((views[a], views[b]))

        choose(~wide, wanted, NEW)
        alone = seen.showing((counts == 0) & (seen.counts > 1))
        choose(wide & alone[i] & alone[j], 1, NEW_WIDE)
        return chosen

    def _matched(
        self,
        views: Sequence[View],
        known: Surface,
        extent: float,
        height: float,
        least: float,
        grid: Grid,
    ) -> list[tuple[Pair, Level]]:
        """The pairs that are matched finely, over the heights known, and at which level: those that
        show things of at least `least` m at the finest, and both ways if that is asked.
        """
        fine, finest = self.fine, replace(self.fine, longest=max(self.finest, self.fine.longest))
        gsds = {n.longest: max(extent / n.longest, grid.gsd) for n in (fine, finest)}
        chosen = []
        for a, b in self.pairs(views, height, fine.wanted):
            pair = _over(a, b, known, gsds[fine.longest])
            if pair is None or _relief(pair, known) < least:
                continue
            if not _steps(pair, known, least):
                chosen.append((pair, fine))
                continue
            ways = ((a, b), (b, a)) if self.both_ways else ((a, b),)
            sharper = [_over(*way, known, gsds[finest.longest]) for way in ways]
            chosen += [(p, finest) for p in sharper if p is not None]
        return chosen


def _fused(given: _Round, pairs: Sequence[tuple[Pair, Level]], name: str, keep: Keep) -> Float:
    """Heights (rows, columns) of the cells, row 0 in the north, NaN where no pair gives one."""
    cells = given.cells
    out = np.full((cells.height, cells.width), np.nan, np.float32)

    def matched(which: tuple[Pair, Level]) -> Cells:
        return splatted(_points(*which, given), which[0].origin, cells)

    tiles = {f"{name} {at[0]} {at[1]}": at for at in _tiles(cells)}
    near = {tile: _near(pairs, cells, at) for tile, at in tiles.items()}
    missing = keep.missing(tiles)
    sizes = [8 * p.size[0] * p.size[1] * min(1.0, p.gsd / cells.gsd) ** 2 for p, _ in pairs]
    staying = _staying([near[tile] for tile in missing], sizes, given.held_bytes)
    stays = dict(zip(missing, staying, strict=True))
    order, before = list[int](), list[int]()
    for tile in missing:
        order += [k for k in near[tile] if k not in before]
        before = stays[tile]
    items = [(k, pairs[k]) for k in order]
    ahead = Ahead(keep.workers, matched, items, keep.tell, f"{name} heights")
    held: dict[int, Cells] = {}

    def fused(tile: str) -> Float:
        """Heights (h, w) of a tile from the pairs that may see it."""
        for k in near[tile]:
            if k not in held:
                held[k] = ahead.take(k, pairs[k])
        parts = (inside(held[k], cells.width, *tiles[tile]) for k in near[tile])
        found = agreed([h for h in parts if len(h[0])], given.agree, tiles[tile][2:])
        for k in held.keys() - set(stays.get(tile, ())):
            del held[k]
        return found

    for tile, (row, column, h, w) in tiles.items():
        out[row : row + h, column : column + w] = keep(tile, lambda: fused(tile))  # noqa: B023 - called at once
    return out


def _staying(
    near: Sequence[Sequence[int]], sizes: Sequence[float], held_bytes: float
) -> list[list[int]]:
    """The pairs whose heights stay in memory after each tile, from the pairs near each: those near
    the next one, and those that later tiles need, the next needed first, as many as
    `held_bytes` bear. `sizes`: bytes of the heights of each pair, about.
    """
    needed: dict[int, list[int]] = {}
    for number, pairs in enumerate(near):
        for k in pairs:
            needed.setdefault(k, []).append(number)
    out = list[list[int]]()
    for number, pairs in enumerate(near):
        known = {*pairs, *(out[-1] if out else ())}
        later = [
            (after[at], k)
            for k in known
            if (at := bisect_right(after := needed[k], number)) < len(after)
        ]
        stay, room = list[int](), held_bytes
        for when, k in sorted(later):
            room -= sizes[k]
            if when == number + 1 or room >= 0:
                stay.append(k)
        out.append(stay)
    return out


def _tiles(cells: Grid) -> Iterator[tuple[int, int, int, int]]:
    """Tiles of a grid: row, column, height and width in cells."""
    for row in range(0, cells.height, TILE):
        for column in range(0, cells.width, TILE):
            yield row, column, min(TILE, cells.height - row), min(TILE, cells.width - column)


def _near(
    pairs: Sequence[tuple[Pair, Level]], cells: Grid, at: tuple[int, int, int, int]
) -> list[int]:
    """Which pairs may see a tile."""
    row, column, h, w = at
    part = replace(
        cells,
        west=cells.west + column * cells.gsd,
        north=cells.north - row * cells.gsd,
        width=w,
        height=h,
    )
    return [k for k, (p, _) in enumerate(pairs) if meet(p.bounds, part.bounds)]


def _over(a: View, b: View, known: Surface, gsd: float) -> Pair | None:
    """The pair of two photos over the heights known in the middle of what they show; pixels of gsd
    m where they look straight down, and larger where they look aslant, as the photos' own are.
    """
    x, y = (a.middle + b.middle) / 2
    height = float(a.pose.map_C[2]) - float(known.at(x, y))
    gx, gy = np.meshgrid(*(c + 0.3 * height * np.linspace(-1, 1, 9) for c in (x, y)))
    further = (_away(a, height) + _away(b, height)) / (2 * height)
    return pair_of(a, b, float(np.median(known.at(gx, gy))), gsd * further)


def _away(view: View, height: float) -> float:
    """How far in m a photo `height` m above ground is from the middle of what it shows."""
    return float(np.hypot(height, np.hypot(*(view.middle - view.pose.map_C[:2]))))


def _sampled(pair: Pair, surface: Surface) -> Float:
    """Heights (n, n) in m of a surface above the plane of a pair, over the part that it shows."""
    places = pair.places(*np.meshgrid(*(np.linspace(0, n, 48) for n in pair.size), indexing="ij"))
    x, y, plane = np.moveaxis(places, -1, 0)
    return np.asarray(surface.at(x, y) - plane, np.float32)


def _relief(pair: Pair, surface: Surface) -> float:
    """How far heights in m under a pair lie apart, its general slope removed."""
    z = _sampled(pair, surface)
    r, c = np.mgrid[: z.shape[0], : z.shape[1]]
    terms = np.column_stack([np.ones(z.size), r.ravel(), c.ravel()])
    rest = z.ravel() - terms @ np.linalg.lstsq(terms, z.ravel(), rcond=None)[0]
    return float(np.ptp(np.percentile(rest, [1, 99])))


def _steps(pair: Pair, surface: Surface, least: float) -> bool:
    """Whether heights under a pair have edges of `least` m: the slope changes by as much from one
    sample to the next, which hills do not.
    """
    z = _sampled(pair, surface)
    bend = np.maximum(np.abs(np.diff(z, 2, 0)[:, 1:-1]), np.abs(np.diff(z, 2, 1)[1:-1]))
    return bool((bend > least).mean() >= EDGES)


def _points(pair: Pair, level: Level, given: _Round) -> Float:
    """Points (n, 3) in m, relative to the pair's origin, of a round."""
    side = level.longest
    low, high = float(_sampled(pair, given.low).min()), float(_sampled(pair, given.high).max())
    pictures = (given.grey(pair.a.photo, side), given.grey(pair.b.photo, side))
    at = matched_points(pair, *pictures, low, high, level.window)
    if not len(at):
        return at
    x, y, z = (at[:, k] + pair.origin[k] for k in range(3))
    return np.asarray(at[(z > given.low.at(x, y)) & (z < given.high.at(x, y))])


def _seen_twice(surface: Surface, seen: Footprints, cells: Grid, rows: slice) -> tuple[Float, Mask]:
    """Heights (n, w) of a surface at rows of cells, and which of them two photos see."""
    x, y = cells.x(np.arange(cells.width)), cells.y(np.arange(cells.height)[rows])
    return surface.at(*np.meshgrid(x, y)), seen.at(x, y) > 1


def _stretched(surface: Surface, reach: float, kind: int, add: float) -> Surface:
    """The lowest or highest heights within `reach` m, moved by `add` m."""
    side = 2 * max(1, round(reach / surface.cell)) + 1
    z = cv2.morphologyEx(surface.z, kind, np.ones((side, side), np.uint8))
    return replace(surface, z=np.asarray(z + np.float32(add), np.float32))
