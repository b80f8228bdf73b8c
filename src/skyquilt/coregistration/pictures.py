"""A file to register: a photo, a radiometric frame or a georeferenced map; and the initial guess
that metadata or georeferencing give.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import cos, hypot, radians, sin
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.candidates import middle, similarity
from skyquilt.errors import UnreadablePhotoError, UsageError
from skyquilt.geometry.transforms import transfer
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.model.registration import Guess, Matrix, Picture
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import read_photo
from skyquilt.raster.read_map import MapFile, open_map, read_part, read_window

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


PHOTOS = (".jpg", ".jpeg", ".jpe", ".jfif", ".png")
"""Suffixes of files that may be photos although a file beside them places them like maps."""
LONGEST = 2048
"""Largest size in px of the longer side at which a photo or map is registered; the output is
resampled at full size.
"""
_SHARE = 0.1
"""Largest error of the places of two maps, as a share of the smaller one's longer side, ..."""
_POSITIONS_M = 6.0
"""... or in m, whichever is more: of drones' own positions, without control points."""
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
        window=lambda row, column, height, width: read_window(place, row, column, height, width),
    )


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
    """The parts of two maps that show the same ground by what their files say, at a resolution of
    their own; None if that is nothing, or most of what can be seen in the whole maps.
    """
    if a.place is None or b.place is None:
        return None
    b_H_a = _between(a.place, b.place)
    if b_H_a is None:
        return None
    margin = _reach_px(a.place, b.place, b_H_a)
    back = np.asarray(np.linalg.inv(b_H_a), np.float64)
    smaller = float(np.sqrt(abs(np.linalg.det(back[:2, :2]))))
    px_a, px_b = (_grid((0, 0, s.height, s.width)) for s in (a, b))
    in_b = _box(transfer(b_H_a, px_a), margin, (b.width, b.height))
    in_a = _box(transfer(back, px_b), margin * smaller, (a.width, a.height))
    if in_a is None or in_b is None:
        return None
    finer = [
        max(s.height, s.width) > LONGEST and part[2] * part[3] < _WHOLE * s.height * s.width
        for s, part in ((a, in_a), (b, in_b))
    ]
    if not any(finer):
        return None
    try:
        parts = [_part(s.place, p) for s, p in ((a, in_a), (b, in_b)) if s.place]
    except OSError:
        return None
    (one, full_a), (other, full_b) = parts
    return (
        replace(a, picture=one, full_S_picture=full_a),
        replace(b, picture=other, full_S_picture=full_b),
    )


def _box(
    px: NDArray[np.float64], margin: float, size: tuple[int, int]
) -> tuple[int, int, int, int] | None:
    """Row, column, height and width of the part of a file of `size` (width, height) on which px
    (n, 2) lie, widened by a margin; None if there is none.
    """
    low = np.clip(np.floor(px.min(0) - margin), 0, size).astype(int)
    high = np.clip(np.ceil(px.max(0) + margin) + 1, 0, size).astype(int)
    if (high - low < 1).any():
        return None
    return int(low[1]), int(low[0]), int(high[1] - low[1]), int(high[0] - low[0])


def guess_of(a: Source, b: Source) -> Guess | None:
    """The guess from metadata or georeferences, in px of the images; None if they give none."""
    if a.place and b.place:
        guess = _from_places(a, b)
    elif a.photo and b.photo:
        guess = from_metadata(a.photo, b.photo)
    else:
        return None
    if guess is None:
        return None
    small = np.linalg.inv(b.full_S_picture) @ guess.b_H_a @ a.full_S_picture
    return replace(guess, b_H_a=small / small[2, 2])


def _from_places(a: Source, b: Source) -> Guess | None:
    """The transform between two georeferences: an affine one through the overlap's corners."""
    assert a.place is not None and b.place is not None
    b_H_a = _between(a.place, b.place)
    if b_H_a is None:
        return None
    scale = float(np.sqrt(abs(np.linalg.det(b.full_S_picture[:2, :2]))))
    longest = scale * max(b.picture.shape)
    return Guess(
        b_H_a=b_H_a,
        reach=min(_reach_px(a.place, b.place, b_H_a) / longest, _MOST_REACH),
        rotation_deg=4.0,
        scale=1.08,
        source="the places of both maps",
    )


def _between(a: MapFile, b: MapFile) -> Matrix | None:
    """The affine transform from a's pixels to b's that their georeferences tell, the best one where
    both have content; None if they tell none, or the maps have nothing in common.
    """
    frame_a, frame_b = ((p.width, p.height) for p in (a, b))
    whole = (0, 0, a.height, a.width)
    back = _led(b, a, _grid((0, 0, b.height, b.width)))
    part = whole if back is None else _box(back, 0.0, frame_a)
    if part is None:
        return None
    px = _grid(part)
    there = _led(a, b, px)
    if there is None or _box(there, 0.0, frame_b) is None:
        return None
    linear, *_ = np.linalg.lstsq(np.c_[px, np.ones(len(px))], there, rcond=None)
    return np.vstack([linear.T, [0, 0, 1.0]])


def _grid(part: tuple[int, int, int, int]) -> NDArray[np.float64]:
    """(9, 2) px over a part (row, column, height, width) with its corners."""
    row, column, height, width = part
    x, y = np.meshgrid([0, width / 2, width], [0, height / 2, height])
    return np.asarray(np.c_[x.ravel() + column, y.ravel() + row] - 0.5, np.float64)


def _led(source: MapFile, target: MapFile, px: NDArray[Any]) -> NDArray[np.float64] | None:
    """Where px (n, 2) of one map lie in another, by their georeferences; None if that cannot be
    told. A map that states no CRS has that of the other.
    """
    x, y = _on_ground(source, px)
    one, other = source.crs or target.crs, target.crs or source.crs
    if one and other and one != other:
        from pyproj import Transformer
        from pyproj.exceptions import CRSError, ProjError

        try:
            x, y = Transformer.from_crs(one, other, always_xy=True).transform(x, y)
        except (CRSError, ProjError):  # one is local, and nothing leads from it to the other
            return None
    p, q, c, r, s, f = target.affine
    there = np.linalg.solve(np.array([[p, q], [r, s]]), np.array([x - c, y - f])).T - 0.5
    return np.asarray(there, np.float64) if np.isfinite(there).all() else None


def _reach_px(a: MapFile, b: MapFile, b_H_a: Matrix) -> float:
    """How far in px of b the places of both maps may be off: a share of the smaller one, or what
    positions of drones are off.
    """
    scale = float(np.sqrt(abs(np.linalg.det(b_H_a[:2, :2]))))
    reach = _SHARE * min(max(b.width, b.height), scale * max(a.width, a.height))
    return reach if b.metres is None else max(reach, _POSITIONS_M / min(b.metres))


def _on_ground(place: MapFile, px: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    a, b, c, d, e, f = place.affine
    column, row = px[:, 0] + 0.5, px[:, 1] + 0.5
    return a * column + b * row + c, d * column + e * row + f
