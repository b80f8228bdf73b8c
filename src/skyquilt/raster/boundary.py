"""The area a user wants mapped: a file of polygons into the output CRS, and onto the output's
pixels.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon, make_valid, segmentize, transform, union_all
from shapely.geometry.base import BaseGeometry
from shapely.prepared import prep

from skyquilt.errors import SideFileError
from skyquilt.raster.boundary_files import READERS

SEGMENTS = 100
"""Pieces that an outline's extent is cut into before it is projected: straight lines do not stay
straight.
"""


def read_boundary(path: Path, crs: str | None) -> Polygon | MultiPolygon:
    """All polygons of a GeoJSON, KML, KMZ, WKT, GeoPackage or Shapefile, united, in `crs`.

    WKT is in the output CRS already; the others state theirs. An ungeoreferenced output (`crs`
    None) takes WKT only.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise SideFileError(
            f"{path.name}: a boundary is one of {', '.join(READERS)}, got '{path.suffix}'"
        )
    try:
        shapes, source = reader(path)
    except OSError as error:
        raise SideFileError(f"{path} cannot be read: {error.strerror or error}") from error
    except Exception as error:
        raise SideFileError(
            f"{path.name} is not a readable {path.suffix[1:]} file: {error}"
        ) from error
    areas = [area for shape in shapes for area in _areas(make_valid(shape))]
    if not areas:
        kinds = sorted({shape.geom_type for shape in shapes}) or ["nothing"]
        raise SideFileError(
            f"{path.name}: a boundary needs at least one polygon, found {', '.join(kinds)}"
        )
    return _polygonal(_projected(union_all(areas), path, source, crs))


def inside(
    polygon: BaseGeometry, affine: Sequence[float], *, row0: int, col0: int, height: int, width: int
) -> NDArray[np.bool_]:
    """(height, width), True where a pixel's centre lies in the polygon, for a window of a raster.

    `affine` is the whole raster's (a, b, c, d, e, f), the polygon in its CRS.
    """
    from rasterio.features import geometry_mask
    from rasterio.transform import Affine

    a, b, c, d, e, f = tuple(affine)[:6]
    x, y = a * col0 + b * row0 + c, d * col0 + e * row0 + f
    corners = [(0, 0), (width, 0), (width, height), (0, height)]
    window = Polygon([(x + a * col + b * row, y + d * col + e * row) for col, row in corners])
    prepared = prep(polygon)
    if not prepared.intersects(window):
        return np.zeros((height, width), bool)
    if prepared.contains(window):
        return np.ones((height, width), bool)
    return np.asarray(
        geometry_mask([polygon], (height, width), Affine(a, b, x, d, e, y), invert=True)
    )


def _areas(shape: BaseGeometry) -> list[Polygon]:
    parts = getattr(shape, "geoms", None)
    if parts is not None:
        return [area for part in parts for area in _areas(part)]
    return [shape] if isinstance(shape, Polygon) and shape.area > 0 else []


def _polygonal(shape: BaseGeometry) -> Polygon | MultiPolygon:
    areas = _areas(make_valid(shape))
    return areas[0] if len(areas) == 1 else MultiPolygon(areas)


def _projected(
    shape: BaseGeometry, path: Path, source: str | None, crs: str | None
) -> BaseGeometry:
    if source is None:
        return shape
    if crs is None:
        raise SideFileError(
            f"{path.name} is in {source}, but this mosaic is not georeferenced. "
            "Give the boundary as WKT in the mosaic's own coordinates, or leave it out."
        )
    import pyproj

    try:
        transformer = pyproj.Transformer.from_crs(source, pyproj.CRS(crs).to_2d(), always_xy=True)
    except pyproj.exceptions.CRSError as error:
        raise SideFileError(
            f"{path.name}: the CRS '{source[:60]}' is not known: {error}"
        ) from error
    west, south, east, north = shape.bounds
    fine = segmentize(shape, max(east - west, north - south) / SEGMENTS)
    placed = transform(fine, lambda xy: np.column_stack(transformer.transform(xy[:, 0], xy[:, 1])))
    if not np.isfinite(placed.bounds).all():
        raise SideFileError(
            f"{path.name}: its coordinates {shape.bounds} do not fit its CRS ({source[:60]})"
        )
    return placed
