"""Super-blocks: squares of tiles, visited in Z-order so that few overview tiles are open at a
time.
"""

from collections.abc import Iterator
from dataclasses import dataclass


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


def morton(row: int, col: int) -> int:
    """Position along the Z-order curve."""
    code = 0
    for bit in range(max(row, col).bit_length()):
        code |= (row >> bit & 1) << (2 * bit + 1) | (col >> bit & 1) << (2 * bit)
    return code


def z_order(rows: int, cols: int) -> list[tuple[int, int]]:
    """All (row, col) of a grid along the Z-order curve."""
    return sorted(((r, c) for r in range(rows) for c in range(cols)), key=lambda rc: morton(*rc))
