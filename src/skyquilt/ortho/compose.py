"""Composition of a window of the map from the photos that cover it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import STEP, Nodes, View, cut, densify, inside_everywhere, node_places
from skyquilt.model.raster import Grid, Window
from skyquilt.model.surface import Surface
from skyquilt.ortho.blend import Blend, Layer
from skyquilt.ortho.exposure import NEUTRAL, Exposure, image_place, with_odds
from skyquilt.ortho.frame_pattern import at
from skyquilt.ortho.labels import Labels
from skyquilt.ortho.plan import Plan, planned, stale
from skyquilt.ortho.stepped import Closer, Finer, Part, Stepped, lifted, stepped_heights

PhotoPixels = Callable[[int], NDArray[Any]]
"""Gives the full-size pixels (H, W[, bands]) of a photo by its index."""
PartPixels = Callable[[int, slice, slice], NDArray[Any]]
"""Gives the full-size pixels of these rows and columns of a photo (index)."""
PIECE = 256
"""Pixels of a piece composed at a time."""
FINE = (4, 8)
"""Map pixels between nodes where heights bend between those of the plan: for cells of heights of
less than 8 px, and for others.
"""
BENT = 0.25
"""Heights bend where straight lines between nodes would shift a photo by more than this number of
map pixels.
"""
MOST_PADDED = 12
"""Largest number of values in a photo's cut-out per map pixel for which adding a fourth band saves
time.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Composed:
    """A window of the map."""

    pixels: NDArray[Any]
    """(h, w, bands)."""
    photo: NDArray[np.int32]
    """(h, w) index of the leading photo of each pixel, -1 = none."""
    views: NDArray[np.uint16]
    """(r, c) number of planned photos that cover each STEP x STEP cell."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Draft:
    """What a piece is drawn from."""

    place: Window
    """Its place in the map."""
    parts: Sequence[tuple[Part, Finer | None]]
    """What each photo is drawn over, and finer heights."""
    near: Sequence[NDArray[np.bool_]]
    """(r, c) per photo: the cells in which it can be visible."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Composer:
    """Composes windows of a map."""

    grid: Grid
    """The map's grid."""
    views: Sequence[View]
    """Placed photos."""
    surface: Surface
    """Ground heights."""
    blend: Blend
    """Blending method."""
    pixels: PhotoPixels
    """Source of photo pixels."""
    bands: int
    """Bands of the map."""
    dtype: np.dtype
    """Type of the map's pixels."""
    exposure: Exposure = NEUTRAL
    """Brightness corrections of the photos."""
    labels: Labels | None = None
    """The photo of each place; None = by the blending method's own rule."""
    parts: PartPixels | None = None
    """Source of the parts of photos that are drawn; None = `pixels`."""
    detailed: bool = False
    """Whether heights may bend between the nodes of a plan; then nodes are set closer there."""
    valued: bool = False
    """Whether photos yield to others where they have no value (NaN)."""

    def __call__(self, window: Window) -> Composed:
        """Plans and composes a window."""
        return self.drawn(self.plan(window, counted=True))

    def plan(self, window: Window, *, counted: bool = False, earlier: Plan | None = None) -> Plan:
        """Determines which photos can be visible where. This is fast and reads no photo.

        `counted`: the plan contains all photos that cover the window, also those that are certainly
        hidden by others. `earlier`: a plan of the same window; unchanged photos are not projected
        again, and heights are kept where their change is not visible.
        """
        return planned(
            window,
            self.grid,
            self.views,
            self.surface,
            self.blend,
            counted=counted,
            earlier=earlier,
            labels=self.labels,
        )

    def drawn(self, plan: Plan) -> Composed:
        """Composes a planned window piece by piece."""
        window, margin = plan.window, plan.margin
        shape = (window.height, window.width, self.bands)
        # memory of zeros is not touched where no photo is drawn
        out = np.zeros(shape, self.dtype)
        if self.dtype.kind == "f":
            out.fill(np.nan)
        photo = np.full((window.height, window.width), -1, np.int32)
        for row in range(0, window.height, PIECE):
            h = min(PIECE, window.height - row)
            widths = [
                (column, min(PIECE, window.width - column))
                for column in range(0, window.width, PIECE)
            ]
            boxes = [(row, column, h + 2 * margin, w + 2 * margin) for column, w in widths]
            for (column, w), merged in zip(widths, self._pieces(plan, boxes), strict=True):
                if merged is not None:
                    inner = (slice(margin, margin + h), slice(margin, margin + w))
                    out[row : row + h, column : column + w] = merged[0][inner]
                    photo[row : row + h, column : column + w] = merged[1][inner]
        return Composed(pixels=out, photo=photo, views=self._counted(plan.nodes, margin, window))

    def redrawn(self, plan: Plan, earlier: Plan, before: Composed) -> Composed:
        """The same result as `drawn(plan)`, from the result of an earlier plan: only changed cells
        are composed again.

        Only for blending methods that work on single pixels (margin 0).
        """
        window = plan.window
        changed = stale(plan, earlier)[1:-1, 1:-1]
        out, photo = before.pixels.copy(), before.photo.copy()
        if changed.any():
            rows, columns = (
                _extent(np.asarray(changed.any(1)), window.height),
                _extent(np.asarray(changed.any(0)), window.width),
            )
            h, w = rows.stop - rows.start, columns.stop - columns.start
            empty = np.nan if self.dtype.kind == "f" else 0
            box = (rows.start, columns.start, h, w)
            new, lead = next(self._pieces(plan, [box], changed)) or (empty, np.int32(-1))
            where = changed.repeat(STEP, 0).repeat(STEP, 1)[rows, columns]
            np.copyto(out[rows, columns], new, where=where[..., None], casting="unsafe")
            np.copyto(photo[rows, columns], lead, where=where)
        return Composed(pixels=out, photo=photo, views=self._counted(plan.nodes, 0, window))

    def _counted(self, nodes: Sequence[Nodes], margin: int, window: Window) -> NDArray[np.uint16]:
        rows, columns = -(-window.height // STEP), -(-window.width // STEP)
        count = np.zeros((rows, columns), np.uint16)
        k = margin // STEP
        for n in nodes:
            count += n.seen[k + 1 : k + 1 + rows, k + 1 : k + 1 + columns]
        return count

    def _pieces(
        self,
        plan: Plan,
        boxes: Sequence[tuple[int, int, int, int]],
        wanted: NDArray[np.bool_] | None = None,
    ) -> Iterator[tuple[NDArray[Any], NDArray[np.int32]] | None]:
        """Pixels (h, w, bands) and leading photo (h, w) of each piece: first row and column of the
        nodes' window, height and width. None where no photo is visible.

        `wanted`: (r, c) cells of the window that are needed; None = all.
        """
        drafts = [self._draft(plan, *box, wanted) for box in boxes]
        found = iter(lifted([part for d in drafts if d is not None for part in d.parts]))
        for d in drafts:
            if d is None:
                yield None
            else:
                yield self._filled(d.place, *self._merged(d, [next(found) for _ in d.parts]))

    def _filled(
        self, place: Window, pixels: NDArray[Any], photo: NDArray[np.int32]
    ) -> tuple[NDArray[Any], NDArray[np.int32]]:
        """A piece with what other photos measured where the one that is shown has no value."""
        if self.dtype.kind != "f" or self.valued:
            return pixels, photo
        empty = (photo >= 0) & np.isnan(pixels).all(2)
        if not empty.any():
            return pixels, photo
        other = replace(self, labels=None, valued=True)
        plan = other.plan(place, counted=True)
        around = np.ones((3, 3), np.uint8)
        near = [cv2.dilate(n.seen.view(np.uint8), around) > 0 for n in plan.nodes]
        found = other.drawn(replace(plan, near=near))  # also of photos that others hide
        filled = empty & ~np.isnan(found.pixels).all(2)
        return np.where(filled[..., None], found.pixels, pixels), np.where(
            filled, found.photo, photo
        )

    def _draft(
        self, plan: Plan, row: int, column: int, h: int, w: int, wanted: NDArray[np.bool_] | None
    ) -> _Draft | None:
        """What a piece is drawn from; None where no photo is visible."""
        cells = (
            slice(row // STEP + 1, (row + h - 1) // STEP + 2),
            slice(column // STEP + 1, (column + w - 1) // STEP + 2),
        )
        near = [m[cells] for m in plan.near]
        if wanted is not None:
            some = wanted[
                cells[0].start - 1 : cells[0].stop - 1, cells[1].start - 1 : cells[1].stop - 1
            ]
            near = [m & some for m in near]
        chosen = [(n, here) for n, here in zip(plan.nodes, near, strict=True) if here.any()]
        if not chosen:
            return None
        place = Window(
            row=plan.window.row - plan.margin + row,
            column=plan.window.column - plan.margin + column,
            height=h,
            width=w,
        )
        cuts = [cut(n, row, column, h, w) for n, _ in chosen]
        finer = self._stepped(place, cuts) or self._closer(plan, cuts, row, column, place)
        if len(cuts) == 1:
            # the whole piece, in case that this photo covers all of it
            parts = [Part(nodes=cuts[0], row=0, column=0, height=h, width=w)]
        else:
            parts = [_part(n, here, place) for n, (_, here) in zip(cuts, chosen, strict=True)]
        return _Draft(
            place=place, parts=[(part, finer) for part in parts], near=[here for _, here in chosen]
        )

    def _merged(
        self, draft: _Draft, nodes: Sequence[Nodes]
    ) -> tuple[NDArray[Any], NDArray[np.int32]]:
        """Pixels (h, w, bands) and leading photo (h, w) of a piece; `nodes`: of its parts."""
        place, parts = draft.place, draft.parts
        if alone := len(parts) == 1:
            n, size = nodes[0], (place.height, place.width)
            if n.seen.all():  # nothing to blend, whatever the method
                pixels, _ = self._warped(n, *size, ranked=False)
                return pixels, np.full(size, n.view.photo, np.int32)
            whole, finer = parts[0]
            parts = [(_part(whole.nodes, draft.near[0], place), finer)]
            nodes = lifted(parts)
        layers = [
            self._layer(n, part, place, alone=alone)
            for n, (part, _) in zip(nodes, parts, strict=True)
        ]
        return self.blend.merge(layers, self.grid.gsd)

    def _closer(
        self, plan: Plan, cuts: Sequence[Nodes], row: int, column: int, place: Window
    ) -> Closer | None:
        """Closer nodes over a piece at its place in the map; None where heights do not bend between
        those of the plan.
        """
        if not self._fine:
            return None
        step = FINE[self.surface.cell >= FINE[1] * self.grid.gsd * 0.99]
        x, y, z = node_places(self.grid, self.surface, place, step)
        rows, columns = (
            slice(at // STEP, at // STEP - (-n // STEP) + 2)
            for at, n in ((row, place.height), (column, place.width))
        )
        straight = np.asarray(plan.z[rows, columns], np.float32)
        size = (step * (z.shape[0] - 2), step * (z.shape[1] - 2))
        middle = slice(step // 2, None, step)
        bent = np.abs(z[1:-1, 1:-1] - densify(straight, *size)[middle, middle]).max()
        return Closer(x=x, y=y, z=z, step=step) if self._shifts(float(bent), cuts) else None

    def _stepped(self, place: Window, cuts: Sequence[Nodes]) -> Stepped | None:
        """The heights of the pixels of a piece that these photos show; None where they do not step,
        or shift no photo visibly.
        """
        if not self._fine:
            return None
        found = stepped_heights(self.grid, self.surface, place, [n.view for n in cuts])
        return found if found is not None and self._shifts(found.range_m, cuts) else None

    @property
    def _fine(self) -> bool:
        """Whether photos are drawn on heights finer than the nodes."""
        return self.detailed and self.surface.cell < STEP * self.grid.gsd

    def _shifts(self, height_m: float, cuts: Sequence[Nodes]) -> bool:
        """Whether such a difference in height shifts one of these photos visibly."""
        aside = max(float(n.score.max()) for n in cuts)
        return bool(height_m * np.sqrt(aside) > BENT * self.grid.gsd)

    def _layer(self, n: Nodes, part: Part, place: Window, *, alone: bool) -> Layer:
        """One photo over a piece at its place in the map, filled only within the part."""
        h, w = place.height, place.width
        size = part.height, part.width
        width = None if self.labels is None or alone else self.blend.seam_px
        pixels, score = self._warped(n, *size, ranked=width is None and not alone)
        if size != (h, w):
            at = slice(part.row, part.row + size[0]), slice(part.column, part.column + size[1])
            pixels = _embedded(pixels, 0, *at, h, w)
            score = _embedded(score, np.inf, *at, h, w)
        slope = None
        if self.labels is not None and width is not None:
            score += 1 - self.labels.share(n.view.photo, place, width)
            slope = self.labels.slope(width)
        return Layer(
            photo=n.view.photo,
            pixels=pixels,
            score=score,
            slope=slope,
            centre=(float(n.view.pose.map_C[0]), float(n.view.pose.map_C[1])),
            height=n.height,
        )

    def _warped(
        self, n: Nodes, h: int, w: int, *, ranked: bool
    ) -> tuple[NDArray[Any], NDArray[np.float32]]:
        """Pixels (h, w, bands) and scores (h, w) of a photo over the area of these nodes; scores
        are zero if photos are not `ranked` by them.
        """
        # cv2.remap uses 16-bit coordinates: a cut-out keeps them small
        x, y = n.reach(n.view.camera.height, n.view.camera.width)
        photo = n.view.photo
        image = self.pixels(photo)[y, x] if self.parts is None else self.parts(photo, y, x)
        u, v = n.pixels(h, w, x, y)
        score = densify(n.score, h, w, n.step) if ranked else np.zeros((h, w), np.float32)
        if not n.seen.all():
            start = np.float32(x.start), np.float32(y.start)
            within = inside_everywhere(n, u + start[0], v + start[1])
            if n.levels is not None:  # at the photo's rim it may show places only on slopes
                sloping = replace(n, levels=None, rise=None)
                su, sv = sloping.pixels(h, w, x, y)
                more = inside_everywhere(sloping, su + start[0], sv + start[1]) & ~within
                u[more], v[more] = su[more], sv[more]
                within |= more
            np.copyto(score, np.float32(np.inf), where=~within)
        warped = _remapped(image, u, v)
        if self.valued:
            np.copyto(score, np.float32(np.inf), where=np.isnan(warped).all(2))
        return self._exposed(n, warped), score

    def _exposed(self, n: Nodes, warped: NDArray[Any]) -> NDArray[Any]:
        photo = n.view.photo
        if photo in self.exposure.offsets and warped.dtype.kind == "f":
            level = warped + np.float32(self.exposure.offsets[photo])
            if photo not in self.exposure.patterns:
                return level
            camera = n.view.camera
            own = at(self.exposure.patterns[photo], n.u, n.v, camera.width, camera.height)
            added = densify(own, warped.shape[0], warped.shape[1], n.step)
            return np.asarray(level + added.reshape(*warped.shape[:2], 1), warped.dtype)
        if photo not in self.exposure.gains or warped.dtype.kind != "u":
            return warped
        if warped.dtype != np.uint8 or self.exposure.uneven(photo):
            coarse = self.exposure.odds(photo, *image_place(n.view, n.u, n.v))
            odds = densify(coarse, warped.shape[0], warped.shape[1], n.step).reshape(warped.shape)
            if warped.dtype == np.uint8:
                return with_odds(warped, odds, self.exposure.white)
            bright = self.exposure.brightened(warped.astype(np.float32), odds)
            return np.asarray(np.rint(bright), warped.dtype)
        table = self.exposure.table(photo)
        return warped if table is None else np.asarray(cv2.LUT(warped, table)).reshape(warped.shape)


def _remapped(image: NDArray[Any], u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[Any]:
    """Pixels (h, w, bands) of an image at columns u and rows v (h, w)."""
    if image.dtype == np.uint8 and image.shape[2:] == (3,) and image.size <= MOST_PADDED * u.size:
        # OpenCV warps four bands in half the time of three, including the conversion
        four = cv2.cvtColor(image, cv2.COLOR_RGB2RGBA)
        warped = cv2.remap(four, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(cv2.cvtColor(warped, cv2.COLOR_RGBA2RGB))
    warped = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped).reshape(*u.shape, -1)


def _part(nodes: Nodes, near: NDArray[np.bool_], place: Window) -> Part:
    """The bounding box of the cells (r, c) of a piece in which a photo can be visible."""
    rows = _extent(np.asarray(near.any(1)), place.height)
    columns = _extent(np.asarray(near.any(0)), place.width)
    size = rows.stop - rows.start, columns.stop - columns.start
    return Part(
        nodes=cut(nodes, rows.start, columns.start, *size),
        row=rows.start,
        column=columns.start,
        height=size[0],
        width=size[1],
    )


def _extent(needed: NDArray[np.bool_], size: int) -> slice:
    """The pixels, of `size`, from the first to the last needed cell."""
    at = np.flatnonzero(needed)
    return slice(int(at[0]) * STEP, min((int(at[-1]) + 1) * STEP, size))


def _embedded(
    part: NDArray[Any], empty: float, rows: slice, columns: slice, h: int, w: int
) -> NDArray[Any]:
    """Inserts a part (rows, columns[, bands]) in an empty piece (h, w[, bands])."""
    shape = (h, w, *part.shape[2:])
    out = np.full(shape, empty, part.dtype) if empty else np.zeros(shape, part.dtype)
    out[rows, columns] = part
    return out
