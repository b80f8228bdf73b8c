"""A file to register: a photo, a radiometric frame or a georeferenced map; and the initial guess
that metadata or georeferencing give.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, hypot, radians, sin
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.candidates import middle, similarity
from skyquilt.errors import UnreadablePhotoError, UsageError
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.model.registration import Guess, Matrix, Picture
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import read_photo
from skyquilt.raster.read_map import MapFile, open_map, read_reduced, read_window

_EARTH_M = 6378137.0
_REACH = 0.3
"""Largest error from tilt, lever arms and positions, as a share of b's longer side."""
_TURN_DEG = 12.0
"""Largest error of the difference of two yaws in degrees."""
_SCALE = 1.3
"""Largest error of the scale from focal lengths and heights, as a factor."""


def from_metadata(a: Photo, b: Photo) -> Guess | None:
    """The guess for two vertical photos, or None if their metadata are not sufficient.

    Scale from focal lengths and heights above take-off, rotation from yaws, shift from positions;
    data that are not given by both are assumed to be equal. Assumed focal lengths are not used.
    """
    if "guess" in (a.focal.source, b.focal.source):
        return None
    said = ["focal lengths"]
    scale = b.focal.px / a.focal.px
    heights = _heights(a, b)
    if heights is not None:
        scale *= heights[0] / heights[1]
        said.append("heights")
    yaws = (a.attitude.yaw_deg, b.attitude.yaw_deg) if a.attitude and b.attitude else None
    if yaws is not None:
        said.append("yaws")
    yaw_a, yaw_b = yaws or (0.0, 0.0)
    to_px = middle((b.height, b.width))
    if yaws is not None and heights is not None and a.position and b.position:
        to_px = to_px + _shift(a, b, yaw_b) * b.focal.px / heights[1]
        said.append("positions")
    half = 0.5 * max(b.height, b.width)
    if hypot(*(to_px - middle((b.height, b.width)))) > 2 * half:
        return None
    transform = similarity(scale, radians(yaw_a - yaw_b), middle((a.height, a.width)), to_px)
    return Guess(
        b_H_a=transform,
        reach=_REACH,
        rotation_deg=_TURN_DEG,
        scale=_SCALE,
        source=f"the photos' metadata ({', '.join(said)})",
    )


def _heights(a: Photo, b: Photo) -> tuple[float, float] | None:
    """Heights in m above take-off, if both photos give them and both were taken in flight."""
    found = [p.position.takeoff_m if p.position else None for p in (a, b)]
    if found[0] is None or found[1] is None or min(found[0], found[1]) < 5:
        return None
    return found[0], found[1]


def _shift(a: Photo, b: Photo, yaw_b_deg: float) -> np.ndarray:
    """(2,) m from b's camera to a's, along b's image: x right, y down."""
    assert a.position is not None and b.position is not None
    north = radians(a.position.latitude_deg - b.position.latitude_deg) * _EARTH_M
    east = radians(a.position.longitude_deg - b.position.longitude_deg) * _EARTH_M
    east *= cos(radians(b.position.latitude_deg))
    yaw = radians(yaw_b_deg)
    right, up = east * cos(yaw) - north * sin(yaw), east * sin(yaw) + north * cos(yaw)
    return np.array([right, -up])


LONGEST = 2048
"""Largest size in px of the longer side at which a photo or map is registered; the output is
resampled at full size.
"""
Window = Callable[[int, int, int, int], tuple[NDArray[Any], NDArray[np.bool_]]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Source:
    """An opened file."""

    path: Path
    """The file."""
    height: int
    """Rows at full size."""
    width: int
    """Columns at full size."""
    picture: Picture
    """The image that is registered; reduced if the file is large."""
    reduction: tuple[float, float]
    """Px of the file per px of the image, along x and y."""
    window: Window
    """(row, column, height, width) -> pixels and validity at full size."""
    photo: Photo | None = None
    """Its metadata, if it is a photo."""
    place: MapFile | None = None
    """Its georeference, if it has one."""

    @property
    def full_S_picture(self) -> Matrix:
        """(3, 3) from the image's pixels to those of the file."""
        x, y = self.reduction
        return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1.0]])

    @property
    def unit(self) -> str:
        """Unit of the values; empty for colour images."""
        return self.photo.unit if self.photo else self.place.unit if self.place else ""


def open_picture(path: Path) -> Source | RejectedPhoto:
    """Opens a file and reads the image, or gives the reason why it cannot be used.

    Raises:
        UsageError: there is no such file.
    """
    if not path.is_file():
        raise UsageError(f"{path} is not a file; give two photos or two GeoTIFFs")
    if path.suffix.lower() in (".tif", ".tiff", ".vrt") and (place := open_map(path)) is not None:
        try:
            return _of_map(place)
        except OSError as error:
            return RejectedPhoto(name=path.name, reason=str(error))
    photo = read_photo(path)
    if isinstance(photo, RejectedPhoto):
        return photo
    try:
        return _of_photo(photo)
    except (UnreadablePhotoError, OSError) as error:
        return RejectedPhoto(name=path.name, reason=str(error))


def _of_photo(photo: Photo) -> Source:
    values = read_color(photo)
    if values.ndim == 3 and values.shape[2] not in (1, 3):
        values = values[..., :3] if values.shape[2] > 3 else values[..., 0]
    values = values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
    valid = np.isfinite(values if values.ndim == 2 else values.sum(2, dtype=np.float32))
    factor = min(1.0, LONGEST / max(values.shape[:2]))
    small = values
    if factor < 1:  # scale both axes equally, so that a similarity remains one
        small = np.asarray(
            cv2.resize(values, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        )

    def window(
        row: int, column: int, height: int, width: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        part = (slice(row, row + height), slice(column, column + width))
        return values[part], valid[part]

    return Source(
        path=photo.path,
        height=values.shape[0],
        width=values.shape[1],
        picture=Picture(values=small),
        reduction=(1 / factor, 1 / factor),
        window=window,
        photo=photo,
    )


def _of_map(place: MapFile) -> Source:
    values, valid = read_reduced(place, LONGEST)
    return Source(
        path=place.path,
        height=place.height,
        width=place.width,
        place=place,
        picture=Picture(values=values, valid=valid),
        reduction=(place.width / values.shape[1], place.height / values.shape[0]),
        window=lambda row, column, height, width: read_window(place, row, column, height, width),
    )


def guess_of(a: Source, b: Source) -> Guess | None:
    """The guess from metadata or georeferences, in px of the images; None if they give none."""
    if a.place and b.place and a.place.crs and b.place.crs:
        guess = _from_places(a, b)
    elif a.photo and b.photo:
        guess = from_metadata(a.photo, b.photo)
    else:
        return None
    if guess is None:
        return None
    small = np.linalg.inv(b.full_S_picture) @ guess.b_H_a @ a.full_S_picture
    return Guess(
        b_H_a=small / small[2, 2],
        reach=guess.reach,
        rotation_deg=guess.rotation_deg,
        scale=guess.scale,
        source=guess.source,
    )


def _from_places(a: Source, b: Source) -> Guess | None:
    """The transform between two georeferences: an affine one through the overlap's corners."""
    from pyproj import Transformer

    assert a.place is not None and b.place is not None
    px = np.array([[0, 0], [a.width, 0], [0, a.height], [a.width, a.height]], np.float64) - 0.5
    x, y = _on_ground(a.place, px)
    x, y = Transformer.from_crs(a.place.crs, b.place.crs, always_xy=True).transform(x, y)
    p, q, c, r, s, f = b.place.affine
    there = np.linalg.solve(np.array([[p, q], [r, s]]), np.array([x - c, y - f])).T - 0.5
    if (
        not np.isfinite(there).all()
        or (there.max(0) < 0).any()
        or (there.min(0) > [b.width, b.height]).any()
    ):
        return None
    linear, *_ = np.linalg.lstsq(np.c_[px, np.ones(4)], there, rcond=None)
    return Guess(
        b_H_a=np.vstack([linear.T, [0, 0, 1.0]]),
        reach=0.1,
        rotation_deg=4.0,
        scale=1.08,
        source="the places of both maps",
    )


def _on_ground(place: MapFile, px: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    a, b, c, d, e, f = place.affine
    column, row = px[:, 0] + 0.5, px[:, 1] + 0.5
    return a * column + b * row + c, d * column + e * row + f
