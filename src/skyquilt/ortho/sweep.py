"""Heights where tie points are sparse: a plane sweep over the ground, from the two best views of
every place.

The ground is orthorectified from two photos, the most vertical view and the most vertical one from
another place, at many heights around the current surface. The height at which the two images agree
best is kept. Coarse images find tree crowns and roofs, finer images refine the heights. The method
follows Collins (1996), on a map grid instead of an image.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import STEP, Nodes, View, densify, project_nodes
from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface

Float = NDArray[np.float32]
GreyPicture = Callable[[int, int], NDArray[np.uint8]]
"""Gives the grey image (h, w) of a photo (index), reduced to the given px on its longest side."""
TILE = 256
"""Pixels of a piece swept at a time."""
MARGIN = 16
"""Pixels that neighbouring pieces share."""


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Coarse-to-fine plane sweep."""

    sides: tuple[int, ...] = (400,)
    """Longest side in px of the images of each pass."""
    below: float = 0.05
    """Search range below the current surface in the first pass, as a share of the flying height."""
    above: float = 0.05
    """Search range above it, as a share of the flying height."""
    window: int = 7
    """Side in px of the window that must agree."""
    agree: float = 0.55
    """Least correlation for a height to be accepted."""
    smoothing_cells: float = 1.0
    """Standard deviation of the final Gaussian in cells."""
    version: ClassVar[int] = 3

    def __call__(
        self,
        surface: Surface,
        views: Sequence[View],
        grid: Grid,
        grey: GreyPicture,
        keep: object = None,
    ) -> Surface:
        """The surface with the heights found; unchanged where the images do not agree. `keep` is
        not used: a sweep is made in one go.
        """
        height = float(np.median([v.pose.map_C[2] for v in views]) - np.median(surface.z))
        if len(views) < 2 or height <= 0:
            return surface
        # length in m that the longest side of an image covers on the ground
        extent = float(
            np.median(
                [height / v.camera.focal * max(v.camera.width, v.camera.height) for v in views]
            )
        )
        for number, side in enumerate(self.sides):
            low, high = (-self.below * height, self.above * height) if number == 0 else (-3.0, 3.0)
            work, z, trust = self.searched(
                surface,
                views,
                grid,
                grey,
                side,
                extent / side,
                height,
                (low, high),
                relative=number > 0,
            )
            surface = self._fused(surface, work, z, trust)
        return surface

    def searched(
        self,
        surface: Surface,
        views: Sequence[View],
        grid: Grid,
        grey: GreyPicture,
        side: int,
        gsd: float,
        height: float,
        span: tuple[float, float],
        *,
        relative: bool,
    ) -> tuple[Grid, Float, Float]:
        """A grid of cells of gsd m, the heights on it (h, w) in m, and the correlation of the two
        images there (h, w), 0 where they do not agree. Images have `side` px on their longest side,
        cameras are `height` m above ground; `span` in m, or in steps of about one pixel of
        disparity when `relative`.
        """
        w, s, e, n = grid.bounds
        work = Grid(
            west=w, north=n, gsd=gsd, width=int((e - w) / gsd) + 1, height=int((n - s) / gsd) + 1
        )
        z = np.zeros((work.height, work.width), np.float32)
        trust = np.zeros_like(z)
        for row in range(0, work.height, TILE):
            for column in range(0, work.width, TILE):
                piece = self._piece(
                    surface, views, work, grey, side, height, span, relative, row, column
                )
                h, c = min(TILE, work.height - row), min(TILE, work.width - column)
                inner = (slice(row, row + h), slice(column, column + c))
                z[inner], trust[inner] = piece[0][:h, :c], piece[1][:h, :c]
        return work, z, trust

    def _piece(
        self,
        surface: Surface,
        views: Sequence[View],
        work: Grid,
        grey: GreyPicture,
        side: int,
        height: float,
        span: tuple[float, float],
        relative: bool,
        row: int,
        column: int,
    ) -> tuple[Float, Float]:
        """Heights and correlation (TILE, TILE) of a piece."""
        full = TILE + 2 * MARGIN
        cells = np.arange(-1, full // STEP + 1) + 0.5
        x, y = np.meshgrid(
            work.x(column - MARGIN + STEP * cells - 0.5), work.y(row - MARGIN + STEP * cells - 0.5)
        )
        ground = surface.at(x, y)
        box = (float(x[0, 0]), float(y[-1, 0]), float(x[0, -1]), float(y[0, 0]))
        nodes = [project_nodes(v, x, y, ground) for v in views if v.overlaps(box)]
        first, second, step = pair_labels([n for n in nodes if n.seen.any()], work.gsd)
        inner = slice(MARGIN, MARGIN + TILE)
        start = densify(ground, full, full)
        if first is None or second is None:
            return start[inner, inner], np.zeros((TILE, TILE), np.float32)
        low, high = (span[0] * step, span[1] * step) if relative else span
        offsets = np.arange(low, high + 0.5 * step, step).astype(np.float32)
        heights = ground + offsets[:, None, None]
        pictures = [_shown(labels, views, x, y, heights, grey, side) for labels in (first, second)]
        scores = np.stack(
            [_agreement(a, b, self.window)[inner, inner] for a, b in zip(*pictures, strict=True)]
        )
        best, trust = _summit(scores, offsets)
        return start[inner, inner] + best, np.where(trust > self.agree, trust, 0).astype(np.float32)

    def _fused(self, surface: Surface, work: Grid, z: Float, trust: Float) -> Surface:
        """Medians of accepted heights in cells of four pixels; gaps keep the current surface."""
        cell = 4
        rows, columns = -(-work.height // cell), -(-work.width // cell)
        coarse = work.coarser(cell)
        known = surface.on(coarse.x(np.arange(columns)), coarse.y(np.arange(rows)))
        pad = ((0, rows * cell - work.height), (0, columns * cell - work.width))
        blocks = [
            np.pad(a, pad)
            .reshape(rows, cell, columns, cell)
            .transpose(0, 2, 1, 3)
            .reshape(rows, columns, -1)
            for a in (z, trust)
        ]
        believed = np.where(blocks[1] > 0, blocks[0], np.nan)
        number = (blocks[1] > 0).sum(2)
        with np.errstate(all="ignore"):
            middle = np.where(number >= cell * cell // 3, _nanmedian(believed), np.nan)
        weight = np.where(np.isfinite(middle), 1.0, 0.05).astype(np.float32)
        value = np.where(np.isfinite(middle), middle, known).astype(np.float32)
        value = np.asarray(cv2.medianBlur(value, 5), np.float32)
        spread = self.smoothing_cells
        total = cv2.GaussianBlur(weight, (0, 0), spread)
        smooth = cv2.GaussianBlur(value * weight, (0, 0), spread) / total
        x0, y0 = float(coarse.x(np.array(0))), float(coarse.y(np.array(rows - 1)))
        return Surface(
            z=np.ascontiguousarray(smooth[::-1]),
            x0=x0,
            y0=y0,
            cell=coarse.gsd,
            source="tie points and sweep",
        )


def _nanmedian(values: Float) -> Float:
    """Median over the last axis, NaN ignored; sorting puts NaN last."""
    ordered = np.sort(values, axis=-1)
    number = np.isfinite(values).sum(-1)
    index = np.maximum(number - 1, 0) // 2
    return np.asarray(np.take_along_axis(ordered, index[..., None], -1)[..., 0])


def pair_labels(
    nodes: Sequence[Nodes], gsd: float
) -> tuple[NDArray[np.int32] | None, NDArray[np.int32] | None, float]:
    """Per node the most vertical photo and the most vertical one seen from elsewhere (-1 = none),
    and the height step in m that shifts one image against the other by about one pixel of gsd.
    """
    if len(nodes) < 2:
        return None, None, 0.0
    scores = np.stack([np.where(n.seen, n.score, np.float32(np.inf)) for n in nodes])
    best = scores.argmin(0)
    number = np.array([n.view.photo for n in nodes], np.int32)
    centre = np.array([n.view.pose.map_C[:2] for n in nodes])
    height = np.array([n.height for n in nodes])
    apart = np.hypot(*(centre[:, None] - centre[None]).transpose(2, 0, 1)) / height[:, None]
    other = np.where(apart[best].transpose(2, 0, 1) > 0.15, scores, np.float32(np.inf))
    second = other.argmin(0)
    have = np.isfinite(np.take_along_axis(other, second[None], 0)[0])
    if not have.any():
        return None, None, 0.0
    base = float(np.median(apart[best[have], second[have]]))
    first = np.where(have, number[best], -1)
    return first, np.where(have, number[second], -1), gsd / max(base, 0.05)


def _shown(
    labels: NDArray[np.int32],
    views: Sequence[View],
    x: NDArray[Any],
    y: NDArray[Any],
    z: NDArray[Any],
    grey: GreyPicture,
    side: int,
) -> Float:
    """The ground orthorectified from the labelled photos at each of k heights z (k, r + 2, c + 2),
    as (k, r, c) in pixels instead of nodes; NaN where there is no photo.
    """
    inner = labels[1:-1, 1:-1]
    out = np.full((len(z), inner.shape[0] * STEP, inner.shape[1] * STEP), np.nan, np.float32)
    for photo in np.unique(inner[inner >= 0]).tolist():
        view = next(v for v in views if v.photo == photo)
        rows, columns = np.nonzero(inner == photo)
        r0, r1, c0, c1 = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
        box = (slice(r0, r1 + 2), slice(c0, c1 + 2))
        n = project_nodes(view, x[box], y[box], z[(slice(None), *box)])
        picture = grey(photo, side)
        scale = np.float32(picture.shape[1] / view.camera.width)
        h, w = int(r1 - r0) * STEP, int(c1 - c0) * STEP
        mine = inner[r0:r1, c0:c1] == photo
        for k, (u, v, seen) in enumerate(
            zip((n.u + 0.5) * scale - 0.5, (n.v + 0.5) * scale - 0.5, n.seen, strict=True)
        ):
            warped = cv2.remap(
                picture,
                densify(u, h, w),
                densify(v, h, w),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            cells = mine & seen[1:-1, 1:-1]
            dense = np.repeat(np.repeat(cells, STEP, 0), STEP, 1)
            target = out[k, r0 * STEP : r1 * STEP, c0 * STEP : c1 * STEP]
            np.copyto(target, warped, where=dense, casting="unsafe")
    return out


def _agreement(a: Float, b: Float, window: int) -> Float:
    """Normalised cross-correlation of two images in a sliding window; -1 where either is
    missing.
    """
    missing = np.isnan(a) | np.isnan(b)
    whole = not missing.any()
    if not whole:
        a, b = np.where(missing, 0, a), np.where(missing, 0, b)
    size = (window, window)
    ma, mb = cv2.blur(a, size), cv2.blur(b, size)
    va = cv2.blur(a * a, size) - ma * ma
    vb = cv2.blur(b * b, size) - mb * mb
    score = (cv2.blur(a * b, size) - ma * mb) / np.sqrt(np.maximum(va, 4.0) * np.maximum(vb, 4.0))
    if whole:
        return np.asarray(score)
    near = cv2.dilate(missing.astype(np.uint8), np.ones(size, np.uint8)) > 0
    return np.where(near, np.float32(-1), score)


def _summit(scores: Float, offsets: Float) -> tuple[Float, Float]:
    """Offset of the best score per pixel, refined by a parabola, and that score; 0 at
    the ends of the search.
    """
    best = scores.argmax(0)
    top = np.take_along_axis(scores, best[None], 0)[0]
    inner = np.clip(best, 1, len(offsets) - 2)
    left, mid, right = (np.take_along_axis(scores, (inner + k)[None], 0)[0] for k in (-1, 0, 1))
    curve = left - 2 * mid + right
    shift = np.where(
        curve < -1e-4, np.clip(0.5 * (left - right) / np.minimum(curve, -1e-4), -0.5, 0.5), 0
    )
    step = offsets[1] - offsets[0] if len(offsets) > 1 else np.float32(0)
    at_end = (best == 0) | (best == len(offsets) - 1)
    return (offsets[best] + shift * step).astype(np.float32), np.where(at_end, 0, top).astype(
        np.float32
    )
