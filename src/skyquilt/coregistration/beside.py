"""A camera beside that of the map's photos: what both see of the same ground."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from skyquilt.coregistration.agreement import scores
from skyquilt.coregistration.orientation import Orientation, of_bands, orientation
from skyquilt.coregistration.refine_registration import chromaticity
from skyquilt.geometry.camera import project, rays
from skyquilt.geometry.frames import rotation_from_vector
from skyquilt.imaging.grey import shrunken_px
from skyquilt.model.camera import Camera

Array = NDArray[np.float64]
_NODE = 16
"""Pixels of a reduced photo between the nodes at which a photo is projected into the other."""
_WHOLE = 128
"""Side of the square to whose area whole photos are reduced before they are compared."""
_FARTHEST = 0.25
"""Largest shift of whole photos, share of that side."""
_ROLLS_DEG = (-6.0, -3.0, 0.0, 3.0, 6.0)
"""Turns about the axis at which they are compared."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Together:
    """Two photos of one trigger."""

    a: NDArray[np.uint8]
    """(H, W) the photo of the map, grey, reduced or not."""
    camera_a: Camera
    """Its calibration, of its full size."""
    b: NDArray[np.uint8]
    """(h, w) the photo of the band, grey, reduced or not."""
    nearness: Array = field(default_factory=lambda: np.zeros((2, 2)))
    """(r, c) 1 over the depth in m of the ground along the axis of the map's camera, at places
    evenly distributed from corner to corner of its photo; 0 for ground that is infinitely far.
    """
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) of the map's camera along its own axes, m/s; 0 where it is not known."""
    ahead: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) how much further than is usual the drone had flown when the photo of the band was taken,
    m along the axes of the map's camera.
    """
    colours: NDArray[np.uint8] | None = None
    """(H, W, 3) what `a` shows in colours; None where it has none, or they are not wanted."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Beside:
    """A camera beside that of the map's photos."""

    turn: Array
    """(3,) rotation vector from the camera of the map's photos to it."""
    place: Array
    """(2,) where it is, m along the columns and the rows of the map's photos."""
    camera: Camera
    """Its lens."""
    delay_s: float = 0.0
    """How much later it is exposed, s."""

    @property
    def R(self) -> Array:
        """(3, 3) from the camera of the map's photos to it."""
        return rotation_from_vector(self.turn)

    def reduced(self, shape: tuple[int, int]) -> Camera:
        """Its lens on a photo reduced to this shape."""
        return self.camera.reduced(shape[1], shape[0])

    def sees(self, ray_a: Array, nearness: Array, velocity: Array, ahead: Array) -> Array:
        """Its pixels (n, 2) of what lies on rays (n, 3) of the map's camera, at 1 over a depth;
        `velocity` (n, 3) of the latter, `ahead` (n, 3): `Together.ahead`.
        """
        moved = self._moved(nearness, velocity, ahead)
        return np.asarray(project(self.camera, (ray_a - moved) @ self.R.T))

    def _moved(self, nearness: Array, velocity: Array, ahead: Array) -> Array:
        """(n, 3) by how much the rays to a place differ."""
        place = np.array([*self.place, 0.0]) + self.delay_s * velocity + ahead
        return np.asarray(nearness[:, None] * place)

    def in_photo(self, px: Array, small: Camera, pair: Together) -> tuple[Array, Array]:
        """Where the map's photo shows pixels (n, 2) of this camera, whose lens is `small` on a
        reduced photo, and 1 over their depth (n,). NaN where it does not.
        """
        ray = rays(small, px) @ self.R
        ray = ray / ray[:, 2:]
        near = _at(pair, project(pair.camera_a, ray))
        moved = self._moved(near, pair.velocity, pair.ahead)
        return np.asarray(project(pair.camera_a, ray + moved)), near


def turned(pairs: Sequence[Together], there: Beside) -> Beside:
    """The camera turned so that whole photos fit each other best: a lens that was knocked, or a
    camera with a mount of its own.
    """
    reach, best, found = int(_FARTHEST * _WHOLE), -np.inf, there
    reduced = [oriented(pair.b, _WHOLE) for pair in pairs]
    for roll in np.radians(_ROLLS_DEG):
        rolled = replace(there, turn=np.array([0.0, 0.0, roll]))
        total = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
        for pair, b in zip(pairs, reduced, strict=True):
            a = seen_by(pair, rolled, b.shape)
            total += scores(padded(a.fields, reach), b.fields * b.valid[..., None])
        if total.max() > best:
            best = float(total.max())
            row, column = divmod(int(total.argmax()), total.shape[1])
            found = _shifted(rolled, reduced[0].shape, (reach - column, reach - row))
    return found


def _shifted(there: Beside, shape: tuple[int, int], shift: tuple[int, int]) -> Beside:
    """The camera turned so that it shows things shifted by px (along columns and rows) of a photo
    reduced to this shape.
    """
    small = there.reduced(shape)
    middle = np.array([[small.width - 1, small.height - 1]]) / 2
    first, then = (
        ray[0] / np.linalg.norm(ray[0])
        for ray in (rays(small, middle), rays(small, middle + np.array(shift)))
    )
    more = Rotation.from_rotvec(np.cross(first, then)) * Rotation.from_rotvec(there.turn)
    return replace(there, turn=np.asarray(more.as_rotvec()))


def oriented(grey: NDArray[np.uint8], side: int) -> Orientation:
    """Fields of a photo (H, W) reduced to the area of a square of a side."""
    return orientation(grey.astype(np.float32), np.ones(grey.shape, np.bool_), side, quick=True)


def _at(pair: Together, px_a: Array) -> Array:
    """(n,) 1 over the depth at places (n, 2) of a map's photo, between nodes; that of the rim
    beyond it.
    """
    rows, columns = pair.nearness.shape
    last = np.array([columns - 1, rows - 1])
    size = np.array([pair.camera_a.width - 1, pair.camera_a.height - 1])
    node = np.clip(np.nan_to_num(px_a) / size * last, 0, last)
    found = map_coordinates(pair.nearness, node[:, ::-1].T, order=1, mode="nearest")
    return np.asarray(found, np.float64)


def seen_by(
    pair: Together, beside: Beside, shape: tuple[int, int], *, coloured: bool = False
) -> Orientation:
    """The fields of the map's photo as the reduced band (h, w) sees it; `coloured`: those of its
    colours, whatever the brightness.
    """
    h, w = shape
    small = beside.reduced(shape)
    rows, columns = (np.arange(0, n + _NODE, _NODE, dtype=np.float64) for n in (h, w))
    x, y = np.meshgrid(columns, rows)
    there = beside.in_photo(np.c_[x.ravel(), y.ravel()], small, pair)[0].reshape(*x.shape, 2)
    full = pair.camera_a.height, pair.camera_a.width
    places = shrunken_px(there[..., 0], there[..., 1], pair.a.shape, full)
    # nodes of an enlarged image, whose corners lie at the first and the last node
    map_x, map_y = np.meshgrid(
        np.arange(w, dtype=np.float32) / _NODE, np.arange(h, dtype=np.float32) / _NODE
    )
    u, v = (cv2.remap(place.astype(np.float32), map_x, map_y, cv2.INTER_LINEAR) for place in places)
    source: NDArray[Any] = pair.a
    if coloured and pair.colours is not None:
        source = pair.colours.astype(np.float32)
    finer = max(pair.a.shape) / max(h, w) / 1.1
    if finer > 1.5:  # as fine as the band, or fine structure would be aliased
        source = cv2.GaussianBlur(source, (0, 0), 0.4 * finer)
    seen = cv2.remap(source, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    height, width = pair.a.shape
    valid = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    if seen.ndim == 3:
        return of_bands(chromaticity(seen), valid, np.eye(3), quick=True)
    return orientation(seen.astype(np.float32), valid, float(np.sqrt(seen.size)), quick=True)


def padded(fields: NDArray[Any], reach: int) -> NDArray[Any]:
    """Fields (h, w, 4) with zeros around."""
    around = cv2.copyMakeBorder(
        fields, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=(0,) * 4
    )
    return np.asarray(around)
