"""Heights where none were measured: gaps are filled, and the rim goes over to a plane."""

from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.model.surface import STRIP

Float = NDArray[np.float32]
Mask = NDArray[np.bool_]
COARSE = 64
"""Cells along the longer side of the raster in which planes are fitted."""
WHOLE, BEYOND, COARSER = 2048, 512, 8
"""Rows of heights filled at a time, those looked at beyond them, and the step of the rows and
columns that fill what is further away.
"""
AT_ONCE = 1_000_000
"""Cells whose surroundings are looked at at once, about."""
BAND = 1024
"""Rows of heights that are levelled at a time."""
FIRM = 0.25
"""Share of the cells around with a height of their own from which these are believed."""
LEVEL = 5
"""Side in cells of the window in which heights are smoothed."""
STIFF = 0.002
"""Weight of a prior of zero for the slope of a plane."""
FEW = 0.05
"""Weight of a cell with other heights, in place of one that is supported."""
Others = Callable[[slice], tuple[Float, Mask]]
"""Gives other heights (n, w) for rows of a raster, and where they are worth something."""


def filled(z: Float, known: Mask) -> Float:
    """Heights (h, w) with gaps filled by averages of what is known nearby (pull-push: Gortler et
    al. 1996): next to known cells from these, further away from wider surroundings.
    """
    levels = [(np.where(known, z, 0).astype(np.float32), known.astype(np.float32))]
    while min(levels[-1][1].shape) > 1 and levels[-1][1].min() == 0:
        levels.append(_pulled(*levels[-1]))
    value = _mean(*levels[-1])
    for total, weight in reversed(levels[:-1]):
        wide: Any = (total.shape[1], total.shape[0])
        above = np.asarray(cv2.resize(value, wide, interpolation=cv2.INTER_LINEAR))
        value = np.where(weight > 0, _mean(total, weight), above).astype(np.float32)
    return value


def _pulled(total: Float, weight: Float) -> tuple[Float, Float]:
    """Sums and weights over blocks of 2 x 2; a block counts once at most."""
    pad = ((0, total.shape[0] % 2), (0, total.shape[1] % 2))
    sums = []
    for part in (total, weight):
        p = np.pad(part, pad)
        sums.append(p[::2, ::2] + p[1::2, ::2] + p[::2, 1::2] + p[1::2, 1::2])
    scale = 1 / np.maximum(sums[1], 1)
    return (sums[0] * scale).astype(np.float32), (sums[1] * scale).astype(np.float32)


def _mean(total: Float, weight: Float) -> Float:
    return np.asarray(total / np.maximum(weight, 1e-6), np.float32)


def settled(z: Float, support: Mask, others: Others | None = None) -> Float:
    """Heights (h, w) that beyond their support are those of the local plane: fitted to the
    supported heights around, its slope drawn towards zero where few determine it. So what a rim
    shows is a photo on a plane, not on heights continued from a few points. Far from the support
    `others` take the plane's place where they are worth something, and planes are fitted to them
    too. The array itself is changed, and returned.
    """
    if support.all() or not support.any():
        return z
    plane, far = _planes(z, support, others)
    down, across = (_between(n, small) for n, small in zip(z.shape, plane.shape, strict=True))
    for row in range(0, len(z), STRIP):
        rows = slice(row, row + STRIP)
        beyond = ~support[rows]
        if not beyond.any():
            continue
        here = down[rows] @ plane @ across.T
        if others is not None:
            heights, worth = others(rows)
            here += worth * (down[rows] @ far @ across.T) * (heights - here)
        z[rows][beyond] = here[beyond]
    return z


def _planes(z: Float, support: Mask, others: Others | None) -> tuple[Float, Float]:
    """Heights of planes fitted to the heights around each cell of a raster of at most COARSE cells
    a side, by weighted least squares, and the share (0 to 1) of other heights in these.
    """
    h, w = z.shape
    factor = max(1.0, max(h, w) / COARSE)
    small = (max(2, round(h / factor)), max(2, round(w / factor)))
    down, across = _shares(h, small[0]), _shares(w, small[1]).T
    weight, mean, other = (np.zeros(small, np.float32) for _ in range(3))
    for row in range(0, h, STRIP):
        rows = slice(row, row + STRIP)
        weight += down[:, rows] @ (support[rows].astype(np.float32) @ across)
        mean += down[:, rows] @ (np.where(support[rows], z[rows], np.float32(0)) @ across)
        if others is not None:
            heights, worth = others(rows)
            part = np.float32(FEW) * (worth & ~support[rows])
            other += down[:, rows] @ (part @ across)
            mean += down[:, rows] @ ((part * heights) @ across)
    weight += other
    base = float(mean.sum() / weight.sum())
    total = mean - base * weight
    y, x = np.mgrid[: small[0], : small[1]].astype(np.float32) / COARSE

    def around(part: NDArray[Any], share: float) -> NDArray[np.float64]:
        return np.asarray(
            cv2.GaussianBlur(
                part.astype(np.float64), (0, 0), COARSE * share, borderType=cv2.BORDER_CONSTANT
            )
        )

    def spread(part: NDArray[Any]) -> NDArray[np.float64]:
        # a wide and a very wide surrounding: the second only counts where the first is empty
        return around(part, 1 / 12) + 1e-3 * around(part, 1 / 3)

    mass = spread(weight)
    cx, cy, m = (spread(part) / mass for part in (weight * x, weight * y, total))
    vxx = spread(weight * x * x) / mass - cx * cx + STIFF
    vyy = spread(weight * y * y) / mass - cy * cy + STIFF
    vxy = spread(weight * x * y) / mass - cx * cy
    mx, my = spread(total * x) / mass - cx * m, spread(total * y) / mass - cy * m
    det = vxx * vyy - vxy * vxy
    sx, sy = (vyy * mx - vxy * my) / det, (vxx * my - vxy * mx) / det
    plane = base + m + sx * (x - cx) + sy * (y - cy)
    return np.asarray(plane, np.float32), np.asarray(spread(other) / mass, np.float32)


def _shares(n: int, small: int) -> Float:
    """(small, n) weights of means over `small` equal ranges of n cells."""
    ends = np.linspace(0, n, small + 1)
    inside = np.minimum(ends[1:, None], np.arange(1, n + 1))
    inside -= np.maximum(ends[:-1, None], np.arange(n))
    return np.asarray(np.maximum(inside, 0) * (small / n), np.float32)


def _between(n: int, small: int) -> Float:
    """(n, small) weights of linear interpolation between `small` ranges of n cells."""
    place = np.clip((np.arange(n) + 0.5) * (small / n) - 0.5, 0, small - 1)
    return np.asarray(np.maximum(1 - np.abs(place[:, None] - np.arange(small)), 0), np.float32)


def nearest_known(z: Float, known: Mask) -> Float:
    """Heights (h, w) with gaps filled by the nearest known one: they end in cliffs. A photo drawn
    on a slope between a crown and the ground beside it would become a streak. The array itself is
    filled, and returned.

    Heights of more than `WHOLE` rows are filled in bands: cells from which nothing is known within
    `BEYOND` rows take what is nearest of every `COARSER`-th row and column.
    """
    rough_known = known[::COARSER, ::COARSER]
    if len(z) <= WHOLE or not rough_known.any():
        z[:] = _nearest(z, known)[0]
        return z
    rough = _nearest(z[::COARSER, ::COARSER], rough_known)[0]
    columns = np.arange(z.shape[1]) // COARSER
    for row in range(0, len(z), WHOLE // 2):
        first, last = max(0, row - BEYOND), min(len(z), row + WHOLE // 2 + BEYOND)
        rows = slice(row - first, min(row + WHOLE // 2, len(z)) - first)
        band, far = z[first:last], np.ones((rows.stop - rows.start, z.shape[1]), np.bool_)
        inner = z[row : row + WHOLE // 2]
        if known[first:last].any():
            whole, away = _nearest(band, known[first:last])
            inner[:] = whole[rows]
            far = away[rows] > BEYOND
        if far.any():
            inner[far] = rough[np.arange(row, row + len(inner)) // COARSER][:, columns][far]
    return z


def _nearest(z: Float, known: Mask) -> tuple[Float, Float]:
    """The same of a raster as a whole, and the distances in cells."""
    away, place = cv2.distanceTransformWithLabels(
        (~known).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(place.max()) + 1, np.float32)
    strips = [slice(row, row + STRIP) for row in range(0, len(z), STRIP)]
    for rows in strips:
        table[place[rows][known[rows]]] = z[rows][known[rows]]
    out = z.copy()
    for rows in strips:
        gap = ~known[rows]
        out[rows][gap] = table[place[rows][gap]]
    return out, np.asarray(away, np.float32)


def crowns(z: Float, known: Mask, side: int, step: float) -> Float:
    """Heights (h, w) without gaps, measured where `known`: where this is a small share of the cells
    around, as in leaves, they are those of whole crowns, closed and level over windows of `side`
    cells (an odd number) except at cliffs of more than `step` m. The array itself is changed, and
    returned.
    """
    closed = np.empty_like(z)
    kernel = np.ones((side, side), np.uint8)
    for rows, around, inner in bands(len(z), side):
        closed[rows] = cv2.morphologyEx(z[around], cv2.MORPH_CLOSE, kernel)[inner]
    low, span = float(closed.min()), max(float(np.ptp(closed)), 1e-6)
    done: tuple[slice, Any] = (slice(0), z[:0])
    for rows, around, inner in bands(len(z), side // 2 + LEVEL):
        levels = plateaus(closed[around], side, low, span)
        level = cv2.bilateralFilter(levels, LEVEL, step, 2.0)
        share = cv2.boxFilter(known[around].view(np.uint8), cv2.CV_32F, (LEVEL, LEVEL))
        clear = cv2.medianBlur(z[around], LEVEL)
        z[done[0]] = done[1]  # the next band still looks at what this one was
        done = rows, np.where(share > FIRM, clear, level)[inner]
    z[done[0]] = done[1]
    return z


def bands(height: int, beyond: int) -> Iterator[tuple[slice, slice, slice]]:
    """The rows of a raster in bands: which these are, these with `beyond` more on either side, and
    the band's own among those.
    """
    for row in range(0, height, BAND):
        rows = slice(row, min(row + BAND, height))
        first = max(0, row - beyond)
        around = slice(first, min(rows.stop + beyond, height))
        yield rows, around, slice(row - first, rows.stop - first)


def plateaus(z: Float, side: int, low: float, span: float) -> Float:
    """Medians of heights (h, w) over windows of `side` cells, an odd number, to a 255th of their
    range, which begins at `low` and is `span` m wide: crowns become level, and cliffs stay.
    """
    levels = np.rint((z - np.float32(low)) * np.float32(255 / span)).astype(np.uint8)
    return np.asarray(cv2.medianBlur(levels, side) * np.float32(span / 255) + low, np.float32)


def lowered(z: Float, known: Mask, reach: int, step: float) -> Float:
    """Heights (h, w) whose gaps were filled by the nearest known one, as `nearest_known` does, with
    the gaps beside steps of more than `step` m filled from the lower side: what no two photos show
    there is the ground behind something that stands. As in Hirschmueller (2008), the height is
    the second lowest of the nearest known ones in eight directions, within `reach` cells. The
    array itself is changed, and returned.
    """
    rows = max(reach, AT_ONCE // z.shape[1])
    done = []  # bands are written when no later one looks at them any more
    for row in range(0, len(z), rows):
        first, last = max(0, row - reach), min(len(z), row + rows + reach)
        inner = slice(row - first, min(row + rows, len(z)) - first)
        gap = ~known[row : row + rows]
        around = _around(z[first:last], known[first:last], reach, inner)[:, gap]
        around.sort(axis=0)
        number = np.isfinite(around).sum(0)
        low = around[1]
        high = np.take_along_axis(around, np.maximum(number - 2, 0)[None], 0)[0]
        now = z[row : row + rows][gap]
        behind = (number > 2) & (high - low > step) & (now > (high + low) / 2)
        done.append((row, gap, np.where(behind, low, now)))
    for row, gap, heights in done:
        z[row : row + rows][gap] = heights
    return z


def _around(z: Float, known: Mask, reach: int, inner: slice) -> Float:
    """(8, n, w) at each cell of the inner rows the nearest known height in each of eight
    directions, NaN where there is none within `reach` cells.
    """
    found = [part[:, inner] for part in (_above(z, known, reach), _beside(z, known, reach))]
    turned = (z[::-1, ::-1], known[::-1, ::-1])
    for part in (_above(*turned, reach), _beside(*turned, reach)):
        found.append(part[:, ::-1, ::-1][:, inner])
    return np.concatenate(found)


def _above(z: Float, known: Mask, reach: int) -> Float:
    """(3, h, w) the nearest known heights straight above and along both diagonals."""
    out = np.empty((3, *z.shape), np.float32)
    last = np.full((3, z.shape[1]), np.nan, np.float32)
    age = np.zeros(last.shape, np.int32)
    for row, here in enumerate(known):
        for carried, edge in ((last, np.float32(np.nan)), (age, 0)):
            carried[1, 1:], carried[2, :-1] = carried[1, :-1].copy(), carried[2, 1:].copy()
            carried[1, 0] = carried[2, -1] = edge
        age += 1
        out[:, row] = np.where(age <= reach, last, np.float32(np.nan))
        last[:, here] = z[row, here]
        age[:, here] = 0
    return out


def _beside(z: Float, known: Mask, reach: int) -> Float:
    """(1, h, w) the nearest known heights to the left."""
    column = np.arange(z.shape[1], dtype=np.int32)
    last = np.maximum.accumulate(np.where(known, column, np.int32(-reach - 1)), axis=1)
    value = np.take_along_axis(z, np.maximum(last, 0), 1)
    return np.asarray(np.where(column - last <= reach, value, np.float32(np.nan)))[None]
