"""Areas to be observed and places to keep out of, from files with shapes."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pyproj import Transformer
from pyproj.exceptions import CRSError, ProjError
from shapely import (
    LineString,
    MultiPolygon,
    Polygon,
    get_coordinates,
    is_valid_reason,
    transform,
    union_all,
)
from shapely.geometry.base import BaseGeometry

from skyquilt.alignment.priors import utm_epsg
from skyquilt.errors import SideFileError, UsageError
from skyquilt.outside import plain, real
from skyquilt.planning.features import Feature, read_features
from skyquilt.planning.records import Area, KeepOut, Site

LARGEST_M = 50_000.0
"""Largest extent of an area."""
_CLOSED = {
    "keep-out", "keepout", "no-fly", "nofly", "restricted", "restriction", "closed", "obstacle",
    "exclusion", "forbidden", "prohibited",
}  # fmt: skip
_FLAGS = ("keep_out", "keep-out", "keepout", "no_fly", "no-fly", "nofly")
_KINDS = ("kind", "type", "role", "use", "class", "zone", "folder", "name")
_CEILINGS = ("ceiling_m", "ceiling", "height_m", "max_height", "upper_m")


def read_site(path: Path, *, keep_out: Path | None = None, width_m: float | None = None) -> Site:
    """The site of a file: polygons are observed, lines are corridors of a width, and what a
    property calls closed (`keep_out`, or a `type` such as `no-fly`) is kept out of, as is all of
    the file `keep_out`.

    Raises:
        SideFileError: a file cannot be read, crosses itself, or holds nothing to observe.
        UsageError: lines without a width.
    """
    shapes, closed, crs = _sorted(path, keep_out)
    if not shapes:
        raise SideFileError(f"{Path(path).name} holds no polygon or line to observe")
    return make_site(_widened(shapes, width_m, Path(path).name), closed, crs)


def make_site(observe: BaseGeometry, closed: Sequence[KeepOut], crs: str) -> Site:
    """A site from shapes in its zone."""
    pieces = [p for p in _polygons(observe) if p.area > 0]
    if not pieces:
        raise SideFileError("nothing of the area can be observed: it has no extent")
    area: Area = pieces[0] if len(pieces) == 1 else MultiPolygon(pieces)
    west, south, east, north = area.bounds
    if max(east - west, north - south) > LARGEST_M:
        raise SideFileError(
            f"the area is {max(east - west, north - south) / 1000:.0f} km long, and"
            f" {LARGEST_M / 1000:.0f} km are the most; divide it"
        )
    middle = round((west + east) / 2), round((south + north) / 2)
    return Site(crs=crs, origin=(float(middle[0]), float(middle[1])), observe=area,
                keep_out=tuple(closed))  # fmt: skip


def _sorted(path: Path, keep_out: Path | None) -> tuple[list[BaseGeometry], list[KeepOut], str]:
    """Shapes to observe and closed places, in the zone of the first file, and the zone."""
    found, source = read_features(path)
    found = [f for f in found if not f.shape.is_empty]
    longitudes = [_moved(f.shape, source, "EPSG:4326", path) for f in found]
    if not longitudes:
        raise SideFileError(f"{Path(path).name} holds no shape")
    places = np.concatenate([get_coordinates(s) for s in longitudes])
    low, high = places.min(axis=0), places.max(axis=0)
    if not (np.abs(low[0]) <= 180 and np.abs(high[0]) <= 180 and -80 <= low[1] <= high[1] <= 84):
        raise SideFileError(
            f"{Path(path).name}: longitude {low[0]:.4g} to {high[0]:.4g} and latitude {low[1]:.4g}"
            f" to {high[1]:.4g} are no place to fly"
        )
    crs = utm_epsg(*((low + high) / 2)[::-1])
    shapes, closed = [], []
    for number, (feature, shape) in enumerate(zip(found, longitudes, strict=True), 1):
        placed = _moved(shape, "EPSG:4326", crs, path)
        _check(placed, shape, number, path)
        if is_closed(feature):
            closed += _closed(feature, placed)
        else:
            shapes.append(placed)
    if keep_out is not None:
        closed += read_keep_out(keep_out, crs)
    return shapes, closed, crs


def read_keep_out(path: Path, crs: str) -> list[KeepOut]:
    """All polygons of a file as closed places, in a zone."""
    found, source = read_features(path)
    closed = []
    for number, feature in enumerate(found, 1):
        geographic = _moved(feature.shape, source, "EPSG:4326", path)
        placed = _moved(geographic, "EPSG:4326", crs, path)
        _check(placed, geographic, number, path)
        closed += _closed(feature, placed)
    return closed


def is_closed(feature: Feature) -> bool:
    """Whether a shape's properties say that it must be kept out of."""
    words = feature.properties
    for name in _FLAGS:
        if name in words:
            return words[name].strip().lower() not in ("", "0", "false", "no", "none")
    kinds = {words.get(name, "").strip().lower().replace("_", "-") for name in _KINDS}
    return any(k in _CLOSED or k.removesuffix("s") in _CLOSED for k in kinds)


def _closed(feature: Feature, shape: BaseGeometry) -> list[KeepOut]:
    stated = [feature.properties[name] for name in _CEILINGS if name in feature.properties]
    ceiling = real(stated[0], 0, 100_000) if stated else None
    if stated and ceiling is None:
        raise SideFileError(
            f"a keep-out area's ceiling is '{plain(stated[0], 40)}'; expected its height above the"
            " ground in m"
        )
    name = feature.properties.get("name", "")
    return [KeepOut(shape=p, ceiling_m=ceiling, name=name) for p in _polygons(shape)]


def _polygons(shape: BaseGeometry) -> list[Polygon]:
    parts = getattr(shape, "geoms", None)
    if parts is not None:
        return [p for part in parts for p in _polygons(part)]
    return [shape] if isinstance(shape, Polygon) else []


def _check(placed: BaseGeometry, shape: BaseGeometry, number: int, path: Path) -> None:
    """Refuses polygons that cross themselves, and shapes without meaning."""
    for polygon in _polygons(placed):
        if not polygon.is_valid:
            why = is_valid_reason(polygon).split("[")[0].strip().lower()
            at = shape.centroid
            raise SideFileError(
                f"{Path(path).name}: shape {number} near {at.y:.5f}, {at.x:.5f} crosses or touches"
                f" itself ({why}); draw it as separate areas"
            )
    if shape.geom_type in ("Point", "MultiPoint"):
        raise SideFileError(
            f"{Path(path).name}: shape {number} is a point; areas are polygons, corridors lines"
        )


def _widened(shapes: Sequence[BaseGeometry], width_m: float | None, name: str) -> BaseGeometry:
    """The union of polygons and of lines grown to corridors."""
    grown = []
    for shape in shapes:
        for part in getattr(shape, "geoms", [shape]):
            if not isinstance(part, LineString):
                grown.append(part)
                continue
            if width_m is None:
                raise UsageError(f"{name} has lines; give the corridors' width in m with --width")
            grown.append(part.buffer(width_m / 2, cap_style="flat", join_style="mitre",
                                     mitre_limit=2))  # fmt: skip
    return union_all(grown)


def _moved(shape: BaseGeometry, source: str, target: str, path: Path) -> BaseGeometry:
    """A shape in another coordinate system."""
    try:
        transformer = Transformer.from_crs(source, target, always_xy=True)
    except (CRSError, ProjError) as error:
        raise SideFileError(
            f"{Path(path).name}: the coordinate system '{plain(source, 60)}' is not known"
        ) from error
    placed = transform(shape, lambda xy: np.column_stack(transformer.transform(xy[:, 0], xy[:, 1])))
    if not all(map(math.isfinite, placed.bounds)):
        raise SideFileError(f"{Path(path).name}: its coordinates do not fit its coordinate system")
    return placed


def geographic(crs: str, xy: np.ndarray) -> np.ndarray:
    """Longitude and latitude (n, 2) of places (n, 2) in a zone."""
    turned = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    xy = np.asarray(xy, np.float64).reshape(-1, 2)
    return np.column_stack(turned.transform(xy[:, 0], xy[:, 1]))


def in_zone(crs: str, places: np.ndarray) -> np.ndarray:
    """Places (n, 2) in a zone of longitudes and latitudes (n, 2)."""
    turned = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    places = np.asarray(places, np.float64).reshape(-1, 2)
    return np.column_stack(turned.transform(places[:, 0], places[:, 1]))
