"""Blocks of a map from the files of the earlier map that it replaces."""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import OutputError
from skyquilt.imaging.nodes import STEP
from skyquilt.model.raster import Grid, Window
from skyquilt.ortho.companions import BlockExtras, preview_factor, provenance_step, reduced
from skyquilt.raster import Block, RasterSpec
from skyquilt.raster.cog import Encoded
from skyquilt.raster.former import FormerRaster

FILES = ("mosaic.tif", "provenance.tif", "views.tif")
"""The files that blocks are taken from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FormerBlock:
    """A block of the earlier map."""

    pixels: NDArray[Any]
    """(h, w, bands) its pixels."""
    valid: NDArray[np.bool_]
    """(h, w) where it shows a photo."""
    encoded: Encoded
    """Its tiles as they are in the file."""
    extras: BlockExtras
    """What lies beside it."""


class FormerFiles:
    """The rasters of a finished map, open for reading."""

    def __init__(self, folder: Path) -> None:
        """Opens them.

        Raises:
            OutputError: one cannot be read.
        """
        with contextlib.ExitStack() as opened:
            self._map, provenance, views = (
                opened.enter_context(FormerRaster(folder / name)) for name in FILES
            )
            self._provenance, self._views = provenance.band(), views.band()
            self._opened = opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._opened.close()

    def block(
        self, block: Block, old: Window, spec: RasterSpec, names: NDArray[np.uint32], grid: Grid
    ) -> FormerBlock:
        """A block that lies at a window of the earlier map, at a multiple of a tile. `names`: the
        shot number now of each former one; `grid`: that of the map now.

        Raises:
            OutputError: it is damaged in a file.
        """
        pixels, valid = self._map.pixels(old.row, old.column, old.height, old.width)
        down, right = (old.row - block.row0) // spec.tile, (old.column - block.col0) // spec.tile
        tiles = {}
        for row, column, _, _ in block.tiles():
            if (found := self._map.tile(row + down, column + right, spec)) is not None:
                tiles[row, column] = found
        preview, shown = reduced(pixels, valid, preview_factor(grid))
        fine, coarse = (
            tuple(slice(at // step, -(-(at + size) // step)) for at, size in _sides(old))
            for step in (provenance_step(grid), STEP)
        )
        shots = self._provenance[fine]
        if shots.max(initial=0) >= len(names):
            raise OutputError("provenance.tif names photos that the map did not show")
        return FormerBlock(
            pixels=pixels,
            valid=valid,
            encoded=tiles,
            extras=BlockExtras(
                provenance=names[shots],
                views=self._views[coarse].astype(np.uint16),
                preview=preview,
                shown=shown,
            ),
        )


def _sides(window: Window) -> tuple[tuple[int, int], tuple[int, int]]:
    return (window.row, window.height), (window.column, window.width)
