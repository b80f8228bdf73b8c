"""The levels of a raster during writing: each tile is encoded once and passes its reduced half to
the level above.
"""

import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.raster.codecs import TileEncoder, pack_mask, unpack_mask
from skyquilt.raster.halving import halve
from skyquilt.raster.spool import Spool

Pixels = NDArray[Any]
Valid = NDArray[np.bool_]
Part = tuple[Pixels, Valid | None]
"""Pixels (h, w, bands) and their validity (h, w), None = all. None in place of a part = nothing
valid.
"""

_RECORD = struct.Struct("<IIQQ")


@dataclass(eq=False)
class _Open:
    """An overview tile that still waits for some of its up to four parts."""

    pixels: Pixels
    valid: Valid
    missing: int


class Pyramid:
    """Encodes tiles into a spool, level by level; only incomplete overview tiles are held in
    memory.

    The halves of tiles of `block_level` are spooled too: a resumed run rebuilds the levels above
    from them (`record`, `restore`). Thread-safe.
    """

    def __init__(self, encoder: TileEncoder, spool: Spool, block_level: int) -> None:
        self.spec, self._encoder, self._spool, self._block_level = (
            encoder.spec,
            encoder,
            spool,
            block_level,
        )
        self.indices = [np.zeros((*grid, 3), np.uint64) for grid in self.spec.grids]
        """Per level (rows, columns, 3): offset in the spool, bytes of image, bytes of mask; 0 =
        empty.
        """
        self._open: dict[tuple[int, int, int], _Open] = {}
        self._halves: dict[tuple[int, int], tuple[int, int]] = {}
        self._lock = threading.Lock()

    def store(
        self,
        level: int,
        row: int,
        col: int,
        part: Part | None,
        encoded: tuple[bytes, bytes] | None = None,
    ) -> None:
        """Encodes one whole tile, unless it is `encoded` already, and passes its half to the level
        above.
        """
        half = None
        if part is not None:
            image, mask = encoded or self._encoder(*part)
            self.indices[level][row, col] = self._spool.append(image + mask), len(image), len(mask)
            if level + 1 < len(self.indices):
                half = halve(*part, self.spec.overviews)
        if level == self._block_level:
            self._halves[row, col] = self._spool_half(half)
        self._pass_up(level, row, col, half)

    def record(self, row: int, col: int) -> bytes:
        """What a resumed run needs about a finished block: where its tiles are, and its half."""
        half = self._halves.pop((row, col), (0, 0))
        return _RECORD.pack(row, col, *half) + b"".join(
            part.tobytes() for part in self._slices(row, col)
        )

    def restore(self, record: bytes) -> tuple[int, int]:
        """Takes over a block of an earlier run; returns its row and column."""
        row, col, offset, size = _RECORD.unpack_from(record)
        at = _RECORD.size
        for part in self._slices(row, col):
            part[...] = np.frombuffer(record, np.uint64, part.size, at).reshape(part.shape)
            at += part.nbytes
        if self._block_level + 1 < len(self.indices):
            self._pass_up(self._block_level, row, col, self._read_half(row, col, offset, size))
        return row, col

    def _slices(self, row: int, col: int) -> Iterator[NDArray[np.uint64]]:
        """The part of each index, up to the block's own level, that belongs to a block."""
        for level, index in enumerate(self.indices[: self._block_level + 1]):
            side = 1 << (self._block_level - level)
            yield index[row * side : (row + 1) * side, col * side : (col + 1) * side]

    def _pass_up(self, level: int, row: int, col: int, half: Part | None) -> None:
        if level + 1 == len(self.indices):
            return
        above = level + 1, row // 2, col // 2
        with self._lock:
            if above not in self._open:
                self._open[above] = self._opened(*above)
            target = self._open[above]
        if half is not None:
            self._place(target, row % 2, col % 2, half)
        with self._lock:
            target.missing -= 1
            if target.missing:
                return
            del self._open[above]
        valid = None if target.valid.all() else target.valid
        self.store(
            *above, None if valid is not None and not valid.any() else (target.pixels, valid)
        )

    def _opened(self, level: int, row: int, col: int) -> _Open:
        height, width = self.spec.tile_size(level, row, col)
        rows, cols = self.spec.grids[level - 1]
        parts = min(2, rows - 2 * row) * min(2, cols - 2 * col)
        pixels = np.zeros((height, width, self.spec.bands), self.spec.numpy_dtype)
        return _Open(pixels=pixels, valid=np.zeros((height, width), bool), missing=parts)

    def _place(self, target: _Open, down: int, right: int, half: Part) -> None:
        pixels, valid = half
        row, col = down * self.spec.tile // 2, right * self.spec.tile // 2
        place = slice(row, row + pixels.shape[0]), slice(col, col + pixels.shape[1])
        target.pixels[place] = pixels
        target.valid[place] = True if valid is None else valid

    def _spool_half(self, half: Part | None) -> tuple[int, int]:
        if half is None:
            return 0, 0
        pixels, valid = half
        data = pixels.tobytes() + (b"" if valid is None else pack_mask(valid))
        return self._spool.append(data), len(data)

    def _read_half(self, row: int, col: int, offset: int, size: int) -> Part | None:
        if not size:
            return None
        height, width = (-(-side // 2) for side in self.spec.tile_size(self._block_level, row, col))
        shape, data = (height, width, self.spec.bands), self._spool.read(offset, size)
        count = height * width * self.spec.bands
        pixels = np.frombuffer(data, self.spec.numpy_dtype, count).reshape(shape)
        mask = data[pixels.nbytes :]
        return pixels, unpack_mask(mask, height, width) if mask else None
