"""Points, lines and polygons as GeoJSON (RFC 7946): WGS 84 degrees, outer rings anticlockwise."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyquilt.raster.atomic import write_text

DECIMALS = 9
"""Decimals of a degree: a tenth of a millimetre."""
UNGEOREFERENCED = (
    "not georeferenced: the coordinates are those of the mosaic, not longitude and latitude"
)

Properties = Mapping[str, Any]
Project = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def points(
    path: Path, features: Iterable[tuple[ArrayLike, Properties]], *, crs: str | None
) -> None:
    """Writes a collection of points, each (x, y) or (x, y, height) in `crs`, with their
    properties.
    """
    _write(path, features, crs, "Point", lambda place, project: _places([place], project)[0])


def lines(path: Path, features: Iterable[tuple[ArrayLike, Properties]], *, crs: str | None) -> None:
    """Writes a collection of lines, each (n, 2) or (n, 3) in `crs`, with their properties."""
    _write(path, features, crs, "LineString", _places)


def polygons(
    path: Path, features: Iterable[tuple[Sequence[ArrayLike], Properties]], *, crs: str | None
) -> None:
    """Writes a collection of polygons: each a list of rings (n, 2) or (n, 3) in `crs`, the outer
    one first.
    """
    _write(path, features, crs, "Polygon", _rings)


def _write(
    path: Path,
    features: Iterable[tuple[Any, Properties]],
    crs: str | None,
    kind: str,
    coordinates: Any,
) -> None:
    """Heights are written unchanged. Without a CRS coordinates are too, and every feature has a
    note that says so.
    """
    project = _projection(crs) if crs else lambda places: places
    extra = {} if crs else {"note": UNGEOREFERENCED}
    collection = {
        "type": "FeatureCollection",
        **extra,
        "features": [
            {
                "type": "Feature",
                "geometry": {"type": kind, "coordinates": coordinates(geometry, project)},
                "properties": {key: _plain(value) for key, value in properties.items()} | extra,
            }
            for geometry, properties in features
        ],
    }
    write_text(path, json.dumps(collection, allow_nan=False, ensure_ascii=False) + "\n")


def _projection(crs: str) -> Project:
    import pyproj

    transformer = pyproj.Transformer.from_crs(pyproj.CRS(crs).to_2d(), "EPSG:4326", always_xy=True)

    def project(places: NDArray[np.float64]) -> NDArray[np.float64]:
        longitude, latitude = transformer.transform(places[:, 0], places[:, 1])
        return np.column_stack([longitude, latitude, places[:, 2:]])

    return project


def _places(coordinates: ArrayLike, project: Project) -> list[list[float]]:
    places = project(np.asarray(coordinates, dtype=np.float64))
    if not np.isfinite(places).all():
        raise ValueError("a GeoJSON coordinate is not finite")
    return [[round(value, DECIMALS) for value in place] for place in places.tolist()]


def _rings(rings: Sequence[ArrayLike], project: Project) -> list[list[list[float]]]:
    return [_ring(_places(ring, project), outer=number == 0) for number, ring in enumerate(rings)]


def _ring(places: list[list[float]], *, outer: bool) -> list[list[float]]:
    """The ring closed; anticlockwise if outer, clockwise if a hole."""
    if places[0] != places[-1]:
        places = [*places, places[0]]
    xy = np.array(places)[:, :2] - places[0][:2]
    area = np.sum(xy[:-1, 0] * xy[1:, 1] - xy[1:, 0] * xy[:-1, 1])
    return places if (area >= 0) == outer else places[::-1]


def _plain(value: Any) -> Any:
    """Converts to JSON types: numpy numbers become Python's, NaN and infinity null."""
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
