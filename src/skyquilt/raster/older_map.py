"""Maps that users bring along, to be shown below: also those whose rows run aslant or from south to
north, whose pixels are numbers of colours, 16-bit colours, or values with a scale.
"""

from dataclasses import dataclass
from functools import cached_property
from math import ceil, floor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import SideFileError, UsageError
from skyquilt.raster.map_source import (
    About,
    Bounds,
    FileSource,
    MapSource,
    Part,
    between,
    plane,
    step_of,
)
from skyquilt.raster.read_map import Box, MapFile, open_map, part_between, read_as, read_reduced

_LOOKED = 512
"""Longer side in px at which the range of colours is looked for."""
_STRETCH = (1.0, 99.0)
"""Percentiles of 16-bit colours that are shown darkest and brightest."""
_MARGIN = 2
"""Pixels of the file, as read, around what is shown."""


def older_map(path: Path) -> MapSource:
    """A map to be shown below.

    Raises:
        UsageError: the file is none, or tells no place on Earth.
    """
    from pyproj.exceptions import CRSError, ProjError

    file = open_map(path)
    if file is None or file.crs is None:
        raise UsageError(f"--base {path} is not a georeferenced map that GDAL can read")
    if file.stored.startswith("c"):
        raise UsageError(f"--base {path} cannot be shown: its pixels are complex numbers")
    try:
        between(file.crs, "EPSG:4326")
    except (CRSError, ProjError) as error:
        raise UsageError(
            f"--base {path} lies in a local coordinate system, which tells no place on Earth; give"
            " a map in one such as EPSG:32633"
        ) from error
    return FileSource(path=path) if _plain(file) else OlderMap(file=file)


def _plain(file: MapFile) -> bool:
    """Whether the pixels are what is to be shown, as they lie in the file."""
    a, b, _, d, e, _ = file.affine
    upright = a > 0 > e and abs(a + e) < 0.01 * a and b == d == 0
    stated = file.masked or file.nodata is None
    shallow = file.bands == 1 or file.stored == "uint8"
    return upright and stated and shallow and not file.beside and _as_stored(file)


def _as_stored(file: MapFile) -> bool:
    return file.palette is None and file.scale == (1.0, 0.0) and not file.stored.startswith("c")


@dataclass(frozen=True, kw_only=True, eq=False)
class OlderMap:
    """A map whose pixels are not simply those of a picture with north up."""

    file: MapFile
    """What the file says of itself."""

    @cached_property
    def crs(self) -> str:
        """Its projection."""
        from rasterio.crs import CRS

        assert self.file.crs is not None
        return plane(str(CRS.from_wkt(self.file.crs).to_string()))

    @cached_property
    def _sides(self) -> tuple[float, float]:
        """Width and height of a pixel in units of the projection."""
        a, b, _, d, e, _ = self.file.affine
        return float(np.hypot(a, d)), float(np.hypot(b, e))

    def about(self) -> About:
        """What it says of itself."""
        file = self.file
        kept = file.stored in ("uint8", "uint16") and _as_stored(file)
        return About(
            crs=self.crs,
            bounds=self.bounds(),
            bands=file.bands,
            dtype="uint8" if file.bands == 3 else file.stored if kept else "float32",
            resolution=min(self._sides),
            units=(file.unit,) if file.unit and file.bands == 1 else (),
        )

    def bounds(self) -> Bounds:
        """The least upright rectangle around it."""
        return self.file.bounds()

    def part(self, bounds: Bounds, gsd: float) -> Part | None:
        """The part with north up and square pixels.

        Raises:
            SideFileError: it cannot be read.
        """
        left, bottom, right, top = self.bounds()
        west, south = max(bounds[0], left), max(bounds[1], bottom)
        east, north = min(bounds[2], right), min(bounds[3], top)
        if west >= east or south >= north:
            return None
        step = step_of(gsd, min(self._sides), max(east - west, north - south))
        west = left + floor((west - left) / step + 1e-6) * step
        north = top - floor((top - north) / step + 1e-6) * step
        h, w = (max(1, ceil(v / step - 1e-6)) for v in (north - south, east - west))
        a, b, c, d, e, f = self.file.affine
        back = np.linalg.inv(np.array([[a, b, c], [d, e, f], [0, 0, 1.0]]))
        pixels_S_part = back @ np.array([[step, 0, west], [0, -step, north], [0, 0, 1.0]])
        window = self._window(pixels_S_part, w, h, step)
        if window is None:
            return None
        row, column, height, width = window
        rows, columns = (
            max(1, round(n * min(1.0, side / step)))
            for n, side in zip((height, width), self._sides[::-1], strict=True)
        )
        try:
            values, valid = read_as(self.file, window, (rows, columns))
        except OSError as error:
            raise SideFileError(f"{self.file.path.name} cannot be shown: {error}") from error
        read_S_pixels = np.diag([columns / width, rows / height, 1.0]) @ np.array(
            [[1.0, 0, -column], [0, 1, -row], [0, 0, 1]]
        )
        half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
        there = np.linalg.inv(half) @ read_S_pixels @ pixels_S_part @ half
        colours = self.file.bands == 3
        how = cv2.INTER_LINEAR if colours else cv2.INTER_NEAREST
        flags, size = cv2.WARP_INVERSE_MAP, (w, h)
        shown = valid.astype(np.uint8)
        seen = np.asarray(
            cv2.warpAffine(shown, there[:2], size, flags=flags | cv2.INTER_NEAREST)
        ).astype(bool)
        pixels = np.asarray(
            cv2.warpAffine(
                self._levels(values)
                if colours
                else np.where(valid, values, 0).astype(values.dtype),
                there[:2],
                size,
                flags=flags | how,
                borderMode=cv2.BORDER_REPLICATE,
            )
        ).reshape(h, w, -1)
        return Part(pixels=pixels, shown=seen, west=west, north=north, gsd=step)

    def _window(
        self, pixels_S_part: NDArray[np.float64], w: int, h: int, step: float
    ) -> Box | None:
        """What a part of w x h px shows of the file."""
        ends = pixels_S_part @ np.array([[0, w, 0, w], [0, 0, h, h], [1, 1, 1, 1.0]])
        around = _MARGIN * max(1.0, step / min(self._sides))
        low, high = ends[:2].min(1) - around, ends[:2].max(1) + around
        return part_between(low, high, (self.file.width, self.file.height))

    @cached_property
    def _range(self) -> tuple[float, float]:
        """Values of a colour map that are shown darkest and brightest."""
        values, valid = read_reduced(self.file, _LOOKED)
        if values.dtype == np.uint8 or not valid.any():
            return 0.0, 255.0
        low, high = np.percentile(values[valid], _STRETCH)
        return float(low), max(float(high), float(low) + 1e-9)

    def _levels(self, values: NDArray[np.generic]) -> NDArray[np.uint8]:
        """Colours of 8 bits."""
        if values.dtype == np.uint8:
            return np.asarray(values, np.uint8)
        low, high = self._range
        with np.errstate(invalid="ignore"):
            levels = (np.nan_to_num(values.astype(np.float32)) - low) * (255 / (high - low))
        return np.asarray(np.clip(levels, 0, 255), np.uint8)
