"""Heights of the ground or of a surface model in the plan's zone."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shapely import contains_xy
from shapely.geometry.base import BaseGeometry

from skyquilt.errors import SideFileError
from skyquilt.planning.records import Array
from skyquilt.raster.drivers import open_raster, why_unreadable
from skyquilt.raster.map_source import between, plane
from skyquilt.raster.read_map import Box, MapFile, open_map, part_between, read_as

MOST_SIDE = 3000
"""Largest number of heights along one side."""
HEIGHTS = (-500.0, 9000.0)
"""Heights in m that are taken for ground."""
_AROUND = 4
"""Pixels of the file around what is needed."""
_FEET = (
    "ft",
    "foot",
    "feet",
    "footinternational",
    "internationalfoot",
    "ftus",
    "usft",
    "ussurveyfoot",
    "ussurveyfeet",
    "footus",
    "footussurvey",
)
"""Words for feet as units of bands."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrain:
    """A raster of heights; flat at 0 where nothing is known."""

    heights: NDArray[np.float32]
    """(rows, columns) in m, all finite; row 0 is the northernmost."""
    west: float = 0.0
    """Left edge in m."""
    north: float = 0.0
    """Upper edge in m."""
    cell: float = 1.0
    """Side of a cell in m."""
    known: bool = False
    """Whether a file was given."""

    def at(self, x: Array, y: Array) -> Array:
        """Heights in m of places of any shape, interpolated linearly; beyond the raster those of
        its rim.
        """
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        if not self.known:
            return np.zeros(x.shape)
        rows, columns = self.heights.shape
        c = np.clip((x - self.west) / self.cell - 0.5, 0, columns - 1.000001)
        r = np.clip((self.north - y) / self.cell - 0.5, 0, rows - 1.000001)
        i, j = r.astype(np.int64), c.astype(np.int64)
        v, u = r - i, c - j
        z = self.heights
        upper = z[i, j] * (1 - u) + z[i, j + 1] * u
        lower = z[i + 1, j] * (1 - u) + z[i + 1, j + 1] * u
        return np.asarray(upper * (1 - v) + lower * v, np.float64)

    def highest(self, shape: BaseGeometry) -> float:
        """The largest height inside a shape."""
        west, south, east, north = shape.bounds
        x, y = np.meshgrid(np.linspace(west, east, 60), np.linspace(south, north, 60))
        inside = contains_xy(shape, x, y)
        if not inside.any():
            inside[:] = True
        return float(self.at(x[inside], y[inside]).max())

    def around(self, x: Array, y: Array, radius: float) -> Array:
        """The largest heights (n,) within a radius of places (n,)."""
        steps = int(np.clip(np.ceil(radius / self.cell), 1, 8)) if self.known else 0
        offsets = np.linspace(-radius, radius, 2 * steps + 1) if steps else np.zeros(1)
        du, dv = np.meshgrid(offsets, offsets)
        near = np.hypot(du, dv) <= radius * 1.001
        return np.asarray(
            self.at(x[:, None] + du[near][None], y[:, None] + dv[near][None]).max(axis=1)
        )

    def steepest(self) -> float:
        """The largest slope between neighbouring heights, m per m."""
        if not self.known:
            return 0.0
        rows, columns = (np.abs(np.diff(self.heights, axis=k)).max(initial=0) for k in (0, 1))
        return float(np.hypot(rows, columns)) / self.cell


FLAT = Terrain(heights=np.zeros((2, 2), np.float32))
"""Ground of which nothing is known."""


def read_terrain(path: Path, crs: str, area: BaseGeometry, margin: float) -> Terrain:
    """Heights of an area grown by a margin (m), in the zone of the plan.

    Beyond the area, holes are closed with the nearest height.

    Raises:
        SideFileError: the file is no georeferenced raster of heights, lies elsewhere, or has holes
            in the area.
    """
    path = Path(path)
    file = _opened(path)
    around = area.buffer(margin).bounds
    part = _part(file, crs, around)
    if part is None:
        raise SideFileError(
            f"{path.name} has no height in the area: it lies elsewhere on Earth; give the terrain"
            " of the area"
        )
    heights, placed = _read(file, part)
    empty, west, north, cell = _grid(file, crs, around)
    _project(heights, placed, str(file.crs), empty, (west, north, cell), crs)
    return Terrain(
        heights=_closed(path, empty, west, north, cell, area),
        west=west,
        north=north,
        cell=cell,
        known=True,
    )


def _opened(path: Path) -> MapFile:
    """The raster, if it is one of heights whose place on Earth is known."""
    import rasterio
    from pyproj import CRS
    from rasterio.errors import NotGeoreferencedWarning

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with open_raster(path):
                pass
    except (rasterio.errors.RasterioError, UnicodeDecodeError) as error:
        raise SideFileError(
            f"{path.name} cannot be read as a raster of heights: {why_unreadable(error)}"
        ) from error
    file = open_map(path)
    if file is None or file.crs is None:
        raise SideFileError(
            f"{path.name} does not say its coordinate system; write it into the file (for"
            " instance with gdal_edit -a_srs)"
        )
    system = CRS.from_wkt(file.crs)
    if not (system.is_geographic or system.is_projected):
        raise SideFileError(
            f"{path.name} lies in a local coordinate system, which tells no place on Earth; give"
            " heights in one such as EPSG:32633"
        )
    if file.bands == 3:
        raise SideFileError(f"{path.name} is a picture with colours, not a raster of heights")
    if file.stored == "uint8" and file.scale == (1.0, 0.0) and not file.unit:
        raise SideFileError(
            f"{path.name} holds grey levels of 0 to 255, as a picture or a hillshade, not heights"
            " in m"
        )
    return file


def _part(file: MapFile, crs: str, around: tuple[float, float, float, float]) -> Box | None:
    """The part of the file that shows a rectangle (west, south, east, north) of another CRS; None
    if there is none.
    """
    west, south, east, north = around
    x, y = np.meshgrid(np.linspace(west, east, 5), np.linspace(south, north, 5))
    x, y = between(crs, str(file.crs)).transform(x.ravel(), y.ravel())
    px = file.pixel(x, y)
    if not np.isfinite(px).all():
        return None
    size = file.width, file.height
    inside = np.clip([px.min(1), px.max(1)], 0, size)
    if (inside[1] - inside[0] <= 0).any():
        return None
    return part_between(px.min(1) - _AROUND, px.max(1) + _AROUND, size)


def _read(file: MapFile, part: Box) -> tuple[NDArray[np.float32], tuple[float, ...]]:
    """Heights in m of a part (NaN where there are none), at most twice as many along a side as a
    terrain has, and the affine that places them.
    """
    row, column, height, width = part
    shape = min(height, 2 * MOST_SIDE), min(width, 2 * MOST_SIDE)
    try:
        values, valid = read_as(file, part, shape)
    except OSError as error:
        raise SideFileError(f"{file.path.name} cannot be read: {error}") from error
    heights = values.astype(np.float32) * np.float32(_metres(file))
    # before anything is interpolated, or what is no height would be mixed with what is
    good = valid & (heights >= HEIGHTS[0]) & (heights <= HEIGHTS[1])
    a, b, _, d, e, _ = file.affine
    x, y = width / shape[1], height / shape[0]
    (left,), (top,) = file.ground(np.array([float(column)]), np.array([float(row)]))
    placed = a * x, b * y, float(left), d * x, e * y, float(top)
    return np.where(good, heights, np.float32("nan")), placed


def _metres(file: MapFile) -> float:
    """Metres per unit of the heights: as the band says, else the vertical part of the CRS."""
    from pyproj import CRS

    word = "".join(c for c in file.unit.lower() if c.isalpha())
    if word:
        if word in _FEET:
            return 1200 / 3937 if "us" in word else 0.3048
        return {"cm": 0.01, "centimetre": 0.01, "centimeter": 0.01, "dm": 0.1}.get(word, 1.0)
    parts = CRS.from_wkt(str(file.crs)).sub_crs_list
    heights = [axis for part in parts if part.is_vertical for axis in part.axis_info]
    return float(heights[0].unit_conversion_factor) if heights else 1.0


def _project(
    heights: NDArray[np.float32],
    placed: tuple[float, ...],
    source: str,
    out: NDArray[np.float32],
    to: tuple[float, float, float],
    crs: str,
) -> None:
    """Interpolates heights onto the grid of `out` (west, north, cell)."""
    from rasterio.transform import Affine, from_origin
    from rasterio.warp import Resampling, reproject

    west, north, cell = to
    reproject(
        heights,
        out,
        src_transform=Affine(*placed),
        src_crs=plane(source),
        src_nodata=np.nan,
        dst_transform=from_origin(west, north, cell, cell),
        dst_crs=crs,
        dst_nodata=np.nan,
        resampling=Resampling.bilinear,
    )


def _grid(
    file: MapFile, crs: str, around: tuple[float, float, float, float]
) -> tuple[NDArray[np.float32], float, float, float]:
    """An empty raster over a rectangle, about as fine as the file."""
    from rasterio.warp import calculate_default_transform

    west, south, east, north = around
    affine, _, _ = calculate_default_transform(
        plane(str(file.crs)), crs, file.width, file.height, *file.bounds()
    )
    cell = max(abs(affine.a), (east - west) / MOST_SIDE, (north - south) / MOST_SIDE)
    shape = int((north - south) / cell) + 2, int((east - west) / cell) + 2
    return np.full(shape, np.nan, np.float32), west, north, float(cell)


def _closed(
    path: Path,
    heights: NDArray[np.float32],
    west: float,
    north: float,
    cell: float,
    area: BaseGeometry,
) -> NDArray[np.float32]:
    """The heights without holes; raises SideFileError where there are some inside the area."""
    from scipy.ndimage import distance_transform_edt

    good = np.isfinite(heights) & (heights >= HEIGHTS[0]) & (heights <= HEIGHTS[1])
    rows, columns = heights.shape
    x, y = west + (np.arange(columns) + 0.5) * cell, north - (np.arange(rows) + 0.5) * cell
    gx, gy = np.meshgrid(x, y)
    holes = int((contains_xy(area, gx[~good], gy[~good])).sum())
    if holes:
        raise SideFileError(
            f"{path.name} has no height in {holes * cell * cell:.0f} m2 of the area; fill its holes"
            " or give another one"
        )
    if not good.any():
        raise SideFileError(f"{path.name} has no height in the area")
    at = distance_transform_edt(~good, return_distances=False, return_indices=True)
    return np.ascontiguousarray(heights[tuple(at)])
