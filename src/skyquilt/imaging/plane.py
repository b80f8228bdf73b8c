"""Photos warped onto a plane, and the overview image that they are merged into, centre first."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import monotone_radius, pixels, rays
from skyquilt.imaging.grey import shrunken_px
from skyquilt.imaging.nodes import View, project_nodes
from skyquilt.model.camera import Camera
from skyquilt.model.surface import Surface

NODES = 4
"""Spacing in pixels of the points at which a view is projected exactly."""
CENTRE = 0.5
"""Side of a photo's central region, which replaces earlier content, as a share of the photo's side
(Y 6.1.3).
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """A photo on a grid of the plane."""

    column: int
    """First column on the grid."""
    row: int
    """First row."""
    pixels: NDArray[np.float32]
    """(h, w) grey values."""
    shown: NDArray[np.bool_]
    """(h, w) where the photo has content."""
    central: NDArray[np.bool_]
    """(h, w) the photo's central region."""


def to_grid(
    picture: NDArray[np.uint8], camera: Camera, cam_H_grid: NDArray[Any], *, margin: int = 0
) -> Patch | None:
    """A grey image (h, w) of a photo of any size, warped to a grid; None if it sees the horizon or
    falls outside.

    `cam_H_grid` (3, 3) takes (column, row, 1) of the grid to the undistorted image plane (units of
    the focal length).
    """
    rim = _rim(camera, np.linalg.inv(cam_H_grid))
    if rim is None:
        return None
    (c0, r0), (c1, r1) = (
        np.floor(rim.min(0)).astype(int) - margin,
        np.ceil(rim.max(0)).astype(int) + margin,
    )
    if not 0 < (c1 - c0) * (r1 - r0) < 1e8:
        return None
    c, r = np.meshgrid(np.arange(c0, c1 + 1.0), np.arange(r0, r1 + 1.0))
    local = np.stack([c, r, np.ones_like(c)], -1) @ cam_H_grid.T
    plane = local[..., :2] / np.where(np.abs(local[..., 2:]) < 1e-9, 1e-9, local[..., 2:])
    px = pixels(plane, camera.vector)
    real = (plane**2).sum(-1) < monotone_radius(camera) ** 2
    u, v = np.moveaxis(np.where(real[..., None], px, -1e4), -1, 0)
    return _seen(picture, camera, u, v, real, column=int(c0), row=int(r0))


def view_patch(
    picture: NDArray[np.uint8], view: View, surface: Surface, gsd: float
) -> Patch | None:
    """A grey image (h, w) of a placed photo, of any size, orthorectified; column = east / gsd, row
    = -north / gsd.

    Projected exactly at every `NODES`-th pixel and interpolated between.
    """
    (west, south), (east, north) = view.footprint.min(0), view.footprint.max(0)
    c0, r0 = int(np.floor(west / gsd)), int(np.floor(-north / gsd))
    columns, rows = (int(np.ceil(e / gsd / NODES)) + 1 for e in (east - west, north - south))
    x = (c0 + NODES * (np.arange(-1, columns + 1) + 0.5) - 0.5) * gsd
    y = -(r0 + NODES * (np.arange(-1, rows + 1) + 0.5) - 0.5) * gsd
    gx, gy = np.meshgrid(x, y)
    nodes = project_nodes(view, gx, gy, surface.at(gx, gy))
    if not nodes.seen.any():
        return None
    size = ((columns + 2) * NODES, (rows + 2) * NODES)
    inner = slice(NODES, -NODES)
    u, v, real = (
        cv2.resize(m, size, interpolation=cv2.INTER_LINEAR)[inner, inner]
        for m in (nodes.u, nodes.v, nodes.real.astype(np.float32))
    )
    return _seen(picture, view.camera, u, v, real > 0.999, column=c0, row=r0)


def _seen(
    picture: NDArray[np.uint8],
    camera: Camera,
    u: NDArray[Any],
    v: NDArray[Any],
    real: NDArray[np.bool_],
    *,
    column: int,
    row: int,
) -> Patch:
    """The patch of a grey image (h, w) of a photo, sampled at the photo's pixels u, v, where those
    are real.
    """
    shown, central = real, real
    for px, size, small in (
        (u, camera.width, picture.shape[1]),
        (v, camera.height, picture.shape[0]),
    ):
        off = np.abs((px + 0.5) / size - 0.5)
        shown, central = shown & (off < 0.5 - 1.5 / small), central & (off < CENTRE / 2)
    x, y = shrunken_px(u, v, picture.shape, (camera.height, camera.width))
    places = x.astype(np.float32), y.astype(np.float32)
    pixels = cv2.remap(picture, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return Patch(
        column=column,
        row=row,
        pixels=pixels.astype(np.float32),
        shown=shown,
        central=shown & central,
    )


def _rim(camera: Camera, grid_H_cam: NDArray[Any], per_side: int = 8) -> NDArray[np.float64] | None:
    """Outline of the photo on the grid (n, 2)."""
    s = np.linspace(-0.5, 0.5, per_side)
    o = s * 0 + 0.5
    square = np.concatenate([np.c_[s, -o], np.c_[s, o], np.c_[-o, s], np.c_[o, s]])
    px = square * (camera.width, camera.height) + ((camera.width - 1) / 2, (camera.height - 1) / 2)

    xyw = rays(camera, px) @ grid_H_cam.T
    w = xyw[:, 2] * np.sign(np.median(xyw[:, 2]))
    if not np.isfinite(xyw).all() or w.min() <= 1e-6 * w.max():
        return None
    return np.asarray(xyw[:, :2] / xyw[:, 2:])


class Overview:
    """The map so far, grey, on an unbounded grid: O_i = Merge(O_(i-1), I'_i) (Y 4.1).

    A photo's central region replaces earlier content; the rest only fills empty pixels (Y 6.1.3).
    """

    def __init__(self) -> None:
        self.pixels = np.zeros((0, 0), np.float32)
        self.shown = np.zeros((0, 0), bool)
        self.row = self.column = 0

    def merge(self, patch: Patch) -> None:
        """Adds a photo."""
        h, w = patch.shown.shape
        self._reach(patch.row, patch.column, patch.row + h, patch.column + w)
        inner = self._slices(patch.row, patch.column, h, w)
        laid = patch.central | (patch.shown & ~self.shown[inner])
        self.pixels[inner][laid] = patch.pixels[laid]
        self.shown[inner] |= patch.shown

    def window(
        self, row: int, column: int, height: int, width: int
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Pixels and mask (height, width) of any part of the grid, empty outside the merged
        area.
        """
        pixels, shown = np.zeros((height, width), np.float32), np.zeros((height, width), bool)
        r0, c0 = max(row, self.row), max(column, self.column)
        r1 = min(row + height, self.row + self.shown.shape[0])
        c1 = min(column + width, self.column + self.shown.shape[1])
        if r1 > r0 and c1 > c0:
            here = (slice(r0 - row, r1 - row), slice(c0 - column, c1 - column))
            there = self._slices(r0, c0, r1 - r0, c1 - c0)
            pixels[here], shown[here] = self.pixels[there], self.shown[there]
        return pixels, shown

    def _slices(self, row: int, column: int, height: int, width: int) -> tuple[slice, slice]:
        r, c = row - self.row, column - self.column
        return slice(r, r + height), slice(c, c + width)

    def _reach(self, r0: int, c0: int, r1: int, c1: int) -> None:
        """Grows the arrays, with a reserve, so that they hold rows r0 to r1 and columns c0 to
        c1.
        """
        if not self.shown.size:
            self.row, self.column = r0, c0
            self.pixels, self.shown = (
                np.zeros((r1 - r0, c1 - c0), np.float32),
                np.zeros((r1 - r0, c1 - c0), bool),
            )
            return
        h, w = self.shown.shape
        over = (self.row - r0, r1 - self.row - h, self.column - c0, c1 - self.column - w)
        grown = [max(0, o) for o in over]
        if not any(grown):
            return
        grown = [g + 64 if g else 0 for g in grown]
        around = ((grown[0], grown[1]), (grown[2], grown[3]))
        self.pixels, self.shown = np.pad(self.pixels, around), np.pad(self.shown, around)
        self.row, self.column = self.row - grown[0], self.column - grown[2]
