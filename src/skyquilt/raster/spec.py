"""The specification of a raster file: size, type, georeference, compression."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from skyquilt.typed import typed

Compression = Literal["jpeg", "deflate", "zstd", "lzw", "none"]
Resampling = Literal["average", "mode", "nearest", "max"]
MOST_TILE = 8192
"""Largest side of a tile in px."""
DTYPES = ("uint8", "uint16", "uint32", "int16", "float32")


@dataclass(frozen=True, kw_only=True)
class RasterSpec:
    """Everything that a COG writer must know before the first pixel."""

    width: int
    """Columns."""
    height: int
    """Rows."""
    bands: int
    """Samples per pixel."""
    dtype: str
    """One of `DTYPES`."""
    transform: Sequence[float]
    """(a, b, c, d, e, f), as `affine.Affine`: corner x = a col + b row + c, y = d col + e row + f.
    """
    crs: str | None = None
    """As pyproj reads it (`EPSG:32615`, WKT); None = ungeoreferenced."""
    vertical: int | None = None
    """EPSG code of the heights' reference: a vertical CRS, or a three-dimensional geographic one
    for heights above its ellipsoid; None = none.
    """
    nodata: float | None = None
    """Value of pixels without data; NaN for radiometric rasters."""
    compress: Compression = "deflate"
    """`jpeg` takes uint8 with one or three bands; the others are lossless."""
    quality: int = 85
    """JPEG quality, 1 to 100."""
    mask: bool = False
    """Write an internal 1-bit mask of valid pixels at every level."""
    overviews: Resampling = "average"
    """How four pixels are reduced to one."""
    tile: int = 512
    """Side of a tile in px, a multiple of 16."""
    tags: dict[str, str] = field(default_factory=dict)
    """Metadata of the file, as GDAL shows them."""
    band_names: tuple[str, ...] = ()
    """Description of each band."""
    band_units: tuple[str, ...] = ()
    """Unit of each band, e.g. `m`."""

    def __post_init__(self) -> None:
        typed(self)
        for name, kinds in (("compress", Compression), ("overviews", Resampling)):
            if getattr(self, name) not in get_args(kinds):
                raise ValueError(
                    f"{name} is one of {', '.join(get_args(kinds))}, got {getattr(self, name)!r}"
                )
        if not 1 <= self.quality <= 100:
            raise ValueError(f"quality is 1 to 100, got {self.quality}")
        if self.vertical is not None and self.vertical < 1:
            raise ValueError(f"vertical is an EPSG code, got {self.vertical}")
        if not _invertible(self.transform):
            raise ValueError(
                f"transform is six finite numbers that turn pixels into places, got"
                f" {self.transform!r}"
            )
        if self.crs is not None and not _known(self.crs):
            raise ValueError(
                f"crs is a coordinate system such as EPSG:32615, got {self.crs[:100]!r}"
            )
        if self.width < 1 or self.height < 1 or self.bands < 1:
            raise ValueError(
                f"width, height and bands are 1 or more, got {self.width} x {self.height} x"
                f" {self.bands}"
            )
        if self.dtype not in DTYPES:
            raise ValueError(f"dtype is one of {', '.join(DTYPES)}, got {self.dtype}")
        if not 16 <= self.tile <= MOST_TILE or self.tile % 16:
            raise ValueError(f"tile is a multiple of 16 px up to {MOST_TILE}, got {self.tile}")
        if self.compress == "jpeg" and (self.dtype != "uint8" or self.bands not in (1, 3)):
            raise ValueError(f"JPEG takes 1 or 3 bands of uint8, got {self.bands} of {self.dtype}")
        if self.nodata is not None and self.compress == "jpeg":
            raise ValueError("JPEG does not keep a nodata value; use a mask instead")
        if self.nodata is not None and not _holds(np.dtype(self.dtype), self.nodata):
            raise ValueError(f"{self.dtype} cannot hold the nodata value {self.nodata}")
        for what, names in (("band_names", self.band_names), ("band_units", self.band_units)):
            if names and len(names) != self.bands:
                raise ValueError(f"{what} has {len(names)} entries, the raster {self.bands} bands")

    @property
    def numpy_dtype(self) -> np.dtype:
        """The pixel type, little-endian as in the file."""
        return np.dtype(self.dtype).newbyteorder("<")

    @property
    def affine(self) -> tuple[float, float, float, float, float, float]:
        """The six numbers of the transform (an `affine.Affine` has nine)."""
        a, b, c, d, e, f = (float(value) for value in tuple(self.transform)[:6])
        return a, b, c, d, e, f

    @property
    def levels(self) -> tuple[tuple[int, int], ...]:
        """(height, width) of each level in px: full size, then halves until one tile holds
        everything.
        """
        sizes = [(self.height, self.width)]
        while max(sizes[-1]) > self.tile:
            h, w = sizes[-1]
            sizes.append(((h + 1) // 2, (w + 1) // 2))
        return tuple(sizes)

    @property
    def grids(self) -> tuple[tuple[int, int], ...]:
        """(rows, columns) of tiles of each level."""
        return tuple((-(-h // self.tile), -(-w // self.tile)) for h, w in self.levels)

    def tile_size(self, level: int, row: int, col: int) -> tuple[int, int]:
        """(height, width) in px of the part of a tile that lies inside the raster."""
        h, w = self.levels[level]
        return min(self.tile, h - row * self.tile), min(self.tile, w - col * self.tile)

    def digest(self, salt: str = "") -> str:
        """Hex digest of the specification and of `salt`."""
        return hashlib.sha256(f"{self!r}|{salt}".encode()).hexdigest()


def _invertible(transform: Sequence[float]) -> bool:
    """Whether these are six numbers, or the nine of an `affine.Affine`, that can be inverted."""
    try:
        numbers = np.array(tuple(transform), float)
    except (TypeError, ValueError):
        return False
    if numbers.shape not in ((6,), (9,)) or not np.isfinite(numbers).all():
        return False
    return bool(numbers[0] * numbers[4] != numbers[1] * numbers[3])


def _known(crs: str) -> bool:
    from pyproj import CRS  # it takes a while to load, and some rasters have none
    from pyproj.exceptions import CRSError

    try:
        CRS.from_user_input(crs)
    except CRSError:
        return False
    return True


def _holds(dtype: np.dtype, value: float) -> bool:
    if dtype.kind == "f":
        return True
    limits = np.iinfo(dtype)
    return value == value // 1 and limits.min <= value <= limits.max
