"""Heights from two photos: both are resampled on one plane and matched along its rows.

The plane lies in the ground and contains the direction of the line between the photos' centres. A
point at the height h over it then lies in one row of both pictures, shifted by h / (H - h) times
the baseline, H being the height of the centres over the plane. Semi-global matching (Hirschmueller
2008, in OpenCV's variant) finds the shift of every pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.grey import shrunken_px, stretched
from skyquilt.imaging.nodes import STEP, View, densify, inside_everywhere, project_nodes

Float = NDArray[np.float32]
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
SUBPIXEL = 16
"""OpenCV gives disparities in sixteenths of a pixel."""
SPECKLE = 60
"""Patches of fewer pixels, apart from their surroundings by more than two, are dropped."""
STEP_COST, JUMP_COST = 2, 16
"""Costs of a disparity that changes by one and by more, per pixel of the window: a quarter and half
of what OpenCV's manual suggests, which rounds off crowns and eaves.
"""
CLIP = 63
"""Slopes of the pictures are compared up to this many grey values."""
TEXTURE = 1.5
"""Least standard deviation of grey values in a window that is compared: more than noise."""
REFINED = 9
"""Side in px of the window over which disparities are refined."""
MOST_BEND = 0.75
"""Disparities that differ by more than this in px within the window are left as they are."""
MOST_STEP = 0.6
"""Largest refinement in px."""
FLAT = 4.0
"""Mean square of slopes, in grey values per px, at which a refinement is halved: noise has as much.
"""
TALLEST = 0.7
"""Largest height over the plane that is searched, as a share of the cameras' height."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Two photos that are matched, and the plane on which they are resampled."""

    a: View
    """The left picture."""
    b: View
    """The right one."""
    origin: Array
    """(3,) place of pixel (0, 0) in m (map frame)."""
    along: Array
    """(3,) unit vector from a to b: the direction of rows."""
    down: Array
    """(3,) horizontal unit vector across it: the direction of columns."""
    size: tuple[int, int]
    """Height and width of the rectified pictures in px."""
    gsd: float
    """Side of a rectified pixel in m."""

    @property
    def base(self) -> float:
        """Distance of the centres in m."""
        return float(np.linalg.norm(self.b.pose.map_C - self.a.pose.map_C))

    @property
    def height(self) -> float:
        """Height of both centres over the plane in m."""
        normal = np.cross(self.down, self.along)
        return abs(float((self.a.pose.map_C - self.origin) @ normal))

    def shift(self, h: float) -> float:
        """Disparity in px of a point at the height h in m over the plane."""
        return h / (self.height - h) * self.base / self.gsd

    def places(self, rows: NDArray[Any], columns: NDArray[Any]) -> Array:
        """(..., 3) places in m of pixels on the plane."""
        return np.asarray(
            self.origin
            + rows[..., None] * (self.gsd * self.down)
            + columns[..., None] * (self.gsd * self.along)
        )

    @property
    def outline(self) -> Array:
        """(4, 3) corners of the plane's part in m."""
        h, w = self.size
        return self.places(np.array([0, 0, h, h]), np.array([0, w, 0, w]))

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north in m of the places that the pair can show."""
        # points above the plane lie closer to the centre: within the hull of corners and centre
        both = np.concatenate([self.outline, self.a.pose.map_C[None]])[:, :2]
        (west, south), (east, north) = both.min(0), both.max(0)
        return float(west), float(south), float(east), float(north)


def pair_of(a: View, b: View, z: float, gsd: float) -> Pair | None:
    """The pair of two photos over ground at about z in m; None if they hardly overlap."""
    along = b.pose.map_C - a.pose.map_C
    along = along / np.linalg.norm(along)
    down = np.array([along[1], -along[0], 0.0])
    down /= np.linalg.norm(down)
    middle = np.array([*((a.pose.map_C + b.pose.map_C) / 2)[:2], z])
    spans = []
    for view in (a, b):
        rim = np.column_stack([view.footprint, np.full(len(view.footprint), z)]) - middle
        spans.append([(p.min(), p.max()) for p in (rim @ down, rim @ along)])
    low = [max(s[k][0] for s in spans) for k in (0, 1)]
    high = [min(s[k][1] for s in spans) for k in (0, 1)]
    height, width = (int((top - least) / gsd) for least, top in zip(low, high, strict=True))
    if min(height, width) < 2 * STEP:
        return None
    origin = middle + low[0] * down + low[1] * along
    return Pair(a=a, b=b, origin=origin, along=along, down=down, size=(height, width), gsd=gsd)


def matched_points(
    pair: Pair,
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    low: float,
    high: float,
    window: int,
) -> Float:
    """Points (n, 3) in m, relative to the pair's origin, between the heights low and high in m over
    the plane, from the grey images of a and b; windows of `window` px are compared.
    """
    left, right = stretched(left, right)
    d, good = _disparities(pair, left, right, low, min(high, TALLEST * pair.height), window)
    along = pair.gsd * d[good]
    share = (along / (np.float32(pair.base) + along)).astype(np.float32)  # of the way to a
    rows, columns = (np.arange(n)[:, None] for n in d.shape)
    beside, below = columns * (pair.gsd * pair.along), rows * (pair.gsd * pair.down)
    centre = (pair.a.pose.map_C - pair.origin).astype(np.float32)
    at = np.empty((len(share), 3), np.float32)
    for k in range(3):  # one axis at a time: several times as fast as rows of three
        own = np.add.outer(below[:, k], beside[:, k]).astype(np.float32)[good]
        at[:, k] = own + (centre[k] - own) * share
    return at


def _disparities(
    pair: Pair,
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    low: float,
    high: float,
    window: int,
) -> tuple[Float, Mask]:
    """Disparities (h, w) in px of picture a, and where they hold."""
    first = int(np.floor(pair.shift(low))) - 1
    number = -(-(int(np.ceil(pair.shift(high))) + 2 - first) // 16) * 16
    left, seen = _rectified(pair, pair.a, left)
    right, seen_b = _rectified(pair, pair.b, right)
    # the matcher leaves out columns whose counterparts may lie beyond the picture
    before, after = max(0, first + number), max(0, -first)
    wide = [cv2.copyMakeBorder(p, 0, 0, before, after, cv2.BORDER_REPLICATE) for p in (left, right)]
    match = cv2.StereoSGBM.create(
        minDisparity=first,
        numDisparities=number,
        blockSize=window,
        P1=STEP_COST * window**2,
        P2=JUMP_COST * window**2,
        disp12MaxDiff=2,
        preFilterCap=CLIP,
        uniquenessRatio=0,
        speckleWindowSize=SPECKLE,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM,
    )
    found = match.compute(*wide)[:, before : before + left.shape[1]]
    d = np.asarray(found.astype(np.float32) / np.float32(SUBPIXEL), np.float32)
    d = _refined(d, left, right)
    there = np.arange(d.shape[1], dtype=np.float32) - d
    other = np.clip(np.rint(there), 0, d.shape[1] - 1).astype(np.intp)
    inside = (there > 0) & (there < d.shape[1] - 1) & np.take_along_axis(seen_b, other, 1)
    return d, np.asarray((d >= first) & seen & inside & _textured(left, 2 * window + 1))


def _refined(d: Float, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> Float:
    """Disparities (h, w) moved by least squares to where the windows around fit best (Lucas and
    Kanade 1981), where they are smooth over the window: the matcher's own parts of a pixel are
    pulled towards whole ones and towards the middle between them.
    """
    side = (REFINED, REFINED)
    square = np.ones(side, np.uint8)
    smooth = cv2.dilate(d, square) - cv2.erode(d, square) < MOST_BEND
    columns = np.arange(d.shape[1], dtype=np.float32) - d
    rows = np.broadcast_to(np.arange(d.shape[0], dtype=np.float32)[:, None], d.shape)
    seen = cv2.remap(right, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    difference = cv2.subtract(seen, left, dtype=cv2.CV_32F)
    difference = cv2.subtract(difference, cv2.blur(difference, side))  # photos differ in brightness
    slope = cv2.Sobel(cv2.add(seen, left, dtype=cv2.CV_32F), cv2.CV_32F, 1, 0, scale=1 / 16)
    weight = cv2.blur(slope * slope, side)
    step = cv2.blur(slope * difference, side) / (weight + np.float32(FLAT))
    np.clip(step, -MOST_STEP, MOST_STEP, out=step)
    return np.asarray(np.where(smooth, d + step, d), np.float32)


def _textured(picture: NDArray[np.uint8], side: int) -> Mask:
    """Where the window of a side in px around a pixel holds something to compare: (h, w)."""
    grey = picture.astype(np.float32)
    mean = cv2.blur(grey, (side, side))
    return np.asarray(cv2.blur(grey * grey, (side, side)) - mean * mean > TEXTURE**2)


def _rectified(
    pair: Pair, view: View, picture: NDArray[np.uint8]
) -> tuple[NDArray[np.uint8], Mask]:
    """A photo (h, w) resampled on the pair's plane, and where it covers it."""
    h, w = pair.size
    rows, columns = ((np.arange(-1, -(-n // STEP) + 1) + 0.5) * STEP - 0.5 for n in (h, w))
    at = pair.places(*np.meshgrid(rows, columns, indexing="ij"))
    nodes = project_nodes(view, at[..., 0], at[..., 1], at[..., 2])
    u, v = densify(nodes.u, h, w), densify(nodes.v, h, w)
    seen = inside_everywhere(nodes, u, v)
    u, v = shrunken_px(u, v, picture.shape, (view.camera.height, view.camera.width))
    warped = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.uint8), seen


@dataclass(frozen=True, kw_only=True, eq=False)
class Footprints:
    """What each photo sees, on a raster of cells over all of them; row 0 in the south."""

    corner: Array
    """(2,) its west and south in m (map frame)."""
    side: float
    """Side of a cell in m."""
    shape: tuple[int, int]
    """Rows and columns."""
    parts: Sequence[tuple[slice, slice, Mask]]
    """Of each photo the rows and columns that it reaches, and which of these cells it sees."""

    @classmethod
    def of(cls, views: Sequence[View], height: float) -> "Footprints":
        """Of photos `height` m above ground, of which cells are a 20th."""
        outline = np.concatenate([v.footprint for v in views])
        corner, far = outline.min(0), outline.max(0)
        side = max(height / 20, float((far - corner).max()) / 4000)
        rows, columns = (int(n) + 1 for n in np.ceil((far - corner) / side)[::-1])
        parts = [_covered(v.footprint, corner, side, (rows, columns)) for v in views]
        return cls(corner=corner, side=side, shape=(rows, columns), parts=parts)

    def common(self, a: int, b: int) -> tuple[tuple[slice, slice], Mask]:
        """The rows and columns that two photos both reach, and the cells there that both see."""
        p, q = self.parts[a], self.parts[b]
        rows, columns = (
            slice(max(m.start, n.start), max(m.start, n.start, min(m.stop, n.stop)))
            for m, n in zip(p[:2], q[:2], strict=True)
        )
        mine, other = (
            mask[
                rows.start - r.start : rows.stop - r.start,
                columns.start - c.start : columns.stop - c.start,
            ]
            for r, c, mask in (p, q)
        )
        return (rows, columns), mine & other

    @cached_property
    def counts(self) -> NDArray[np.int16]:
        """Number (rows, columns) of photos that see each cell."""
        counts = np.zeros(self.shape, np.int16)
        for rows, columns, mask in self.parts:
            counts[rows, columns] += mask
        return counts

    def showing(self, cells: Mask) -> Mask:
        """Which photos (n,) see any of some cells (rows, columns)."""
        return np.array([(cells[rows, columns] & mask).any() for rows, columns, mask in self.parts])

    def at(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.int16]:
        """Number (h, w) of photos that see places at x (w,) and y (h,), in m."""
        inside, nearest = [], []
        for places, start, n in zip((y, x), self.corner[::-1], self.shape, strict=True):
            cell = np.floor((places - start) / self.side).astype(np.intp)
            inside.append((cell >= 0) & (cell < n))
            nearest.append(np.clip(cell, 0, n - 1))
        seen = self.counts[np.ix_(*nearest)]
        return np.where(np.outer(*inside), seen, 0).astype(np.int16)


def _covered(
    outline: Array, corner: Array, side: float, shape: tuple[int, int]
) -> tuple[slice, slice, Mask]:
    """Rows and columns of a raster that an outline (k, 2) in m covers, and which of these cells."""
    px = np.floor((outline - corner) / side).astype(np.int32)
    low = np.clip(px.min(0), 0, None)
    high = np.minimum(px.max(0) + 1, [shape[1], shape[0]])
    mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
    cv2.fillPoly(mask, [px - low.astype(np.int32)], (1,))
    return slice(low[1], high[1]), slice(low[0], high[0]), mask > 0
