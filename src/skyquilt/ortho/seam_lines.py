"""Seam lines: which photo is shown where, cut where photos agree and around whole objects.

Without them every place is shown from its most vertical view, and the boundaries between photos are
straight lines through whatever lies there. Here a strip around these boundaries is contested. It is
flooded from the undisputed parts, as in Soille (2006): the places where the two best photos differ,
and those that stand up from the ground, are flooded first, so that an object belongs as a whole to
the photo that reaches it; the floods meet where the photos agree. Where all places are alike they
meet in the middle, at the most vertical view.

Places that a photo does not see, because something stands before them, belong to one that does.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.engine.pixel_cache import PixelCache
from skyquilt.engine.workers import Ahead
from skyquilt.imaging.grey import shrunken_px
from skyquilt.imaging.nodes import STEP, View, densify, overlapping, project_all
from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface, least_cell
from skyquilt.ortho.bare_ground import bare_ground
from skyquilt.ortho.exposure import Exposure
from skyquilt.ortho.labels import Labels
from skyquilt.ortho.occlusion import STANDING_M, Shadow
from skyquilt.ortho.smears import smeared

Float = NDArray[np.float32]
Mask = NDArray[np.bool_]
GreyPicture = Callable[[int, int], NDArray[np.uint8]]
"""Gives the grey image (h, w) of a photo (index), reduced to the given px on its longest side."""
Box = tuple[int, int, int, int]
"""Row, column, height and width in cells."""
CELL = 8
"""Least number of map pixels along a side of a cell; it grows by powers of two."""
LEAST_M = 0.2
"""Least side of a cell in m."""
TILE = 1024
"""Cells along a side of the pieces in which seams are found; the seams of a piece continue those of
its neighbours.
"""
PART = 256
"""Cells along a side of the parts in which photos are compared."""
HIDDEN = np.float32(1e3)
"""Added to the score of a photo where something stands before the place."""
GRAZING = 0.3
"""Length of a cell in a photo, over that on level ground, below which it counts as hidden."""
SMEARED = np.float32(5e2)
"""Added where its pixels are smeared over the ground, or show a mark."""
WRITTEN = np.float32(2.5e3)
"""Added besides where a mark shows no ground at all: a tree that stands before the place is less
odd on a map than a text.
"""
SHADOWS_BYTES = 60_000_000
"""Bytes of hidden places of photos that are kept in memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """Photos compared over a part of the cells."""

    ranked: NDArray[np.int32]
    """(3, h, w) the best photos, the best first; -1 = none."""
    sure: Mask
    """(h, w) whether the best photo is not contested."""
    height: NDArray[np.uint8]
    """(h, w) height of the flooded landscape: low where seams must not run."""
    hidden: Mask
    """(h, w) whether even the best photo does not see the place."""


@dataclass(frozen=True, kw_only=True)
class SeamLines:
    """Watershed seams between the most vertical views."""

    longest: int = 500
    """Longest side in px of the grey images that are compared."""
    strip: float = 0.4
    """Half the width of the contested strip, as a share of the distance of the two cameras."""
    grey: float = 2.0
    """Difference in grey values that does not count."""
    object: float = 40.0
    """The same for a height of one metre or more above the surroundings, in grey values."""
    least: int = 24
    """Undisputed patches of fewer cells are contested too."""
    version: ClassVar[int] = 7

    def __call__(
        self,
        views: Sequence[View],
        surface: Surface,
        grid: Grid,
        grey: GreyPicture,
        exposure: Exposure,
        keep: Keep = MADE_NOW,
    ) -> Labels:
        """The photo of each cell of a map's grid; `keep`: each tile is a part; its workers compare
        the photos.
        """
        factor = CELL
        while factor * grid.gsd < LEAST_M or factor < least_cell(grid):
            factor *= 2
        cells = grid.coarser(factor)
        z = surface.on(cells.x(np.arange(cells.width)), cells.y(np.arange(cells.height)))
        over = z - bare_ground(z, _covered(views, cells), cells.gsd)
        scene = _Scene(
            views=views,
            cells=cells,
            z=z,
            over=over,
            grey=grey,
            exposure=exposure,
            longest=self.longest,
        )

        def compared(box: Box) -> _Part | None:
            return self._part(scene, *box)

        photo = np.full(z.shape, -1, np.int32)
        hidden = np.zeros(z.shape, np.bool_)
        tiles = {f"{box[0]} {box[1]}": box for box in _boxes((0, 0, *z.shape), TILE)}
        missing = keep.missing(tiles)
        boxes = [(box, box) for tile in missing for box in _boxes(tiles[tile], PART)]
        ahead = Ahead(keep.workers, compared, boxes, keep.tell, "seams")
        for tile, (row, column, h, w) in tiles.items():
            at = (slice(row, row + h), slice(column, column + w))
            photo[at], hidden[at] = keep(tile, lambda: self._tile(ahead, photo, tiles[tile]))  # noqa: B023 - called at once
        return Labels(
            cells=cells, factor=factor, photo=photo, hidden=hidden, tall=over > STANDING_M
        )

    def _tile(
        self, compared: Ahead[Box, _Part | None], photo: NDArray[np.int32], tile: Box
    ) -> tuple[NDArray[np.int32], Mask]:
        """The labels (h, w) of a tile from its `compared` parts, and whether even that photo does
        not see the place; tiles above and to the left are finished.
        """
        row, column, h, w = tile
        top, left = min(row, 1), min(column, 1)
        ranked = np.full((3, h + top, w + left), -1, np.int32)
        sure = np.zeros(ranked.shape[1:], np.bool_)
        height = np.zeros(ranked.shape[1:], np.uint8)
        hidden = np.zeros((h, w), np.bool_)
        for box in _boxes(tile, PART):
            part = compared.take(box, box)
            if part is None:
                continue
            r, c, (rows, columns) = box[0] - row, box[1] - column, box[2:]
            at = (slice(top + r, top + r + rows), slice(left + c, left + c + columns))
            ranked[:, *at], sure[at], height[at] = part.ranked, part.sure, part.height
            hidden[r : r + rows, c : c + columns] = part.hidden
        before = photo[row - top : row + h, column - left : column + w]
        ranked[0] = np.where(before >= 0, before, ranked[0])
        sure |= before >= 0
        if not (ranked[0] >= 0).any():
            return np.full((h, w), -1, np.int32), hidden
        found = flooded(ranked[0], sure, height)
        possible = (found == ranked).any(0)
        found = np.where(possible, found, ranked[0])
        return found[top:, left:].astype(np.int32), hidden

    def _part(self, scene: "_Scene", row: int, column: int, h: int, w: int) -> _Part | None:
        """Compares the photos over h x w cells."""
        seen = scene.scores(row, column, h, w)
        if seen is None:
            return None
        views, score, nodes = seen
        order, best = _three(score)
        index = np.array([*(v.photo for v in views), -1], np.int32)
        # what is smeared, marked or white floods no place that another one shows well; what is
        # hidden may: objects are cut less
        gain = best[1:] - np.where(order[0] >= 0, best[0], 0)
        worse = (np.abs(gain - SMEARED) < SMEARED / 2) | (gain > WRITTEN - HIDDEN + SMEARED / 2)
        ranked = index[np.concatenate([order[:1], np.where(worse, -1, order[1:])])]
        centre = np.array([(*v.pose.map_C[:2],) for v in views] + [(0.0, 0.0)])
        apart = np.hypot(*(centre[order[0]] - centre[order[1]]).transpose(2, 0, 1))
        above = np.array([n.height for n in nodes] + [1.0])[order[0]]
        gap = np.where(order[1] >= 0, best[1], HIDDEN) - np.where(order[1] >= 0, best[0], 0)
        # the way to the boundary between both photos, as a share of the contested half strip
        away = gap * above**2 / np.maximum(2 * apart * self.strip * apart, 1e-6)
        contested = (away < 1) & (order[1] >= 0)
        sure = _patches((order[0] >= 0) & ~contested, order[0], self.least)
        if contested.any():
            a, b = (scene.greys(views, nodes, order[k], h, w) for k in (0, 1))
            unlike = np.abs(a - b)
            unlike = cv2.max(unlike, cv2.blur(unlike, (5, 5)) * 1.5)
        else:
            unlike = np.zeros((h, w), np.float32)
        over = scene.over[row : row + h, column : column + w]
        cost = unlike + self.object * np.clip(over / STANDING_M, 0, 2)
        middle = np.clip(1 - away, 0, 1)
        level = 15 * middle + 240 * (1 - np.log1p(cost / self.grey) / np.log1p(150 / self.grey))
        return _Part(
            ranked=ranked,
            sure=sure,
            height=np.clip(level, 0, 255).astype(np.uint8),
            hidden=(np.where(best[0] < WRITTEN, best[0], best[0] - WRITTEN) >= HIDDEN)
            & (order[0] >= 0),
        )


def _boxes(whole: Box, side: int) -> Iterator[Box]:
    """Boxes of at most so many cells along a side that fill a box, row by row."""
    row, column, height, width = whole
    for r in range(row, row + height, side):
        for c in range(column, column + width, side):
            yield r, c, min(side, row + height - r), min(side, column + width - c)


def _covered(views: Sequence[View], cells: Grid) -> Mask:
    """(rows, columns) cells within any photo's footprint."""
    mask = np.zeros((cells.height, cells.width), np.uint8)
    for view in views:
        px = np.stack(cells.pixel(view.footprint[:, 0], view.footprint[:, 1]), 1)
        cv2.fillPoly(mask, [np.rint(px).astype(np.int32)], (1,))
    return mask > 0


def _three(score: Float) -> tuple[NDArray[np.intp], Float]:
    """Index (3, h, w) of the three least scores of (k, h, w), -1 = none, and the scores."""
    rest = score.copy()
    order = np.full((3, *score.shape[1:]), -1, np.intp)
    best = np.full((3, *score.shape[1:]), np.inf, np.float32)
    for k in range(min(3, len(score))):
        at = rest.argmin(0)[None]
        best[k] = np.take_along_axis(rest, at, 0)[0]
        order[k] = np.where(np.isfinite(best[k]), at[0], -1)
        np.put_along_axis(rest, at, np.float32(np.inf), 0)
    return order, best


def _patches(sure: Mask, label: NDArray[Any], least: int) -> Mask:
    """Those of the marked cells (h, w) that lie in patches of one label of at least `least`."""
    marked = np.where(sure, label + 1, 0).astype(np.int16)
    cv2.filterSpeckles(marked, 0, least, 0)
    return marked > 0


def flooded(label: NDArray[np.int32], sure: Mask, height: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Labels (h, w) spread from the sure cells over the others that have one, through low places
    first (Meyer 1991).
    """
    land = label >= 0
    h, w = label.shape
    # OpenCV floods by the differences of neighbouring pixels. Between cells, all of height zero,
    # pixels are inserted that hold the height of the step; so differences are these heights.
    steps = np.full((2 * h + 1, 2 * w + 1), 255, np.uint8)
    steps[1::2, 1::2] = 0
    steps[1::2, 2:-1:2] = np.minimum(254, np.maximum(height[:, 1:], height[:, :-1]))
    steps[2:-1:2, 1::2] = np.minimum(254, np.maximum(height[1:], height[:-1]))
    names, index = np.unique(label[land & sure], return_inverse=True)
    if not len(names):
        return label
    marks = np.zeros(steps.shape, np.int32)
    cells = np.zeros(label.shape, np.int32)
    cells[land & sure] = index + 1
    cells[~land] = len(names) + 1
    marks[1::2, 1::2] = cells
    cv2.watershed(cv2.merge([steps, steps, steps]), marks)
    found = marks[1::2, 1::2]
    table = np.array([-1, *names, -1], np.int32)
    out = np.where((found > 0) & land, table[np.clip(found, 0, len(table) - 1)], -1)
    out = np.where(land & sure, label, out)
    return np.where(land & (out < 0), label, out).astype(np.int32)


class _Scene:
    """What the parts of a map are compared from."""

    def __init__(
        self,
        *,
        views: Sequence[View],
        cells: Grid,
        z: Float,
        over: Float,
        grey: GreyPicture,
        exposure: Exposure,
        longest: int,
    ) -> None:
        self.views, self.cells, self.z, self.over = views, cells, z, over
        self._grey, self._exposure, self._longest = grey, exposure, longest
        tall = over > STANDING_M
        view_of = {view.photo: view for view in views}
        # not a method of this scene: as one it would keep all of it in memory until the end
        self._shadows = PixelCache(
            read=lambda photo: Shadow(view_of[photo], cells, z, tall), budget_bytes=SHADOWS_BYTES
        )

    def scores(
        self, row: int, column: int, h: int, w: int
    ) -> tuple[list[View], Float, list[Any]] | None:
        """The views of h x w cells, their scores (k, h, w), infinite where they do not cover them,
        and their nodes, two cells apart; None if there are none.
        """
        c = column + 2 * (np.arange(-1, -(-w // 2) + 1) + 0.5) - 0.5
        r = row + 2 * (np.arange(-1, -(-h // 2) + 1) + 0.5) - 0.5
        x, y = np.meshgrid(self.cells.x(c), self.cells.y(r))
        rows = np.clip(np.floor(r).astype(int), 0, self.z.shape[0] - 1)
        columns = np.clip(np.floor(c).astype(int), 0, self.z.shape[1] - 1)
        z = self.z[rows][:, columns]
        views = overlapping(self.views, x, y)
        nodes = project_all(views, x, y, z)
        some = [k for k, n in enumerate(nodes) if n.seen.any()]
        if not some:
            return None
        views, nodes = [views[k] for k in some], [nodes[k] for k in some]
        part = (slice(row, row + h), slice(column, column + w))
        slopes, over = self._slopes(*part), self.z[part]
        fx, fy = np.meshgrid(
            self.cells.x(np.arange(column, column + w)), self.cells.y(np.arange(row, row + h))
        )
        score = np.full((len(views), h, w), np.float32(np.inf))
        for out, view, n in zip(score, views, nodes, strict=True):
            at, near = _within(n.seen, h, w)
            size = (at[0].stop - at[0].start, at[1].stop - at[1].start)
            seen = densify(n.seen[near].astype(np.float32), *size, 2) > 0.99
            own = np.where(seen, densify(n.score[near], *size, 2), np.float32(np.inf))
            smear = smeared(n, 2 * self.cells.gsd / STEP)[near]
            if smear.any():  # what lies flat yields to sharper photos
                own[densify(smear.astype(np.float32), *size, 2) > 0.5] += SMEARED
            if (mark := view.limits.mark) is not None:  # so does what was written over the ground
                u, v = (densify(px[near], *size, 2) for px in (n.u, n.v))
                half = _half_cell_px(n.u[near], n.v[near])
                own[mark.near(u, v, half)] += SMEARED
                if mark.written is not None:
                    own[mark.written.near(u, v, half)] += WRITTEN
            shadow = self._shadows(view.photo)
            if not shadow.empty:
                x, y, z = fx[at], fy[at], over[at]
                slope = (slopes[0][at], slopes[1][at])
                lost = shadow.hides(x, y, z) | self._grazing(view, slope, z, x, y)
                behind = cv2.morphologyEx(
                    lost.view(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)
                )
                own[behind > 0] += HIDDEN
            out[at] = own
        return views, score, nodes

    def _slopes(self, rows: slice, columns: slice) -> tuple[Float, Float]:
        """Slopes (h, w) of the heights down and to the right."""
        r, c = max(rows.start - 2, 0), max(columns.start - 2, 0)
        soft = cv2.blur(self.z[r : rows.stop + 2, c : columns.stop + 2], (3, 3))
        inner = (slice(rows.start - r, rows.stop - r), slice(columns.start - c, columns.stop - c))
        down, right = (
            cv2.Sobel(soft, cv2.CV_32F, *along, scale=1 / (8 * self.cells.gsd))[inner]
            for along in ((0, 1), (1, 0))
        )
        return np.asarray(down, np.float32), np.asarray(right, np.float32)

    @staticmethod
    def _grazing(
        view: View, slopes: tuple[Float, Float], z: Float, x: NDArray[Any], y: NDArray[Any]
    ) -> Mask:
        """Cells (h, w) that a photo sees so flatly that they would be drawn as streaks."""
        cx, cy, cz = view.pose.map_C
        down, right = slopes
        toward = (x - cx) * right - (y - cy) * down
        return np.asarray(1 + toward / np.maximum(cz - z, 0.1) < GRAZING)

    def greys(
        self, views: Sequence[View], nodes: Sequence[Any], chosen: NDArray[Any], h: int, w: int
    ) -> Float:
        """Balanced grey values (h, w) of the photos chosen (h, w) by their position in `views`."""
        out = np.zeros((h, w), np.float32)
        for k in np.unique(chosen[chosen >= 0]).tolist():
            view, n = views[k], nodes[k]
            mine = chosen == k
            at, near = _extent(mine)
            size = (at[0].stop - at[0].start, at[1].stop - at[1].start)
            picture = self._grey(view.photo, self._longest)
            u, v = (densify(p[near], *size, 2) for p in (n.u, n.v))
            small = shrunken_px(u, v, picture.shape, (view.camera.height, view.camera.width))
            value = cv2.remap(picture, *small, cv2.INTER_LINEAR)
            np.copyto(out[at], self._exposure.grey(view, value, u, v), where=mine[at])
        return out


Part = tuple[slice, slice]


def _within(seen: Mask, h: int, w: int) -> tuple[Part, Part]:
    """The rectangle of h x w cells in which a photo is seen at these nodes, two cells apart and one
    ring around, and a margin that the opening of shadows looks at; as cells, and as their nodes.
    """
    wide = cv2.dilate(seen.view(np.uint8), np.ones((7, 7), np.uint8))[1:-1, 1:-1]
    return _extent((wide > 0).repeat(2, 0).repeat(2, 1)[:h, :w])


def _extent(cells: Mask) -> tuple[Part, Part]:
    """The rectangle around the marked cells, which begins at an even row and column: as cells, and
    as their nodes, two cells apart with one ring around.
    """
    inner, outer = [], []
    for axis, size in ((1, cells.shape[0]), (0, cells.shape[1])):
        at = np.flatnonzero(cells.any(axis))
        first, last = (int(at[0]) // 2, int(at[-1]) // 2 + 1) if len(at) else (0, 1)
        inner.append(slice(2 * first, min(2 * last, size)))
        outer.append(slice(first, last + 2))
    return (inner[0], inner[1]), (outer[0], outer[1])


def _half_cell_px(u: Float, v: Float) -> float:
    """Half the diagonal of a cell in px of a photo, from its columns and rows (h, w) of nodes two
    cells apart: a mark that is thinner must not slip between the middles of cells.
    """
    across = np.hypot(np.diff(u, axis=1), np.diff(v, axis=1))
    return float(np.median(across) / np.sqrt(8))
