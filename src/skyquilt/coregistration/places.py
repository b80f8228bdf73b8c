"""Where one file lies in another by what both say of their places on the ground."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.frames import beside_deg, ned_from_body
from skyquilt.geometry.transforms import fit, transfer
from skyquilt.model.photo import Photo
from skyquilt.model.registration import Matrix
from skyquilt.raster.read_map import Box, MapFile, part_between

_SHARE = 0.1
"""Largest error of the places of two maps, as a share of the smaller one's longer side, ..."""
_POSITIONS_M = 6.0
"""... or in m, whichever is more: of drones' own positions, without control points."""
_LEAST_M = 5.0
"""Least height above take-off in m of a photo taken in flight."""
_MOST_TILT_DEG = 30.0
"""Largest tilt of a photo whose ground is taken for a part of a map."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lies:
    """Where a lies in b."""

    b_H_a: Matrix
    """(3, 3) px of the files."""
    off_px: float
    """How far it may be off, px of b, ..."""
    off_a_px: float
    """... and px of a."""

    def inverse(self) -> "Lies":
        """Where b lies in a."""
        back = np.asarray(np.linalg.inv(self.b_H_a), np.float64)
        return Lies(b_H_a=back / back[2, 2], off_px=self.off_a_px, off_a_px=self.off_px)


def _size(matrix: Matrix, at: NDArray[np.float64]) -> float:
    """Px of the target per px of the source at a place (2,) of it."""
    ends = transfer(matrix, at + np.array([[0.0, 0], [1, 0], [0, 1]]))
    return float(np.sqrt(abs(np.linalg.det(ends[1:] - ends[0]))))


def map_in_map(a: MapFile, b: MapFile) -> Lies | None:
    """By the georeferences of both; None if they tell nothing, or the maps have nothing in common.
    They may be off by a share of the smaller one, or by what positions of drones are off.
    """
    b_H_a = _between(a, b)
    if b_H_a is None:
        return None
    size = _size(b_H_a, np.zeros(2))
    off = _SHARE * min(max(b.width, b.height), size * max(a.width, a.height))
    if b.metres is not None:
        off = max(off, _POSITIONS_M / min(b.metres))
    return Lies(b_H_a=b_H_a, off_px=off, off_a_px=off / size)


def photo_in_map(photo: Photo, target: MapFile, off: float) -> Lies | None:
    """By the photo's position, height above take-off, angles and focal length, over flat ground;
    `off`: how far it may be off, as a share of its longer side. None if one of these is missing.
    """
    position, angles = photo.position, photo.attitude
    if position is None or angles is None or target.crs is None or photo.focal.source == "guess":
        return None
    height = position.takeoff_m
    if height is None or height < _LEAST_M:
        return None
    if np.hypot(angles.pitch_deg, angles.roll_deg) > _MOST_TILT_DEG:
        return None
    px = _grid((0, 0, photo.height, photo.width))
    middle = np.array([(photo.width - 1) / 2, (photo.height - 1) / 2])
    right, back = ((px - middle) / photo.focal.px).T
    rays = np.stack([-back, right, np.ones(len(px))])  # nose, right, belly
    north, east, down = ned_from_body(angles.yaw_deg, angles.pitch_deg, angles.roll_deg) @ rays
    if (down < 0.1).any():
        return None
    latitude, longitude = beside_deg(
        position.latitude_deg,
        position.longitude_deg,
        east_m=height * east / down,
        north_m=height * north / down,
    )
    there = _places(target, longitude, latitude, "EPSG:4326")
    if there is None or box(there, 0.0, (target.width, target.height)) is None:
        return None
    found = fit("homography", px, there)
    if found is None:
        return None
    off_px = off * max(photo.width, photo.height)
    return Lies(b_H_a=found, off_px=off_px * _size(found, middle), off_a_px=off_px)


def beside_m(a: MapFile, b: MapFile, b_H_a: Matrix) -> float | None:
    """How far in m the middle of b lies, by its own file, from where a registration puts it on a;
    None if a file tells no place on Earth.
    """
    from pyproj import Geod, Transformer
    from pyproj.exceptions import CRSError, ProjError

    if a.crs is None or b.crs is None:
        return None
    px_b = np.array([[(b.width - 1) / 2, (b.height - 1) / 2]])
    px_a = transfer(np.asarray(np.linalg.inv(b_H_a), np.float64), px_b)
    ends = []
    for place, px in ((a, px_a), (b, px_b)):
        try:
            onto = Transformer.from_crs(place.crs, "EPSG:4326", always_xy=True)
        except (CRSError, ProjError):
            return None
        ends += [float(v[0]) for v in onto.transform(*_on_ground(place, px))]
    if not np.isfinite(ends).all():
        return None
    lon_a, lat_a, lon_b, lat_b = ends
    return float(Geod(ellps="WGS84").inv(lon_a, lat_a, lon_b, lat_b)[2])


def shared_boxes(
    lies: Lies, frame_a: tuple[int, int], frame_b: tuple[int, int]
) -> tuple[Box | None, Box | None]:
    """The parts of a and of b (width, height) that may show the same ground."""
    back = lies.inverse()
    px_a, px_b = (_grid((0, 0, height, width)) for width, height in (frame_a, frame_b))
    return (
        box(transfer(back.b_H_a, px_b), back.off_px, frame_a),
        box(transfer(lies.b_H_a, px_a), lies.off_px, frame_b),
    )


def box(px: NDArray[np.float64], margin: float, size: tuple[int, int]) -> Box | None:
    """Row, column, height and width of the part of a file of `size` (width, height) on which px
    (n, 2) lie, widened by a margin; None if there is none.
    """
    return part_between(px.min(0) - margin, px.max(0) + margin + 1, size)


def _between(a: MapFile, b: MapFile) -> Matrix | None:
    """The affine transform from a's pixels to b's that their georeferences tell, the best one where
    both have content; None if they tell none, or the maps have nothing in common.
    """
    frame_a, frame_b = ((p.width, p.height) for p in (a, b))
    whole = (0, 0, a.height, a.width)
    back = _led(b, a, _grid((0, 0, b.height, b.width)))
    part = whole if back is None else box(back, 0.0, frame_a)
    if part is None:
        return None
    px = _grid(part)
    there = _led(a, b, px)
    if there is None or box(there, 0.0, frame_b) is None:
        return None
    linear, *_ = np.linalg.lstsq(np.c_[px, np.ones(len(px))], there, rcond=None)
    return np.vstack([linear.T, [0, 0, 1.0]])


def _grid(part: Box) -> NDArray[np.float64]:
    """(9, 2) px over a part (row, column, height, width) with its corners."""
    row, column, height, width = part
    x, y = np.meshgrid([0, width / 2, width], [0, height / 2, height])
    return np.asarray(np.c_[x.ravel() + column, y.ravel() + row] - 0.5, np.float64)


def _led(source: MapFile, target: MapFile, px: NDArray[Any]) -> NDArray[np.float64] | None:
    """Where px (n, 2) of one map lie in another, by their georeferences; None if that cannot be
    told. A map that states no CRS has that of the other.
    """
    x, y = _on_ground(source, px)
    return _places(target, x, y, source.crs or target.crs)


def _places(
    target: MapFile, x: NDArray[Any], y: NDArray[Any], one: str | None
) -> NDArray[np.float64] | None:
    """Where x and y of a CRS lie in a map, (n, 2) px; None if that cannot be told."""
    other = target.crs or one
    if one and other and one != other:
        from pyproj import Transformer
        from pyproj.exceptions import CRSError, ProjError

        try:
            x, y = Transformer.from_crs(one, other, always_xy=True).transform(x, y)
        except (CRSError, ProjError):  # one is local, and nothing leads from it to the other
            return None
    there = target.pixel(x, y).T - 0.5
    return there if np.isfinite(there).all() else None


def _on_ground(place: MapFile, px: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    return place.ground(px[:, 0] + 0.5, px[:, 1] + 0.5)
