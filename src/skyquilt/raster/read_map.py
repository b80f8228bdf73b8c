"""Reads georeferenced rasters in parts or reduced: our maps or those of other programs."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.raster.drivers import open_raster, why_unreadable
from skyquilt.raster.fillings import LARGEST, filling
from skyquilt.raster.placement import metres_per_unit, placement

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

MOST_READ = 40_000_000_000
"""Most pixels that are read to reduce them, some minutes; more need overviews."""
_LOOKED = 1024
"""Longer side in px at which a file is searched for values that may be fillings."""
_FINER = 2
"""Pixels per pixel that are read where values cannot be averaged by GDAL."""


Box = tuple[int, int, int, int]
"""Row, column, height and width of a part of a file in px."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MapFile:
    """A raster file and its georeference."""

    path: Path
    """The file."""
    width: int
    """Columns."""
    height: int
    """Rows."""
    bands: int
    """Number of bands that are read: 1 or 3; an alpha band is validity and does not count."""
    affine: tuple[float, float, float, float, float, float]
    """(a, b, c, d, e, f): corner x = a col + b row + c, y = d col + e row + f."""
    crs: str | None
    """As WKT; None where the file states none."""
    unit: str = ""
    """Unit of the first band, where stated."""
    stored: str = ""
    """Type of the pixels in the file."""
    stored_bands: int = 1
    """Image bands in the file: 1 for a palette."""
    scale: tuple[float, float] = (1.0, 0.0)
    """Factor and offset that turn what is stored into values."""
    palette: NDArray[np.uint8] | None = None
    """(n, 4) RGBA of stored numbers, if these are no values."""
    nodata: float | None = None
    """Stored value of pixels without data; found in the pixels where the file states none."""
    masked: bool = False
    """Whether the file itself says which pixels have data."""
    overviews: bool = False
    """Whether the file holds reduced copies of itself."""
    beside: bool = False
    """Whether control points, or a file beside it, place it."""

    def ground(
        self, column: NDArray[np.float64], row: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """x and y of places in px, counted from the corner."""
        a, b, c, d, e, f = self.affine
        return a * column + b * row + c, d * column + e * row + f

    def pixel(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """(2, n) column and row, counted from the corner, of places on the ground."""
        a, b, c, d, e, f = self.affine
        ground = np.array([np.subtract(x, c), np.subtract(y, f)])
        return np.asarray(np.linalg.solve(np.array([[a, b], [d, e]]), ground))

    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east and north of the least upright rectangle around it."""
        w, h = self.width, self.height
        x, y = self.ground(np.array([0.0, w, 0, w]), np.array([0.0, 0, h, h]))
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())

    @property
    def mirrored(self) -> bool:
        """Whether the file shows the ground as from below: rows from south to north, or columns
        from east to west. Only a CRS of the Earth tells which way axes point.
        """
        a, b, _, d, e, _ = self.affine
        return self.metres is not None and a * e - b * d > 0

    @property
    def metres(self) -> tuple[float, float] | None:
        """Width and height of a pixel on the ground in m, at the middle of the map; None where
        this is not known.
        """
        a, b, _, d, e, f = self.affine
        per = metres_per_unit(self.crs, d * self.width / 2 + e * self.height / 2 + f)
        if per is None:
            return None
        x, y = per
        return float(np.hypot(a * x, d * y)), float(np.hypot(b * x, e * y))

    @property
    def aspect(self) -> float:
        """Width of a pixel on the ground over its height, 1/8 to 8."""
        a, b, _, d, e, _ = self.affine
        wide, high = self.metres or (float(np.hypot(a, d)), float(np.hypot(b, e)))
        return float(np.clip(wide / high, 1 / 8, 8))


def open_map(path: Path) -> MapFile | None:
    """A raster's description, or None where the file is not georeferenced or GDAL cannot read
    it.
    """
    import rasterio

    try:
        with warnings.catch_warnings():
            # reported by None
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            raster = open_raster(path)
        with raster:
            placed = placement(raster, path)
            if placed is None:
                return None
            palette = _palette(raster)
            stored = 3 if raster.count >= 3 else 1
            return MapFile(
                path=path,
                width=raster.width,
                height=raster.height,
                bands=stored if palette is None else 3,
                affine=placed.affine,
                crs=placed.crs,
                unit=raster.units[0] or "",
                stored=raster.dtypes[0],
                stored_bands=stored,
                scale=_scale(raster, stored),
                palette=palette,
                nodata=_nodata(raster),
                masked=_masked(raster),
                overviews=bool(raster.overviews(1)),
                beside=raster.crs is None or raster.transform.is_identity,
            )
    except (rasterio.errors.RasterioError, UnicodeDecodeError):
        return None


def _palette(raster: "DatasetReader") -> NDArray[np.uint8] | None:
    if raster.count != 1 or raster.dtypes[0] not in ("uint8", "uint16"):
        return None
    try:
        colours = raster.colormap(1)
    except ValueError:
        return None
    table = np.zeros((max(colours) + 1, 4), np.uint8)
    for number, rgba in colours.items():
        table[number] = rgba
    return table


def _scale(raster: "DatasetReader", bands: int) -> tuple[float, float]:
    """Those of all bands, if they are the same and mean anything."""
    found = set(zip(raster.scales[:bands], raster.offsets[:bands], strict=True))
    scale, offset = found.pop()
    if found or not scale or not np.isfinite([scale, offset]).all():
        return 1.0, 0.0
    return float(scale), float(offset)


def _masked(raster: "DatasetReader") -> bool:
    from rasterio.enums import MaskFlags

    return MaskFlags.all_valid not in raster.mask_flag_enums[0]


def _nodata(raster: "DatasetReader") -> float | None:
    """The stated value, or one of `fillings.FILLS` that occurs in the first band."""
    import rasterio

    known = _masked(raster) or np.dtype(raster.dtypes[0]).kind not in "if"
    if known or (raster.width * raster.height > MOST_READ and not raster.overviews(1)):
        return None if raster.nodata is None else float(raster.nodata)
    factor = max(1.0, max(raster.width, raster.height) / _LOOKED)
    shape = (max(1, round(raster.height / factor)), max(1, round(raster.width / factor)))
    try:
        seen = raster.read(1, out_shape=shape)
    except rasterio.errors.RasterioError:
        return None  # told when the pixels are read
    low = float(np.nanmin(seen)) if not np.isnan(seen).all() else 0.0
    return filling(low)


def part_between(
    low: NDArray[np.float64], high: NDArray[np.float64], size: tuple[int, int]
) -> Box | None:
    """The part of a file of `size` (width, height) between two places (2,) in px, counted from the
    corner; None if there is none.
    """
    first = np.clip(np.floor(low), 0, size).astype(int)
    last = np.clip(np.ceil(high), 0, size).astype(int)
    if (last - first < 1).any():
        return None
    return int(first[1]), int(first[0]), int(last[1] - first[1]), int(last[0] - first[0])


def read_reduced(source: MapFile, longest: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Pixels (h, w[, 3]) and validity (h, w), averaged so that the longer side has at most
    `longest` px and that pixels are as wide on the ground as they are high.

    Raises:
        OSError: the file's data are damaged, or are no measurements.
    """
    return read_part(source, (0, 0, source.height, source.width), longest)


def read_part(source: MapFile, part: Box, longest: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """The same of a part (row, column, height, width) that lies inside the raster."""
    _, _, height, width = part
    aspect = source.aspect if abs(np.log(source.aspect)) > 0.01 else 1.0
    rows, columns = height * min(1.0, 1 / aspect), width * min(1.0, aspect)
    scale = max(1.0, max(rows, columns) / longest)
    shape = (max(1, round(rows / scale)), max(1, round(columns / scale)))
    return read_as(source, part, shape)


def read_window(
    source: MapFile, row: int, column: int, height: int, width: int
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Pixels (height, width[, 3]) and validity of a part that lies inside the raster.

    Raises:
        OSError: the file's data are damaged, or are no measurements.
    """
    return read_as(source, (row, column, height, width), (height, width))


def read_as(
    source: MapFile, part: Box, shape: tuple[int, int]
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """A part (row, column, height, width) averaged to another shape (height, width).

    Raises:
        OSError: the file's data are damaged, or are no measurements.
    """
    from rasterio.windows import Window

    row, column, height, width = part
    return _read(source, Window(column, row, width, height), shape)


def _read(
    source: MapFile, window: Any, shape: tuple[int, int]
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    import rasterio
    from rasterio.enums import Resampling

    if source.stored.startswith("complex"):
        raise OSError("its pixels are complex numbers; make a map of their amounts first")
    if not source.overviews and window.width * window.height > MOST_READ:
        raise OSError(
            f"it has {source.width} x {source.height} px and no overviews; add them (for instance"
            " with gdaladdo), or cut out the part that is needed"
        )
    own = source.palette is not None or (source.nodata is not None and not source.masked)
    full = (round(window.height), round(window.width))
    finer = tuple(min(f, _FINER * s) for f, s in zip(full, shape, strict=True)) if own else shape
    try:
        with open_raster(source.path) as raster:
            values = raster.read(
                list(range(1, source.stored_bands + 1)),
                window=window,
                out_shape=(source.stored_bands, *finer),
                resampling=Resampling.nearest if own else Resampling.average,
            )
            valid = raster.dataset_mask(window=window, out_shape=finer) > 0
    except rasterio.errors.RasterioError as error:
        raise OSError(f"its pixels cannot be decoded: {why_unreadable(error)}") from error
    if source.nodata is not None and not source.masked:
        valid &= (values != source.nodata).all(0)
    if source.palette is not None:
        colours = source.palette[np.minimum(values[0], len(source.palette) - 1)]
        valid &= colours[..., 3] > 0
        values = np.moveaxis(colours[..., :3], -1, 0)
    pixels = np.moveaxis(values, 0, -1) if source.bands > 1 else values[0]
    if pixels.dtype.kind == "f":
        usual = np.abs(pixels) < LARGEST  # false where it is not a number
        valid &= usual if pixels.ndim == 2 else usual.all(2)
    if source.scale != (1.0, 0.0):
        pixels = pixels * source.scale[0] + source.scale[1]
    if pixels.dtype not in (np.uint8, np.uint16):
        with np.errstate(over="ignore"):  # beyond the largest float32: not valid
            pixels = pixels.astype(np.float32)
    if finer != shape:
        pixels, valid = _reduced(pixels, valid, shape)
    return np.ascontiguousarray(pixels), valid


def _reduced(
    pixels: NDArray[Any], valid: NDArray[np.bool_], shape: tuple[int, int]
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Averages of valid pixels; valid where all are."""
    size = (shape[1], shape[0])
    share = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    wide = valid if pixels.ndim == 2 else valid[..., None]
    sums = np.where(wide, pixels, 0).astype(np.float32)
    means = cv2.resize(sums, size, interpolation=cv2.INTER_AREA)
    if pixels.dtype.kind != "f":
        means = np.rint(means)
    return np.asarray(means.astype(pixels.dtype)), np.asarray(share > 0.999)
