"""The map that photos are added to: what of it stays, and how the rest is laid into it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import View
from skyquilt.model.poses import Alignment, Pose
from skyquilt.model.raster import Bounds, Grid, Window, meet
from skyquilt.model.surface import Surface, least_cell
from skyquilt.ortho.exposure import Exposure
from skyquilt.ortho.labels import Labels

MARGIN = 0.25
"""Ground around the photos that changed which is made anew, too, as a share of their width: what is
found there depends on what lies beside it.
"""
MOST = 0.5
"""With a larger share of the map to be made anew than this, all of it is."""
ALIGNED = 512
"""The map grows west and north by multiples of so many pixels, so that its tiles stay the same."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EarlierMap:
    """A finished map of some of the photos; all indices are those of the photos now."""

    alignment: Alignment
    """Its poses."""
    surface: Surface
    """Its heights."""
    grid: Grid
    """Its pixels."""
    exposure: Exposure
    """Its corrections of brightness."""
    labels: Labels | None
    """Which photo it shows where."""
    shown: tuple[int, ...]
    """Its photos by their number in provenance.tif, from 1; -1 = no longer there."""
    key: str
    """What it was made from."""
    files: bool
    """Whether its rasters are still those that were written."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Growth:
    """A map that photos are added to, and where it changes."""

    earlier: EarlierMap
    """The map."""
    areas: tuple[Bounds, ...]
    """Rectangles that are made anew; none meets another."""
    margin: float
    """Width in m of their rims, where old and new are alike."""

    @property
    def key(self) -> tuple[str, tuple[Bounds, ...]]:
        """What a result made with it depends on, beside what is made anew."""
        return self.earlier.key, self.areas

    def share(self, grid: Grid) -> float:
        """The part of a map that is made anew; above 1 where areas reach beyond it."""
        west, south, east, north = grid.bounds
        size = sum((a[2] - a[0]) * (a[3] - a[1]) for a in self.areas)
        return size / ((east - west) * (north - south))

    def near(self, views: Sequence[View], area: Bounds) -> list[View]:
        """Views that show a part of an area."""
        return [v for v in views if v.overlaps(area)]

    def inner(self, area: Bounds) -> Bounds:
        """An area without half its rim: what is taken of the new there."""
        west, south, east, north = area
        half = self.margin / 2
        return west + half, south + half, east - half, north - half

    def stays(self, window: Window, grid: Grid) -> Window | None:
        """The window of the earlier map that a window of the map now equals; None where there is
        none.
        """
        right, down = self.shift(grid)
        old = replace(window, row=window.row - down, column=window.column - right)
        inside = old.row >= 0 and old.column >= 0
        inside &= old.row + old.height <= self.earlier.grid.height
        inside &= old.column + old.width <= self.earlier.grid.width
        box = _bounds_of(window, grid)
        inside &= self.earlier.files
        return old if inside and not any(meet(box, self.inner(a)) for a in self.areas) else None

    def shift(self, grid: Grid) -> tuple[int, int]:
        """Columns and rows by which the map has grown west and north."""
        before = self.earlier.grid
        return (
            round((before.west - grid.west) / grid.gsd),
            round((grid.north - before.north) / grid.gsd),
        )

    def grown(self, wanted: Grid) -> Grid:
        """The earlier grid, with what is wanted beyond it."""
        return self.earlier.grid.reaching(wanted, ALIGNED)

    def surface(self, grid: Grid, made: Callable[[Bounds, Grid], Surface]) -> Surface:
        """The earlier heights, with those that are made anew laid into them; `made` gives the
        heights on a grid over an area.
        """
        old = self.earlier.surface
        cell = old.cell
        west, south, east, north = grid.bounds
        rows, columns = old.z.shape
        left = max(0, int(np.ceil((old.x0 - west) / cell)))
        below = max(0, int(np.ceil((old.y0 - south) / cell)))
        right = max(0, int(np.ceil((east - old.x0) / cell)) - columns + 1)
        above = max(0, int(np.ceil((north - old.y0) / cell)) - rows + 1)
        z = np.pad(old.z, ((below, above), (left, right)), mode="edge")
        x0, y0 = old.x0 - left * cell, old.y0 - below * cell
        for area in self.areas:
            new = made(area, part_of(grid, area))
            r, c = (
                np.arange(max(0, int(np.ceil(lo))), min(n, int(np.floor(hi)) + 1))
                for lo, hi, n in (
                    ((area[1] - y0) / cell, (area[3] - y0) / cell, z.shape[0]),
                    ((area[0] - x0) / cell, (area[2] - x0) / cell, z.shape[1]),
                )
            )
            if not len(r) or not len(c):
                continue
            x, y = x0 + c * cell, y0 + r * cell
            ramp = np.minimum(
                np.minimum(x - area[0], area[2] - x)[None],
                np.minimum(y - area[1], area[3] - y)[:, None],
            )
            share = np.clip(ramp / self.margin * 4 - 1, 0, 1).astype(np.float32)
            at = np.ix_(r, c)
            z[at] += share * (new.on(x, y) - z[at])
        return replace(old, z=z, x0=x0, y0=y0)

    def labels(self, grid: Grid, made: Callable[[Bounds, Grid], Labels]) -> Labels | None:
        """The earlier labels, with those that are made anew laid into them; None where there are no
        earlier ones, or their cells do not fit.
        """
        old = self.earlier.labels
        if old is None or ALIGNED % old.factor:
            return None
        cells = grid.coarser(old.factor)
        photo = np.full((cells.height, cells.width), -1, np.int32)
        hidden, tall = np.zeros(photo.shape, np.bool_), np.zeros(photo.shape, np.bool_)
        right, down = (n // old.factor for n in self.shift(grid))
        rows, columns = old.photo.shape
        at = (slice(down, down + rows), slice(right, right + columns))
        photo[at], hidden[at], tall[at] = old.photo, old.hidden, old.tall
        for area in self.areas:
            part = part_of(grid, area, old.factor)
            new = made(area, part)
            west, south, east, north = self.inner(area)
            x, y = cells.x(np.arange(cells.width)), cells.y(np.arange(cells.height))
            c = np.flatnonzero((x > west) & (x < east))
            r = np.flatnonzero((y > south) & (y < north))
            if not len(r) or not len(c):
                continue
            inner = Grid(
                west=cells.west + int(c[0]) * cells.gsd,
                north=cells.north - int(r[0]) * cells.gsd,
                gsd=cells.gsd,
                width=len(c),
                height=len(r),
            )
            there = np.ix_(*new.cells.nearest(inner))
            here = np.ix_(r, c)
            photo[here], hidden[here] = new.photo[there], new.hidden[there]
            tall[here] = new.tall[there]
        return Labels(cells=cells, factor=old.factor, photo=photo, hidden=hidden, tall=tall)


def with_new(old: Exposure, fresh: Exposure) -> Exposure:
    """Corrections of an earlier map with those of new photos, found together with photos that were
    there before, brought to the level that these have.
    """
    gains, fields, offsets = dict(old.gains), dict(old.fields), dict(old.offsets)
    if known := sorted(old.gains.keys() & fresh.gains.keys()):
        even = not any(np.abs(f).max() > 0 for f in old.fields.values())
        step = np.median([old.gains[i] - fresh.gains[i] for i in known], axis=0)
        for i in sorted(fresh.gains.keys() - old.gains.keys()):
            gains[i] = (fresh.gains[i] + step).astype(np.float32)
            fields[i] = np.zeros_like(fresh.fields[i]) if even else fresh.fields[i]
    if same := sorted(old.offsets.keys() & fresh.offsets.keys()):
        level = float(np.median([old.offsets[i] - fresh.offsets[i] for i in same]))
        offsets |= {i: o + level for i, o in fresh.offsets.items() if i not in offsets}
    patterns = {i: p for i, p in fresh.patterns.items() if i not in old.offsets}
    return replace(
        old,
        gains=gains,
        fields=fields,
        offsets=offsets,
        patterns={**old.patterns, **patterns},
        shades={i: s for i, s in fresh.shades.items() if i not in old.gains} | dict(old.shades),
    )


def complete(exposure: Exposure, views: Sequence[View]) -> Exposure:
    """Corrections of these views and no others; none for those that nothing was found for."""
    photos = [v.photo for v in views]
    if not exposure.gains:
        return exposure
    bands = len(next(iter(exposure.gains.values())))
    none = np.zeros(bands, np.float32), np.zeros(6, np.float32)
    return replace(
        exposure,
        gains={i: exposure.gains.get(i, none[0]) for i in photos},
        fields={i: exposure.fields.get(i, none[1]) for i in photos},
        offsets={i: o for i, o in exposure.offsets.items() if i in set(photos)},
        shades={i: s for i, s in exposure.shades.items() if i in set(photos)},
    )


def growth(
    earlier: EarlierMap, alignment: Alignment, views: Sequence[View], former: Sequence[View]
) -> Growth | None:
    """Where a map changes: about photos that are new, moved or gone. None where most of it does, or
    where its cells would not fit. `views` and `former` show the photos as they are and as they
    were, within the limits of each map.
    """
    now, before = ({v.photo: v for v in some} for some in (views, former))
    changed = [
        v
        for v in (*views, *former)
        if v.photo not in now
        or v.photo not in before
        or not same_pose(alignment.poses[v.photo], earlier.alignment.poses[v.photo])
        or alignment.camera(v.photo) != earlier.alignment.camera(v.photo)
    ]
    width = float(np.median([np.ptp(v.footprint, axis=0).max() for v in views]))
    margin = MARGIN * width
    boxes = [_widened(v.footprint, margin) for v in changed]
    areas = tuple(sorted(_joined(boxes)))
    found = Growth(earlier=earlier, areas=areas, margin=margin)
    wide = found.grown(_around(views, earlier.grid))
    finer = earlier.labels is not None and earlier.labels.factor < least_cell(wide)
    if found.share(wide) > MOST or finer:
        return None
    if earlier.surface.source == "plane":  # there was nothing to make heights of
        return None
    return found


def same_pose(a: Pose, b: Pose) -> bool:
    """Whether a photo has stayed where it was."""
    pairs = [(a.cam_R_map, b.cam_R_map), (a.map_C, b.map_C), (a.cam_H_map, b.cam_H_map)]
    if (a.motion is None) != (b.motion is None):
        return False
    if a.motion is not None and b.motion is not None:
        pairs += [(a.motion.shift_m, b.motion.shift_m), (a.motion.turn_rad, b.motion.turn_rad)]
    return all(
        (p is None and q is None) or (p is not None and q is not None and np.array_equal(p, q))
        for p, q in pairs
    )


def _around(views: Sequence[View], grid: Grid) -> Grid:
    """A grid over all views with the pixels of another."""
    outline = np.concatenate([v.footprint for v in views])
    (west, south), (east, north) = outline.min(0), outline.max(0)
    wide, high = (max(1, int(np.ceil(n / grid.gsd))) for n in (east - west, north - south))
    return Grid(west=float(west), north=float(north), gsd=grid.gsd, width=wide, height=high)


def _widened(outline: NDArray[np.float64], margin: float) -> Bounds:
    (west, south), (east, north) = outline.min(0) - margin, outline.max(0) + margin
    return float(west), float(south), float(east), float(north)


def _joined(boxes: Sequence[Bounds]) -> list[Bounds]:
    """Rectangles around those that meet one another, until none do."""
    found: list[Bounds] = []
    for box in boxes:
        new = box
        while touching := [b for b in found if meet(b, new)]:
            found = [b for b in found if b not in touching]
            several = np.array([new, *touching])
            low, high = several[:, :2].min(0), several[:, 2:].max(0)
            new = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        found.append(new)
    return found


def _bounds_of(window: Window, grid: Grid) -> Bounds:
    west = grid.west + window.column * grid.gsd
    north = grid.north - window.row * grid.gsd
    return west, north - window.height * grid.gsd, west + window.width * grid.gsd, north


def part_of(grid: Grid, area: Bounds, step: int = 1) -> Grid:
    """The part of a grid over an area, from and to multiples of `step` pixels."""
    size = step * grid.gsd
    left = max(0, int(np.floor((area[0] - grid.west) / size)))
    up = max(0, int(np.floor((grid.north - area[3]) / size)))
    right = min(-(-grid.width // step), int(np.ceil((area[2] - grid.west) / size)))
    down = min(-(-grid.height // step), int(np.ceil((grid.north - area[1]) / size)))
    return Grid(
        west=grid.west + left * size,
        north=grid.north - up * size,
        gsd=grid.gsd,
        width=max(1, min(right * step, grid.width) - left * step),
        height=max(1, min(down * step, grid.height) - up * step),
    )
