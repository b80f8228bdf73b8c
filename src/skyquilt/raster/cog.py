"""Writes a Cloud Optimized GeoTIFF tile by tile, with overviews, in little memory, resumable."""

import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from skyquilt.raster.assemble import assemble
from skyquilt.raster.codecs import TileEncoder
from skyquilt.raster.pyramid import Part, Pixels, Pyramid, Valid
from skyquilt.raster.spec import RasterSpec
from skyquilt.raster.spool import Spool


@dataclass(frozen=True, kw_only=True)
class Block:
    """A square of whole tiles of the full-resolution level, cut at the raster's edge."""

    row0: int
    """First pixel row."""
    col0: int
    """First pixel column."""
    height: int
    """Pixel rows."""
    width: int
    """Pixel columns."""
    tile: int
    """Side of a tile in px."""

    def tiles(self) -> Iterator[tuple[int, int, slice, slice]]:
        """(tile_row, tile_col, rows, columns): the arguments of `write_tile`, and slices into the
        block's pixels.
        """
        for row in range(0, self.height, self.tile):
            for col in range(0, self.width, self.tile):
                rows, cols = slice(row, row + self.tile), slice(col, col + self.tile)
                yield (self.row0 + row) // self.tile, (self.col0 + col) // self.tile, rows, cols


Encoded = Mapping[tuple[int, int], tuple[bytes, bytes]]
"""Row and column of tiles -> bytes of image and mask."""


def morton(row: int, col: int) -> int:
    """Position along the Z-order curve."""
    code = 0
    for bit in range(max(row, col).bit_length()):
        code |= (row >> bit & 1) << (2 * bit + 1) | (col >> bit & 1) << (2 * bit)
    return code


def z_order(rows: int, cols: int) -> list[tuple[int, int]]:
    """All (row, col) of a grid along the Z-order curve."""
    return sorted(((r, c) for r in range(rows) for c in range(cols)), key=lambda rc: morton(*rc))


VERSION = 1
"""Spools of another version are not resumed."""


class CogWriter:
    """Writes one raster. As a context manager it assembles the file on a normal exit; after an
    error there is no file.

    With a `digest` (of everything that the pixels depend on) the spool survives an error or a kill,
    and the next writer with the same digest and specification skips the finished blocks. Without a
    digest the spool is removed.
    """

    def __init__(
        self,
        path: Path,
        spec: RasterSpec,
        *,
        spool: Path | None = None,
        digest: str = "",
        block_level: int = 2,
        fsync: bool = False,
        bigtiff: bool | None = None,
    ) -> None:
        """Opens, or reopens, the spool (a folder; beside `path` by default).

        A block is 2^block_level tiles wide: 2048 px by default. With `fsync`, finished blocks also
        survive a power failure. `bigtiff` None = BigTIFF where the size requires it.
        """
        self.path, self.spec = Path(path), spec
        self._resumable, self._bigtiff, self._side = bool(digest), bigtiff, spec.tile << block_level
        self._encoder = TileEncoder(spec)
        self._written = np.zeros(spec.grids[0], bool)
        self._finished: set[tuple[int, int]] = set()
        self._lock, self._closed = threading.Lock(), False
        key = spec.digest(f"{digest}|{block_level}|{VERSION}")
        self._spool = Spool(
            spool or self.path.with_name(self.path.name + ".spool"),
            key,
            fresh=not digest,
            fsync=fsync,
        )
        self._pyramid = Pyramid(self._encoder, self._spool, block_level)
        for record in self._spool.records:
            self._finish(self._block(*self._pyramid.restore(record)))

    def blocks(self) -> Iterator[Block]:
        """The blocks that are still to be written, in an order that keeps few overview tiles
        open.
        """
        for row, col in self._all_blocks():
            if (row, col) not in self._finished:
                yield self._block(row, col)

    def write_tile(
        self,
        tile_row: int,
        tile_col: int,
        pixels: Pixels,
        valid: Valid | None = None,
        encoded: tuple[bytes, bytes] | None = None,
    ) -> None:
        """Encodes and spools one tile of the full resolution; thread-safe. `encoded`: bytes of its
        image and of its mask, where another file with this specification has them.

        Pixels are (h, w, bands), or (h, w) for one band, cut at the raster's edge. `valid` is (h,
        w), None = all (or, with a nodata value, all pixels that differ from it). Each tile is
        written once. Invalid pixels become nodata, masked, or 0.
        """
        part = self._checked(tile_row, tile_col, pixels, valid)
        self._claim(tile_row, tile_col)
        self._pyramid.store(0, tile_row, tile_col, part, encoded)

    def write_block(
        self,
        block: Block,
        pixels: Pixels,
        valid: Valid | None = None,
        encoded: Encoded | None = None,
    ) -> None:
        """Writes and finishes a whole block: pixels (height, width, bands), valid (height,
        width); `encoded`: the bytes of its tiles, see `write_tile`.
        """
        for row, col, rows, cols in block.tiles():
            self.write_tile(
                row,
                col,
                pixels[rows, cols],
                None if valid is None else valid[rows, cols],
                None if encoded is None else encoded.get((row, col)),
            )
        self.finish_block(block)

    def finish_block(self, block: Block) -> None:
        """Makes a block durable: it survives a kill. Its tiles that were not written are empty,
        with no valid pixel.
        """
        for row, col, _, _ in block.tiles():
            if not self._written[row, col]:
                self._claim(row, col)
                self._pyramid.store(0, row, col, None)
        self._spool.commit(self._pyramid.record(block.row0 // self._side, block.col0 // self._side))
        self._finish(block)

    def close(self) -> None:
        """Assembles the file and removes the spool; a second call does nothing."""
        if self._closed:
            return
        if missing := len(self._all_blocks()) - len(self._finished):
            raise ValueError(
                f"{missing} of {len(self._all_blocks())} blocks of {self.path.name} were never"
                " finished"
            )
        assemble(
            self.path, self._encoder, self._pyramid.indices, self._spool.read, big=self._bigtiff
        )
        self._closed = True
        self._spool.close(remove=True)

    def abort(self) -> None:
        """Stops without a file; the spool stays if a digest was given."""
        if not self._closed:
            self._closed = True
            self._spool.close(remove=not self._resumable)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self.close()
        finally:
            self.abort()

    def _all_blocks(self) -> list[tuple[int, int]]:
        return z_order(-(-self.spec.height // self._side), -(-self.spec.width // self._side))

    def _block(self, row: int, col: int) -> Block:
        row0, col0 = row * self._side, col * self._side
        height, width = (
            min(self._side, self.spec.height - row0),
            min(self._side, self.spec.width - col0),
        )
        return Block(row0=row0, col0=col0, height=height, width=width, tile=self.spec.tile)

    def _finish(self, block: Block) -> None:
        for row, col, _, _ in block.tiles():
            self._written[row, col] = True
        with self._lock:
            self._finished.add((block.row0 // self._side, block.col0 // self._side))

    def _claim(self, row: int, col: int) -> None:
        with self._lock:
            if self._written[row, col]:
                raise ValueError(f"tile ({row}, {col}) of {self.path.name} is already written")
            self._written[row, col] = True

    def _checked(self, row: int, col: int, pixels: Pixels, valid: Valid | None) -> Part | None:
        """Pixels (h, w, bands) and their validity; None if no pixel is valid."""
        spec, (rows, cols) = self.spec, self.spec.grids[0]
        if not (0 <= row < rows and 0 <= col < cols):
            raise ValueError(f"tile ({row}, {col}) lies outside the raster's {rows} x {cols} tiles")
        shape = *spec.tile_size(0, row, col), spec.bands
        pixels = pixels[..., None] if pixels.ndim == 2 else pixels
        if pixels.shape != shape or pixels.dtype != np.dtype(spec.dtype):
            raise ValueError(
                f"tile ({row}, {col}) is {shape} of {spec.dtype}, got {pixels.shape} of"
                f" {pixels.dtype}"
            )
        if valid is None and spec.nodata is not None:
            void = np.isnan(pixels) if np.isnan(spec.nodata) else pixels == spec.nodata
            valid = np.asarray(~void.all(axis=2))
        if valid is None or valid.all():
            return pixels, None
        if valid.shape != shape[:2]:
            raise ValueError(
                f"the validity of tile ({row}, {col}) is {shape[:2]}, got {valid.shape}"
            )
        return (pixels, valid.astype(bool)) if valid.any() else None


def write_array(
    path: Path, array: NDArray[Any], spec: RasterSpec, valid: Valid | None = None
) -> None:
    """Writes a raster that fits in memory: (height, width, bands), or (height, width) for one
    band. `valid` (height, width): the pixels that have values.

    Raises:
        ValueError: one of both is not as the specification says.
    """
    size = spec.height, spec.width
    if isinstance(array, np.ma.MaskedArray) and np.ma.is_masked(array):
        raise ValueError("array has masked pixels; give those that are not as `valid`")
    array = np.asarray(array)
    shapes = [(*size, spec.bands), *([size] if spec.bands == 1 else [])]
    if array.shape not in shapes or array.dtype.newbyteorder("=") != np.dtype(spec.dtype):
        raise ValueError(
            f"array is {shapes[0]} of {spec.dtype}, got {array.shape} of {array.dtype}"
        )
    array = array.astype(spec.numpy_dtype, copy=False)
    if valid is not None:
        valid = np.asarray(valid)
        if valid.shape != size or valid.dtype != np.bool_:
            raise ValueError(f"valid is {size} of bool, got {valid.shape} of {valid.dtype}")
    with CogWriter(path, spec) as writer:
        for block in writer.blocks():
            rows = slice(block.row0, block.row0 + block.height)
            cols = slice(block.col0, block.col0 + block.width)
            writer.write_block(
                block, array[rows, cols], None if valid is None else valid[rows, cols]
            )
