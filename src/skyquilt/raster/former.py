"""Parts of a raster that is written anew, taken from the file that it replaces: pixels, and the
encoded tiles themselves, so that nothing is compressed twice.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import OutputError
from skyquilt.outside import out_of_memory
from skyquilt.raster.assemble import CODES
from skyquilt.raster.spec import RasterSpec

if TYPE_CHECKING:
    from tifffile import TiffPage


class FormerRaster:
    """A raster written by `CogWriter`, open for reading."""

    def __init__(self, path: Path) -> None:
        """Opens it.

        Raises:
            OutputError: it cannot be read.
        """
        import tifffile  # most runs add nothing

        self._path = path
        with self._readable():
            self._file = tifffile.TiffFile(path)
            pages = [p for p in self._file.pages if isinstance(p, tifffile.TiffPage)]
        if not pages:
            raise OutputError(f"{path} is damaged, so no photos can be added to it")
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
        self._file.close()

    @contextlib.contextmanager
    def _readable(self) -> Iterator[None]:
        """Turns whatever decoders raise into an `OutputError`."""
        try:
            yield
        except Exception as error:
            if out_of_memory(error):
                raise
            raise OutputError(
                f"cannot read {self._path}, which photos are to be added to"
            ) from error

    def band(self) -> NDArray[Any]:
        """All pixels (h, w) of a raster of one band; raises OutputError where it is damaged."""
        with self._readable():
            return np.asarray(self._page.asarray())

    def pixels(
        self, row: int, column: int, height: int, width: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Pixels (h, w, bands) of a window whose first one is the first of a tile, and which are
        valid (h, w); zero where the file has no tile. Raises OutputError where it is damaged.
        """
        with self._readable():
            return self._pixels(row, column, height, width)

    def _pixels(
        self, row: int, column: int, height: int, width: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        page, tile = self._page, self._page.tilewidth
        pixels = np.zeros((height, width, page.samplesperpixel), page.dtype)
        shown = np.zeros((height, width), np.bool_)
        for r in range(0, height, tile):
            for c in range(0, width, tile):
                part = self._decoded(page, (row + r) // tile, (column + c) // tile)
                if part is None:
                    continue
                h, w = min(tile, height - r), min(tile, width - c)
                at = (slice(r, r + h), slice(c, c + w))
                pixels[at] = part.reshape(tile, tile, -1)[:h, :w]
                if self._mask is not None:
                    mask = self._decoded(self._mask, (row + r) // tile, (column + c) // tile)
                    shown[at] = mask is not None and mask.reshape(tile, tile)[:h, :w] > 0
                else:
                    shown[at] = True
        if pixels.dtype.kind == "f":
            shown &= ~np.isnan(pixels).all(2)
        return pixels, shown

    def tile(self, row: int, column: int, spec: RasterSpec) -> tuple[bytes, bytes] | None:
        """Bytes of image and mask of a tile as `spec` would have it; None where the file has none,
        or is written otherwise.
        """
        page = self._page
        if (page.tilewidth, page.tilelength) != (spec.tile, spec.tile):
            return None
        if int(page.compression) != CODES[spec.compress] or spec.mask != (self._mask is not None):
            return None
        image = self._bytes(page, row, column)
        mask = b"" if self._mask is None else self._bytes(self._mask, row, column)
        return (image, mask) if image and (mask or not spec.mask) else None

    def _decoded(self, page: "TiffPage", row: int, column: int) -> NDArray[Any] | None:
        """The pixels of a whole tile; None where it is empty."""
        data = self._bytes(page, row, column)
        if not data:
            return None
        number = self._number(page, row, column)
        pixels = page.decode(data, number, jpegtables=page.jpegtables, _fullsize=True)[0]
        return None if pixels is None else np.asarray(pixels)

    def _bytes(self, page: "TiffPage", row: int, column: int) -> bytes:
        number = self._number(page, row, column)
        with contextlib.suppress(IndexError):
            offset, size = page.dataoffsets[number], page.databytecounts[number]
            handle = self._file.filehandle
            handle.seek(offset)
            return bytes(handle.read(size)) if size else b""
        return b""

    @staticmethod
    def _number(page: "TiffPage", row: int, column: int) -> int:
        return int(row * -(-page.imagewidth // page.tilewidth) + column)
