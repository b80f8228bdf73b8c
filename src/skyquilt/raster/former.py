"""Parts of a raster that is written anew, taken from the file that it replaces: pixels, and the
encoded tiles themselves, so that nothing is compressed twice.
"""

import contextlib
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import rasterio
import tifffile
from numpy.typing import NDArray
from rasterio.windows import Window as Part

from skyquilt.errors import OutputError
from skyquilt.raster.assemble import CODES
from skyquilt.raster.drivers import open_raster
from skyquilt.raster.spec import RasterSpec


class FormerRaster:
    """A raster written by `CogWriter`, open for reading."""

    def __init__(self, path: Path) -> None:
        """Opens it.

        Raises:
            OutputError: it cannot be read.
        """
        self.path = path
        try:
            self._raster = open_raster(path)
            self._file = tifffile.TiffFile(path)
        except (OSError, rasterio.errors.RasterioError, tifffile.TiffFileError) as error:
            raise OutputError(f"cannot read {path}, which photos are to be added to") from error
        pages = [p for p in self._file.pages if isinstance(p, tifffile.TiffPage)]
        self._page = pages[0]
        # a mask follows its image
        self._mask = pages[1] if len(pages) > 1 and pages[1].subfiletype & 4 else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._raster.close()
        self._file.close()

    def band(self) -> NDArray[Any]:
        """All pixels (h, w) of a raster of one band."""
        return np.asarray(self._raster.read(1))

    def pixels(
        self, row: int, column: int, height: int, width: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Pixels (h, w, bands) of a window, and which are valid (h, w)."""
        part = Part(column, row, width, height)
        pixels = np.ascontiguousarray(self._raster.read(window=part).transpose(1, 2, 0))
        if pixels.dtype.kind == "f":
            return pixels, np.asarray(~np.isnan(pixels).all(2))
        return pixels, np.asarray(self._raster.dataset_mask(window=part) > 0)

    def tile(self, row: int, column: int, spec: RasterSpec) -> tuple[bytes, bytes] | None:
        """Bytes of image and mask of a tile as `spec` would have it; None where it is empty, or the
        file is written otherwise.
        """
        page = self._page
        if (page.tilewidth, page.tilelength) != (spec.tile, spec.tile):
            return None
        if int(page.compression) != CODES[spec.compress] or spec.mask != (self._mask is not None):
            return None
        image = self._bytes(page, row, column)
        mask = b"" if self._mask is None else self._bytes(self._mask, row, column)
        return (image, mask) if image and (mask or not spec.mask) else None

    def _bytes(self, page: tifffile.TiffPage, row: int, column: int) -> bytes:
        number = row * -(-page.imagewidth // page.tilewidth) + column
        with contextlib.suppress(IndexError):
            offset, size = page.dataoffsets[number], page.databytecounts[number]
            handle = self._file.filehandle
            handle.seek(offset)
            return bytes(handle.read(size)) if size else b""
        return b""
