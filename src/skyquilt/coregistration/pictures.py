"""A file to register: a photo, a radiometric frame or a georeferenced map; and the initial guess
that metadata or georeferencing give.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import cos, hypot, radians, sin
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.candidates import middle, similarity
from skyquilt.coregistration.places import Lies, map_in_map, photo_in_map, shared_boxes
from skyquilt.errors import SideFileError, UnreadablePhotoError, UsageError
from skyquilt.geometry.frames import east_north_m
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.model.registration import Guess, Matrix, Picture
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import read_photo
from skyquilt.raster.drivers import NO_TEXT, is_text
from skyquilt.raster.read_map import MapFile, open_map, read_part, read_window

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
    east, north = east_north_m(b.position, a.position)
    yaw = radians(yaw_b_deg)
    right, up = east * cos(yaw) - north * sin(yaw), east * sin(yaw) + north * cos(yaw)
    return np.array([right, -up])


PHOTOS = (".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp")
"""Suffixes of files that may be photos although a file beside them places them like maps."""
LONGEST = 2048
"""Largest size in px of the longer side at which a photo or map is registered; the output is
resampled at full size.
"""
_MOST_REACH = 0.5
"""Largest share of b's longer side that is searched around a guess."""
_WHOLE = 0.7
"""A part with more than this share of a map's area is not read by itself."""
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
    full_S_picture: Matrix
    """(3, 3) from the image's pixels to those of the file: reduced, mirrored, or of a part."""
    window: Window
    """(row, column, height, width) -> pixels and validity at full size."""
    photo: Photo | None = None
    """Its metadata, if it is a photo."""
    place: MapFile | None = None
    """Its georeference, if it has one."""

    @property
    def through_lens(self) -> bool:
        """Whether the file says that a camera took it, so that a lens bends it and perspective is
        in it.
        """
        return self.photo is not None and (
            self.photo.focal.source != "guess" or bool(self.photo.unit)
        )

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
    place, photo = open_map(path), None
    if place is None or path.suffix.lower() in PHOTOS:
        photo = read_photo(path)
    if place is not None and not (isinstance(photo, Photo) and (photo.unit or photo.position)):
        try:
            return _of_map(place)
        except OSError as error:
            return RejectedPhoto(name=path.name, reason=str(error))
    assert photo is not None
    if isinstance(photo, RejectedPhoto):
        return photo
    if photo.placed and not is_text(path):
        return RejectedPhoto(name=path.name, reason=NO_TEXT)  # GDAL alone could tell its place
    try:
        return of_photo(photo, read_color(photo))
    except (UnreadablePhotoError, OSError) as error:
        return RejectedPhoto(name=path.name, reason=str(error))


def of_photo(photo: Photo, values: NDArray[Any]) -> Source:
    """A photo that was read, by its pixels (h, w[, bands]) as `read_color` gives them."""
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
        full_S_picture=_enlarging(1 / factor, 1 / factor),
        window=window,
        photo=photo,
    )


def _of_map(place: MapFile) -> Source:
    picture, full = _part(place, (0, 0, place.height, place.width))
    return Source(
        path=place.path,
        height=place.height,
        width=place.width,
        place=place,
        picture=picture,
        full_S_picture=full,
        window=partial(_window, place),
    )


def _window(
    place: MapFile, row: int, column: int, height: int, width: int
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Pixels and validity at full size, of which some may be damaged that the image, read from an
    overview, does not show.

    Raises:
        SideFileError: they cannot be read.
    """
    try:
        return read_window(place, row, column, height, width)
    except OSError as error:
        raise SideFileError(f"{place.path.name} cannot be read at full size: {error}") from error


def _part(place: MapFile, part: tuple[int, int, int, int]) -> tuple[Picture, Matrix]:
    """The image of a part (row, column, height, width) of a map, seen from above, and the transform
    from its pixels to those of the file.
    """
    values, valid = read_part(place, part, LONGEST)
    row, column, height, width = part
    full = _enlarging(width / values.shape[1], height / values.shape[0])
    if place.mirrored:
        values, valid = np.ascontiguousarray(values[::-1]), valid[::-1]
        full = full @ np.array([[1, 0, 0], [0, -1, len(values) - 1], [0, 0, 1.0]])
    shift = np.array([[1, 0, column], [0, 1, row], [0, 0, 1.0]])
    return Picture(values=values, valid=np.ascontiguousarray(valid)), shift @ full


def _enlarging(x: float, y: float) -> Matrix:
    """From pixels of an image to those of x times y as many, both with centres at integers."""
    return np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1.0]])


def common_parts(a: Source, b: Source) -> tuple[Source, Source] | None:
    """The parts of two files that show the same ground by what they say, maps at a resolution of
    their own; None if that is nothing, or most of what can be seen in the whole files.
    """
    lies = _lies(a, b)
    if lies is None:
        return None
    frames = ((s.width, s.height) for s in (a, b))
    in_a, in_b = shared_boxes(lies, *frames)
    if in_a is None or in_b is None:
        return None
    finer = [
        s.place is not None
        and max(s.height, s.width) > LONGEST
        and part[2] * part[3] < _WHOLE * s.height * s.width
        for s, part in ((a, in_a), (b, in_b))
    ]
    if not any(finer):
        return None
    try:
        return _of_part(a, in_a), _of_part(b, in_b)
    except OSError:
        return None


def _of_part(source: Source, part: tuple[int, int, int, int]) -> Source:
    """The same file, a map by a part of it only."""
    if source.place is None:
        return source
    picture, full = _part(source.place, part)
    return replace(source, picture=picture, full_S_picture=full)


def guess_of(a: Source, b: Source) -> Guess | None:
    """The guess from metadata or georeferences, in px of the images; None if they give none."""
    guess = from_metadata(a.photo, b.photo) if a.photo and b.photo else _by_places(a, b)
    if guess is None:
        return None
    small = np.linalg.inv(b.full_S_picture) @ guess.b_H_a @ a.full_S_picture
    return replace(guess, b_H_a=small / small[2, 2])


def _by_places(a: Source, b: Source) -> Guess | None:
    """The guess where one or both are maps; in px of the files, its reach for b's picture."""
    lies = _lies(a, b)
    if lies is None:
        return None
    scale = float(np.sqrt(abs(np.linalg.det(b.full_S_picture[:2, :2]))))
    reach = min(lies.off_px / (scale * max(b.picture.shape)), _MOST_REACH)
    if a.place and b.place:
        return Guess(
            b_H_a=lies.b_H_a,
            reach=reach,
            rotation_deg=4.0,
            scale=1.08,
            source="the places of both maps",
        )
    return Guess(
        b_H_a=lies.b_H_a,
        reach=reach,
        rotation_deg=_TURN_DEG,
        scale=_SCALE,
        source="the photo's metadata and the map's place",
    )


def _lies(a: Source, b: Source) -> Lies | None:
    """Where a lies in b by what the files say, in px of the files, if one or both are maps."""
    if a.place and b.place:
        return map_in_map(a.place, b.place)
    if a.photo and b.place:
        return photo_in_map(a.photo, b.place, _REACH)
    if a.place and b.photo:
        found = photo_in_map(b.photo, a.place, _REACH)
        return found and found.inverse()
    return None
