"""Where a raster lies on the ground: its georeference, control points in it, files beside it."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from skyquilt.geometry.frames import METRES_PER_DEGREE
from skyquilt.outside import open_regular

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

_MOST_OFF = 0.5
"""Largest distance in px of control points from the plane placement that stands for them."""
_LEAST_POINTS = 3
_MOST_PRJ = 100_000
"""Bytes of a .prj file."""


@dataclass(frozen=True, kw_only=True)
class Placement:
    """A raster's place."""

    affine: tuple[float, float, float, float, float, float]
    """(a, b, c, d, e, f): corner x = a col + b row + c, y = d col + e row + f."""
    crs: str | None
    """As WKT; None where nothing states one."""


def placement(raster: "DatasetReader", path: Path) -> Placement | None:
    """The place of an open raster; None if nothing tells it, or not as a plane."""
    crs = raster.crs.to_wkt() if raster.crs else None
    affine = tuple(raster.transform)[:6]
    determinant = affine[0] * affine[4] - affine[1] * affine[3]
    if not np.isfinite(affine).all() or not determinant:
        return None
    if not raster.transform.is_identity:
        return Placement(affine=affine, crs=crs or _beside(path))
    points, system = raster.gcps
    if len(points) >= _LEAST_POINTS:
        px, ground = (np.array([(p.col, p.row) for p in points], float),
                      np.array([(p.x, p.y) for p in points], float))  # fmt: skip
        return _through(px, ground, system.to_wkt() if system else None)
    return Placement(affine=affine, crs=crs) if crs else None


def _through(px: np.ndarray, ground: np.ndarray, crs: str | None) -> Placement | None:
    """The placement by control points, px (n, 2) and ground (n, 2), if it fits them."""
    middle = ground.mean(0)
    design = np.c_[px, np.ones(len(px))]
    found, _, rank, _ = np.linalg.lstsq(design, ground - middle, rcond=None)
    linear = found[:2].T
    if rank < 3 or not np.isfinite(found).all() or not np.linalg.det(linear):
        return None
    off = np.linalg.solve(linear, (design @ found - (ground - middle)).T)
    if np.hypot(*off).max() > _MOST_OFF:
        return None
    (a, b), (d, e) = linear.tolist()
    c, f = (found[2] + middle).tolist()
    return Placement(affine=(a, b, c, d, e, f), crs=crs)


def _beside(path: Path) -> str | None:
    """The CRS in the .prj beside a picture with a world file; None if there is none."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    for suffix in (".prj", ".PRJ"):
        try:
            with open_regular(path.with_suffix(suffix)) as file:
                text = file.read(_MOST_PRJ)
            return str(CRS.from_wkt(text.decode("utf-8-sig")).to_wkt())
        except (OSError, UnicodeDecodeError, CRSError):
            continue
    return None


@lru_cache(maxsize=16)
def _kind(crs: str) -> float | None:
    """Metres per unit of a projected CRS; 0 for degrees; None for others."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        system = CRS.from_user_input(crs)
    except CRSError:
        return None
    if system.is_geographic:
        return 0.0
    if not system.is_projected:
        return None
    return float(system.axis_info[0].unit_conversion_factor)


def metres_per_unit(crs: str | None, y: float) -> tuple[float, float] | None:
    """Metres per unit of x and of y at a place; None where a CRS does not tell."""
    kind = _kind(crs) if crs else None
    if kind is None:
        return None
    if kind:
        return kind, kind
    return METRES_PER_DEGREE * max(float(np.cos(np.radians(y))), 1e-3), METRES_PER_DEGREE
