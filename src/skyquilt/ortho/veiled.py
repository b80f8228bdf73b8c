"""Smoke, fog and haze that veil a part of single photos: shown only where no other photo shows the
ground.

A veil mixes what lies beneath it with its own even tone, so fine contrast falls (Koschmieder 1924):
the logarithm of grey values differs less from its surroundings than in photos that show the same
ground clearly. Light and shade act as a factor and leave that contrast as it is.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.blank import EMPTY, Blank
from skyquilt.imaging.grey import to_grey8
from skyquilt.imaging.nodes import Nodes, View, project_nodes
from skyquilt.imaging.view_limits import ground_sizes
from skyquilt.photos.side_rows import sentence_of

Float = NDArray[np.float32]
_Look = tuple[NDArray[np.int32], NDArray[np.int16], Float]
"""Ground points that a photo shows, the cells of its picture with them, and its contrast there."""

FINE, WINDOW = 5, 13
"""Sides in px of a reduced picture: of what fine contrast is told from, and of windows over which
it is averaged.
"""
DARK = 8.0
"""Added to grey values before their logarithm is taken, since the darkest are noise."""
NOISE, LEAST = 0.01, 0.03
"""Contrast of noise, and least contrast of ground that can tell: water has less."""
SIDE, CELLS = 28, 32
"""Ground points along a side of a photo of the usual size, and cells of the picture along its
longer side.
"""
ALIKE = 1.3
"""Largest quotient of the ground sizes of photos that are compared, and of their parts."""
FEWEST_VIEWS = 3
"""Fewest photos that must show a place; the second clearest of them tells what it looks like."""
TIED, NEAR = 3, 7
"""So many tie points must lie within so many squares a side: waves and glitter have none."""
SURELY, SURE_SHARE = 0.5, 0.05
"""There are veils where a part of a picture, at least such a share of it, lies so far below others
in the logarithm of contrast, even where these show least around: a tree or a roof that leans over
the ground in other photos has contrast, too, but not everywhere. Shares of clear photos reach 0.026
(18 surveys); the largest of five flights over fires are 0.08 to 0.21.
"""
VEILED, SHARE, PARTLY = 0.4, 0.02, 0.2
"""Then a part is veiled where it lies so far below, on such a share of the picture, and goes on
where it lies so far below. Of clear parts nine tenths lie less than 0.3 below; a veil that takes
six tenths of the light lies 0.6 to 1.6 below.
"""
MARGIN = 0.2
"""Width in footprints of the strip around a photo's in which its ground may lie."""
KNOWN = 0.3
"""Known share of the cells around one that tells of it."""


def veiled_note(names: Sequence[str]) -> str:
    """A note about photos of these names, at least one."""
    some = f"{len(names)} photos show" if len(names) > 1 else "One photo shows"
    return (
        f"{some} a part of the ground through smoke, fog or haze, or with far less contrast than"
        f" others ({sentence_of(names)}). That part is drawn only where no other photo shows the"
        " ground."
    )


def veiled_parts(
    views: Sequence[View],
    xyz: NDArray[Any],
    thumbnails: Mapping[int, NDArray[Any]],
    fixed: Mapping[int, Blank],
    *,
    least: float = SURE_SHARE,
    spoilt: Collection[int] = (),
) -> dict[int, Blank]:
    """What smoke, fog or haze veils in photos, by photo, only of photos where something is.

    `views` of level ground; `xyz`: tie points (n, 3) on their ground, at least one; `thumbnails`:
    (h, w[, bands]) of the photos, of 8 bits; `fixed`: where they show marks; `least`: share of a
    picture that must surely be veiled, of one that does not lack contrast anyway (`spoilt`).
    """
    found = dict[int, Blank]()
    for group in _alike(views):
        if len(group) >= FEWEST_VIEWS:
            found |= _veiled(group, xyz, thumbnails, fixed, least, spoilt)
    return found


def _alike(views: Sequence[View]) -> list[list[View]]:
    """Views in groups of one camera and ground size: finer pictures of the same ground, and those
    of other cameras, have another contrast.
    """
    groups, first = list[list[View]](), np.inf
    cameras = {c: k for k, c in enumerate(dict.fromkeys(v.camera for v in views))}
    sides = {v.photo: _side(v) for v in views}
    for view in sorted(views, key=lambda v: (cameras[v.camera], sides[v.photo], v.photo)):
        side = sides[view.photo]
        if not groups or groups[-1][0].camera != view.camera or side > ALIKE * first:
            groups.append([])
            first = side
        groups[-1].append(view)
    return groups


def _side(view: View) -> float:
    """Side in m of a square as large as what a photo shows of level ground."""
    return float(np.sqrt(cv2.contourArea(view.footprint.astype(np.float32))))


def _veiled(
    views: Sequence[View],
    xyz: NDArray[Any],
    thumbnails: Mapping[int, NDArray[Any]],
    fixed: Mapping[int, Blank],
    least: float,
    spoilt: Collection[int],
) -> dict[int, Blank]:
    """`veiled_parts` of photos of one camera and ground size."""
    seen = _Ground(views, xyz)
    looks = [seen.look(view, thumbnails[view.photo], fixed.get(view.photo)) for view in views]
    surely = (
        _large(below > SURELY, least).any()
        for view, below in zip(views, _below(views, looks, seen.least()), strict=True)
        if view.photo not in spoilt
    )
    if not any(surely):
        return {}
    found = dict[int, Blank]()
    for view, below in zip(views, _below(views, looks, seen.clearest()), strict=True):
        if (veil := veiled_part(below)) is not None:
            found[view.photo] = Blank(room=veil, size=(view.camera.width, view.camera.height))
    return found


def fine_contrast(thumbnail: NDArray[Any]) -> Float:
    """Logarithm (h, w) of the fine contrast around each pixel of a reduced picture (h, w[, bands])
    of 8 bits; NaN beside pixels that show nothing.
    """
    grey = to_grey8(thumbnail)
    log = cv2.LUT(grey, np.log(np.arange(256) + DARK).astype(np.float32))
    fine = cv2.absdiff(log, cv2.blur(log, (FINE, FINE)))
    told = np.log(cv2.blur(fine, (WINDOW, WINDOW)) + NOISE)
    empty = (cv2.blur(grey, (3, 3)) <= EMPTY).view(np.uint8)
    told[cv2.dilate(empty, np.ones((WINDOW, WINDOW), np.uint8)) > 0] = np.nan
    return np.asarray(told, np.float32)


def cells_of(width: int, height: int) -> tuple[int, int]:
    """Rows and columns of the cells of a picture of a size in px."""
    cell = max(width, height) / CELLS
    return max(1, round(height / cell)), max(1, round(width / cell))


def veiled_part(below: Float) -> Float | None:
    """How far outside of its veiled part each cell of a picture lies, negative within, from how far
    its contrast lies below that of other photos (rows, columns), 0 where it is not known; None
    where no large part is veiled.
    """
    seeds = _large(below > VEILED, SHARE)
    if not seeds.any():
        return None
    _, part = cv2.connectedComponents((below > PARTLY).view(np.uint8), connectivity=8)
    veil = np.isin(part, np.unique(part[seeds]))
    return np.where(veil | (below <= PARTLY), PARTLY - below, 1.0).astype(np.float32)


def _large(mask: NDArray[np.bool_], share: float) -> NDArray[np.bool_]:
    """Connected parts of a mask that are at least such a share of it."""
    _, part, found, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    large = found[:, cv2.CC_STAT_AREA] >= share * mask.size
    large[0] = False  # what lies outside of the mask
    return np.asarray(large[part])


def _below(views: Sequence[View], looks: Sequence[_Look], usual: Float) -> Iterator[Float]:
    """How far the contrast of each photo lies below what is usual at ground points (n,), NaN where
    that is not known: (rows, columns) of its cells, 0 where few cells around one are known.
    """
    for view, (point, cell, contrast) in zip(views, looks, strict=True):
        off = usual[point] - contrast
        known = np.isfinite(off)
        yield _raster(cell[known], off[known], cells_of(view.camera.width, view.camera.height))


def _raster(cell: NDArray[Any], value: NDArray[Any], shape: tuple[int, int]) -> Float:
    """Values (n,) of cells (their numbers) as a raster, each with the cells around it; 0 where
    few of these are known.
    """
    n = shape[0] * shape[1]
    count, total = (
        _around(np.bincount(cell, weight, n).reshape(shape), 3) for weight in (None, value)
    )
    return np.where(count > 9 * KNOWN, total / np.maximum(count, 9 * KNOWN), 0).astype(np.float32)


def _around(raster: NDArray[Any], side: int) -> Float:
    """Sums (h, w) over the squares of a raster's cells around each, so many cells a side."""
    return np.asarray(
        cv2.boxFilter(
            raster.astype(np.float32),
            -1,
            (side, side),
            normalize=False,
            borderType=cv2.BORDER_CONSTANT,
        ),
        np.float32,
    )


class _Ground:
    """Points of the ground, and the contrast of the two photos that show each most clearly."""

    def __init__(self, views: Sequence[View], xyz: NDArray[Any]) -> None:
        outline = np.concatenate([v.footprint for v in views])
        low, high = outline.min(0), outline.max(0)
        self._step = max(float(np.median([_side(v) for v in views])) / SIDE, 1e-6)
        self._low = low
        columns, rows = (np.ceil((high - low) / self._step).astype(int) + 1).tolist()
        self._shape = rows, columns
        self._two = np.full((2, rows * columns), -np.inf, np.float32)
        self._views = np.zeros(rows * columns, np.int32)
        at = np.rint((xyz[:, :2] - low) / self._step).astype(int)
        inside = ((at >= 0) & (at < (columns, rows))).all(1)
        point, middle = at[inside] @ (1, columns), float(np.median(xyz[:, 2]))
        ties, rise = (
            _around(np.bincount(point, weight, rows * columns).reshape(self._shape), NEAR)
            for weight in (None, xyz[inside, 2] - middle)
        )
        self._z = middle + rise / np.maximum(ties, 1)
        self._tied = ties.ravel() > TIED - 0.5

    def look(self, view: View, thumbnail: NDArray[Any], mark: Blank | None) -> _Look:
        """What a photo shows, without what shows nothing or a mark."""
        low, high = view.footprint.min(0), view.footprint.max(0)
        margin = MARGIN * float((high - low).max())  # it was found on level ground
        first = np.floor((low - margin - self._low) / self._step).astype(int)
        last = np.ceil((high + margin - self._low) / self._step).astype(int)
        c = np.arange(max(first[0], 0), min(last[0] + 1, self._shape[1]))
        r = np.arange(max(first[1], 0), min(last[1] + 1, self._shape[0]))
        x, y = np.meshgrid(self._low[0] + self._step * c, self._low[1] + self._step * r)
        nodes = project_nodes(view, x, y, self._z[r[0] : r[-1] + 1, c[0] : c[-1] + 1])
        seen = nodes.seen if mark is None else nodes.seen & (mark.at(nodes.u, nodes.v) > 0)
        width, height = view.camera.width, view.camera.height
        seen = seen & self._as_usual(nodes, _side(view) / np.sqrt(width * height))
        point = (r[:, None] * self._shape[1] + c)[seen]
        across, down = (nodes.u[seen] + 0.5) / width, (nodes.v[seen] + 0.5) / height
        contrast = fine_contrast(thumbnail)
        rows, columns = contrast.shape
        value = contrast[
            np.clip((down * rows).astype(int), 0, rows - 1),
            np.clip((across * columns).astype(int), 0, columns - 1),
        ]
        rows, columns = cells_of(width, height)
        cell = np.clip((down * rows).astype(int), 0, rows - 1) * columns
        cell += np.clip((across * columns).astype(int), 0, columns - 1)
        known = np.isfinite(value)
        point, value = point[known], value[known]
        self._views[point] += 1
        most, second = self._two[:, point]
        self._two[0, point] = np.maximum(most, value)
        self._two[1, point] = np.maximum(second, np.minimum(most, value))
        return point.astype(np.int32), cell[known].astype(np.int16), value

    def _as_usual(self, nodes: Nodes, usual_m: float) -> NDArray[np.bool_]:
        """Where (r, c) a photo's pixel shows about as much ground as its pixels do on the whole: a
        photo that looks aslant shows far ground coarser, so with less contrast.
        """
        if min(nodes.u.shape) < 2:
            return np.zeros(nodes.u.shape, np.bool_)
        with np.errstate(invalid="ignore"):
            times = ground_sizes(nodes.u, nodes.v, self._step) / usual_m
        return np.asarray((times < ALIKE) & (times > 1 / ALIKE))

    def clearest(self) -> Float:
        """The second largest contrast of all points, NaN where they tell nothing of a photo."""
        return self._told(self._two[1])

    def least(self) -> Float:
        """The same, or less where it is less at a point around that enough photos show."""
        shown = np.where(self._views >= FEWEST_VIEWS, self._two[1], np.float32(np.inf))
        around = cv2.erode(shown.reshape(self._shape), np.ones((3, 3), np.uint8))
        return self._told(np.asarray(around.ravel(), np.float32))

    def _told(self, contrast: Float) -> Float:
        tells = self._tied & (self._views >= FEWEST_VIEWS) & (contrast > np.log(LEAST))
        return np.where(tells, contrast, np.float32(np.nan))
