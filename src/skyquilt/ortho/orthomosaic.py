"""The map drawn block by block in bounded memory, with what lies beside it: which photo each place
shows, how many photos see it, and a preview.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.heights import VERTICAL_EPSG
from skyquilt.engine.clock import Steps
from skyquilt.engine.folder import STATE
from skyquilt.engine.pixel_cache import PhotoParts
from skyquilt.engine.store import Store, digest
from skyquilt.engine.workers import Workers
from skyquilt.errors import OutputError, UsageError
from skyquilt.imaging.nodes import View
from skyquilt.model.poses import Alignment
from skyquilt.model.raster import Window
from skyquilt.ortho.blend import Blend
from skyquilt.ortho.companions import (
    BlockExtras,
    Companions,
    Drawn,
    colour_range,
    coloured,
    extras_of,
    geotransform,
    provenance_step,
    shot_numbers,
)
from skyquilt.ortho.compose import Composer, PartPixels, PhotoPixels
from skyquilt.ortho.earlier import Growth
from skyquilt.ortho.exposure import Exposure
from skyquilt.ortho.former_files import FormerBlock, FormerFiles
from skyquilt.ortho.ground import Ground, poses_digest
from skyquilt.ortho.labels import Labels
from skyquilt.ortho.radiometry import value_tags
from skyquilt.raster import Block, CogWriter, RasterSpec, write_array
from skyquilt.raster.spec import Compression
from skyquilt.settings import OutputSettings

BLOCK = 2048
"""Side in px of the pieces that the map is drawn in."""
SPOOL = "mosaic.spool"
"""Where the map's tiles wait, below the run's state."""


def composer(
    bands: int,
    dtype: str,
    ground: Ground,
    exposure: Exposure,
    labels: Labels | None,
    blend: Blend,
    pixels: PhotoPixels,
    parts: PartPixels | None = None,
) -> Composer:
    """The composer of a survey's map; all photos have pixels of one kind."""
    return Composer(
        grid=ground.grid,
        views=ground.views,
        surface=ground.surface,
        blend=blend,
        pixels=pixels,
        bands=bands,
        dtype=np.dtype(dtype),
        exposure=exposure,
        labels=labels,
        parts=parts,
        detailed=True,
    )


def not_jpeg(dtype: np.dtype[Any] | str, bands: int) -> str:
    """Why JPEG does not hold pixels of a kind; empty where it does."""
    if np.dtype(dtype) == np.uint8 and bands in (1, 3):
        return ""
    return f"--compress jpeg is for 8-bit pictures; these photos are {dtype}, {bands} bands"


def mosaic_spec(
    compose: Composer, alignment: Alignment, settings: OutputSettings, unit: str
) -> RasterSpec:
    """How mosaic.tif is written."""
    compress, unfit = cast(Compression, settings.compress), not_jpeg(compose.dtype, compose.bands)
    if settings.compress == "auto":
        compress = "deflate" if unfit else "jpeg"
    if compress == "jpeg" and unfit:
        raise UsageError(unfit)
    real = compose.dtype.kind == "f"
    return RasterSpec(
        width=compose.grid.width,
        height=compose.grid.height,
        bands=compose.bands,
        dtype=str(compose.dtype),
        transform=geotransform(compose.grid, alignment),
        crs=alignment.frame.crs,
        compress=compress,
        quality=settings.quality,
        mask=not real,
        nodata=float("nan") if real else None,
        tags={"SOFTWARE": "Skyquilt", "METHOD": alignment.method}
        | value_tags(unit, compose.exposure),
        band_units=(unit,) * compose.bands if unit else (),
    )


def map_key(
    run_key: str, alignment: Alignment, ground: Ground, exposure: Exposure, labels: Labels | None
) -> str:
    """What a drawn map depends on."""
    return digest(
        run_key,
        poses_digest(alignment),
        ground.surface.z,
        dict(exposure.gains),
        dict(exposure.fields),
        dict(exposure.offsets),
        dict(exposure.patterns),
        dict(exposure.shades),
        None if labels is None else labels.photo,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawing:
    """A map while it is drawn: mosaic.tif, then provenance.tif and views.tif; a killed run goes on
    at the block where it stopped.
    """

    output: Path
    """Folder of the files."""
    compose: Composer
    """Composes the map's blocks."""
    alignment: Alignment
    """The photos' poses, and the map's frame."""
    settings: OutputSettings
    """How the files are written."""
    boundary: Path | None
    """Polygon outside which the map is empty."""
    unit: str
    """Unit of the pixels; empty for pictures."""
    store: Store
    """Keeps what lies beside the map, by block."""
    key: str
    """What the map depends on (`map_key`)."""
    parts: PhotoParts | None = None
    """Where the composer takes parts of photos from; its steps are the corners of blocks."""
    growth: Growth | None = None
    """The earlier map that it continues: blocks away from what changed are those of its files."""

    def blocks(self, workers: Workers) -> Steps[None]:
        """Writes mosaic.tif."""
        path, spool = self.output / "mosaic.tif", self.output / STATE / SPOOL
        if self.store.get("blocks", digest(self.key, "file")) == _stamp(path):
            return
        spec, one = self._spec, self._block()
        with CogWriter(path, spec, spool=spool, digest=self.key) as writer:
            todo, total = list(writer.blocks()), len(_blocks(spec))
            stay = self._staying(todo)
            kept = self._former(stay, spec)
            drawn = workers.each(one, [b for b in todo if b not in stay])
            for block in {*_blocks(spec)} - {*todo}:
                self._leave(block)
            for done, block in enumerate(todo):  # in this order few overview tiles are open
                former = next(kept) if block in stay else None
                if former is not None:
                    pixels, valid, extras = former.pixels, former.valid, former.extras
                    encoded = former.encoded
                else:
                    found = one(block) if block in stay else next(drawn)
                    (pixels, valid, extras), encoded = found, None
                self.store.put("blocks", self._block_key(block), extras)
                self._leave(block)
                writer.write_block(block, pixels, valid, encoded)
                yield total - len(todo) + done + 1, total
        self.store.put("blocks", digest(self.key, "file"), _stamp(path))

    def _staying(self, todo: Sequence[Block]) -> dict[Block, Window]:
        """Blocks that the earlier map has already, and where."""
        if self.growth is None:
            return {}
        grid, grows = self.compose.grid, self.growth
        if provenance_step(grid) != provenance_step(grows.earlier.grid):
            return {}  # its provenance is too fine for the grown map
        found = ((b, grows.stays(_window(b), grid)) for b in todo)
        return {b: old for b, old in found if old is not None}

    def _leave(self, block: Block) -> None:
        """Makes room for what later blocks show."""
        if self.parts is not None:
            self.parts.done((block.row0, block.col0))

    def _former(
        self, stay: Mapping[Block, Window], spec: RasterSpec
    ) -> Iterator[FormerBlock | None]:
        """These blocks, from the files of the earlier map; None for what is damaged there."""
        if self.growth is None or not stay:
            return
        table = shot_numbers(self.compose)
        names = np.array([0, *(table[i] for i in self.growth.earlier.shown)], np.uint32)
        with ExitStack() as opened:
            files: FormerFiles | None = None
            with suppress(OutputError):
                files = opened.enter_context(FormerFiles(self.output))
            for block, old in stay.items():
                former = None
                if files is not None:
                    with suppress(OutputError):
                        former = files.block(block, old, spec, names, self.compose.grid)
                yield former

    def companions(self) -> Drawn:
        """Writes provenance.tif and views.tif, and returns them."""
        compose, one = self.compose, self._block()
        whole = Companions(compose.grid, compose.bands, compose.dtype, len(compose.views))
        for block in _blocks(self._spec):
            kept = self.store.get("blocks", self._block_key(block))
            # none where the store was damaged
            whole.add(block.row0, block.col0, kept or one(block)[2])
        _write_companions(self.output, whole, self.alignment)
        return Drawn(
            provenance=whole.provenance,
            provenance_grid=whole.fine,
            views=whole.views,
            views_grid=whole.coarse,
            preview=coloured(whole.preview, whole.shown),
            preview_grid=whole.grid.coarser(whole.factor),
            preview_range=None
            if whole.preview.dtype == np.uint8
            else colour_range(whole.preview, whole.shown),
        )

    @property
    def _spec(self) -> RasterSpec:
        return mosaic_spec(self.compose, self.alignment, self.settings, self.unit)

    def _block_key(self, block: Block) -> str:
        return digest(self.key, block.row0, block.col0)

    def _block(self) -> Callable[[Block], tuple[NDArray[Any], NDArray[np.bool_], BlockExtras]]:
        """Draws a block: pixels (h, w, bands), where they show a photo (h, w), and what lies
        beside.
        """
        compose = self.compose
        keep, table = keeper(compose, self.alignment, self.boundary), shot_numbers(compose)

        def drawn(block: Block) -> tuple[NDArray[Any], NDArray[np.bool_], BlockExtras]:
            composed = compose(_window(block))
            valid = composed.photo >= 0
            if keep is not None:
                valid &= keep(block)
            pixels = _blanked(composed.pixels, valid)
            return pixels, valid, extras_of(composed, valid, table, compose.grid)

        return drawn


def _blocks(spec: RasterSpec) -> list[Block]:
    """All blocks of the map, finished or not."""
    return [
        Block(
            row0=row,
            col0=col,
            height=min(BLOCK, spec.height - row),
            width=min(BLOCK, spec.width - col),
            tile=spec.tile,
        )
        for row in range(0, spec.height, BLOCK)
        for col in range(0, spec.width, BLOCK)
    ]


def _stamp(path: Path) -> list[int]:
    """Size and time of a file: whether it is still the one that was written."""
    return [path.stat().st_size, path.stat().st_mtime_ns] if path.is_file() else []


def _blanked(pixels: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[Any]:
    if pixels.dtype.kind == "f":
        pixels[~valid] = np.nan
    return pixels


def _window(block: Block) -> Window:
    return Window(row=block.row0, column=block.col0, height=block.height, width=block.width)


def keeper(
    compose: Composer, alignment: Alignment, boundary: Path | None
) -> Callable[[Block], NDArray[np.bool_]] | None:
    """Tells of a block which of its pixels (h, w) lie inside a boundary; None without one."""
    if boundary is None or alignment.frame.crs is None:
        return None
    from skyquilt.raster.boundary import inside as inside_polygon
    from skyquilt.raster.boundary import read_boundary

    polygon = read_boundary(boundary, alignment.frame.crs)
    transform = geotransform(compose.grid, alignment)
    return lambda b: inside_polygon(
        polygon, transform, row0=b.row0, col0=b.col0, height=b.height, width=b.width
    )


def _write_companions(output: Path, whole: Companions, alignment: Alignment) -> None:
    top = int(whole.provenance.max(initial=0))
    for name, array, grid, kind in (
        (
            "provenance.tif",
            whole.provenance,
            whole.fine,
            "uint8" if top < 256 else "uint16" if top < 65536 else "uint32",
        ),
        (
            "views.tif",
            whole.views,
            whole.coarse,
            "uint8" if whole.views.max(initial=0) < 256 else "uint16",
        ),
    ):
        write_array(
            output / name,
            array.astype(kind, copy=False),
            RasterSpec(
                width=grid.width,
                height=grid.height,
                bands=1,
                dtype=kind,
                transform=geotransform(grid, alignment),
                crs=alignment.frame.crs,
                compress="deflate",
                nodata=0.0,
                overviews="mode" if name.startswith("p") else "max",
                tags={"SOFTWARE": "Skyquilt"},
            ),
        )


def write_surface(output: Path, ground: Ground, alignment: Alignment) -> None:
    """surface.tif: heights over the map's area, and what they count from in its tags."""
    grid = ground.grid
    factor = (
        max(1, int(ground.surface.cell / grid.gsd))
        if ground.surface.source != "plane"
        else max(grid.width, grid.height)
    )
    coarse = grid.coarser(factor)
    z = ground.surface.on(coarse.x(np.arange(coarse.width)), coarse.y(np.arange(coarse.height)))
    about = {"VERTICAL_DATUM": alignment.frame.vertical_datum, "SOURCE": ground.surface.source}
    spec = RasterSpec(
        width=coarse.width,
        height=coarse.height,
        bands=1,
        dtype="float32",
        transform=geotransform(coarse, alignment),
        crs=alignment.frame.crs,
        vertical=VERTICAL_EPSG.get(alignment.frame.vertical_datum),
        nodata=float("nan"),
        tags={"SOFTWARE": "Skyquilt"} | about,
        band_units=("m",) if alignment.frame.metric else (),
    )
    write_array(output / "surface.tif", z, spec)


def used_photos(views: Sequence[View]) -> list[int]:
    """Photos that are in the map, in the order of shots.geojson."""
    return sorted(v.photo for v in views)
