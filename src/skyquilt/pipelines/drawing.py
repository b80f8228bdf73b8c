"""The map drawn: surface, exposure, and the rasters, block by block in bounded memory."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.config import Methods, MosaicSettings
from skyquilt.errors import SideFileError, UsageError
from skyquilt.imaging.grey import averaged
from skyquilt.imaging.views import STEP, View, grid_of, make_views, native_gsd
from skyquilt.model.poses import Alignment
from skyquilt.model.raster import Grid, Window
from skyquilt.model.surface import Surface
from skyquilt.pipelines.intake import Intake, Pictures, picture_recipe
from skyquilt.pipelines.radiometry import drift_of, value_tags
from skyquilt.raster import Block, CogWriter, RasterSpec, write_array
from skyquilt.raster.spec import Compression
from skyquilt.render.compose import Composed, Composer, PhotoPixels
from skyquilt.render.exposure import NEUTRAL, Exposure
from skyquilt.run.clock import Steps
from skyquilt.run.executor import in_order
from skyquilt.run.folder import STATE
from skyquilt.run.store import Store, digest
from skyquilt.surface.plane import level

FINEST = 20
"""Map pixels per photo pixel, along a side, that may be asked for."""
MOST_PIXELS = 4e11
"""Largest map."""
WIDEST_M = 200_000.0
"""Widest map: no drone flies further."""
BLOCK = 2048
"""Side in px of the pieces that the map is drawn in."""
SPOOL = "mosaic.spool"
"""Where the map's tiles wait, below the run's state."""
PROVENANCE = 4
"""Map pixels per provenance pixel."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """What the map is drawn on."""

    surface: Surface
    """Heights."""
    views: tuple[View, ...]
    """What each photo sees."""
    grid: Grid
    """The map's pixels."""
    native_gsd: float
    """Median ground size of a photo pixel in m."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockExtras:
    """What a block of the map leaves beside its pixels."""

    provenance: NDArray[np.uint32]
    """Shot numbers from 1, 0 = none, every PROVENANCE-th pixel."""
    views: NDArray[np.uint16]
    """Photos that see each STEP-pixel cell."""
    preview: NDArray[Any]
    """(h, w, bands) the block, area-averaged to every `preview_factor`-th pixel."""
    shown: NDArray[np.uint8]
    """(h, w) opacity of the preview, 0 to 255."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """The finished rasters' small companions."""

    provenance: NDArray[np.uint32]
    """As in provenance.tif."""
    provenance_grid: Grid
    """Its grid."""
    views: NDArray[np.uint16]
    """As in views.tif."""
    views_grid: Grid
    """Its grid."""
    preview: NDArray[np.uint8]
    """(h, w, 4) the map, reduced, RGBA."""
    preview_grid: Grid
    """Its grid."""


def survey_ground(
    alignment: Alignment,
    pictures: Pictures,
    methods: Methods,
    settings: MosaicSettings,
    store: Store,
) -> Steps[Ground]:
    """Heights from the tie points (level ground where there are none), and the grid of the map.

    Raises:
        UsageError: the map would have no pixels, or absurdly many.
    """
    yield 0, 1
    z = float(np.median(alignment.ties.xyz[:, 2])) if len(alignment.ties.xyz) else 0.0
    rough = make_views(alignment, level(z))
    if not rough:
        raise UsageError("no photo looks down at the ground: all see the horizon")
    native = native_gsd(rough, level(z))
    gsd = settings.gsd_cm / 100 if settings.gsd_cm else round_gsd(native)
    bounds = _local_bounds(settings, alignment)
    _check_place(bounds, rough, settings, alignment)
    wide = grid_of(rough, gsd, bounds)
    _check_size(wide, native)
    margin = 0.05 * max(wide.width, wide.height) * gsd
    w, s, e, n = wide.bounds
    area = (w - margin, s - margin, e + margin, n + margin)
    key = digest(alignment.ties.xyz, area, methods.surface)
    surface = store.get_or(
        "surface",
        key,
        lambda: (
            methods.surface(alignment.ties.xyz, area) if len(alignment.ties.xyz) > 3 else level(z)
        ),
    )
    views = tuple(make_views(alignment, surface))
    grid = grid_of(views, gsd, bounds)
    if methods.sweep is not None and len(alignment.ties.xyz) > 3:
        sweep, known, held = methods.sweep, surface, set(alignment.held)
        seen = sorted(held), picture_recipe()
        surface = store.get_or(
            "surface",
            digest(key, poses_digest(alignment), grid, sweep, seen),
            lambda: sweep(known, [v for v in views if v.photo in held], grid, pictures),
        )
    yield 1, 1
    return Ground(surface=surface, views=views, grid=grid, native_gsd=native)


def _check_place(
    bounds: tuple[float, float, float, float] | None,
    views: Sequence[View],
    settings: MosaicSettings,
    alignment: Alignment,
) -> None:
    """Refuses an area that no photo shows."""
    if bounds is None or any(v.overlaps(bounds) for v in views):
        return
    outline = np.concatenate([v.footprint for v in views]) + alignment.frame.origin
    (west, south), (east, north) = outline.min(0), outline.max(0)
    frame = alignment.frame.crs or "their own frame"
    where = f"which cover {west:.0f},{south:.0f},{east:.0f},{north:.0f} in {frame}"
    if settings.bounds is not None:
        asked = ",".join(f"{b:g}" for b in settings.bounds)
        raise UsageError(f"--bounds {asked} lies outside the photos, {where}")
    raise SideFileError(
        f"the area of --boundary {settings.boundary} lies outside the photos, {where}"
    )


def _check_size(grid: Grid, native: float) -> None:
    """Refuses what nobody can want: a map far finer than the photos, or larger than any survey."""
    size = f"{grid.width} x {grid.height} px"
    wide = max(grid.width, grid.height) * grid.gsd
    if grid.gsd < native / FINEST and wide < WIDEST_M:
        raise UsageError(
            f"--gsd {grid.gsd * 100:g} asks for {size}, more than {FINEST} times finer than the"
            " photos,"
            f" which show {native * 100:.2g} cm per pixel; leave --gsd out or choose one near that"
        )
    if wide > WIDEST_M or grid.width * grid.height > MOST_PIXELS:
        raise UsageError(
            f"the map would be {wide / 1000:.0f} km wide, {size} at {grid.gsd * 100:g} cm: the"
            " positions of"
            " some photos (or --bounds) must be wrong; correct them with --geo, or choose a larger"
            " --gsd"
        )


def poses_digest(alignment: Alignment) -> str:
    """What of an alignment shapes the map."""
    order = sorted(alignment.poses)
    placed = [(alignment.poses[i], alignment.camera(i).vector) for i in order]
    return digest(order, placed, alignment.frame)


def round_gsd(gsd: float) -> float:
    """A ground resolution in m rounded to two digits."""
    digits = 1 - int(np.floor(np.log10(gsd)))
    return float(round(gsd, digits))


def _local_bounds(
    settings: MosaicSettings, alignment: Alignment
) -> tuple[float, float, float, float] | None:
    """Bounds asked for, or those of the boundary, in the map frame."""
    frame = alignment.frame
    bounds = settings.bounds
    if settings.boundary is not None and bounds is None:
        if frame.crs is None:
            raise UsageError(
                "--boundary needs a georeferenced survey, and these photos have no positions"
            )
        from skyquilt.raster.boundary import read_boundary

        bounds = read_boundary(settings.boundary, frame.crs).bounds
    if bounds is None:
        return None
    x, y = frame.origin
    return bounds[0] - x, bounds[1] - y, bounds[2] - x, bounds[3] - y


def balance(
    intake: Intake, ground: Ground, alignment: Alignment, methods: Methods, settings: MosaicSettings
) -> Exposure:
    """Exposure of the placed photos: of 8-bit pictures, or the drift of measured values."""
    if unit_of(intake):
        frames = {v.photo: intake.looked[v.photo].thumbnail for v in ground.views}
        return drift_of(
            ground.views,
            frames,
            ground.surface,
            ground.grid.bounds,
            unit_of(intake),
            methods,
            settings,
        )
    if not settings.balance or intake.photos[0].dtype != "uint8":
        return NEUTRAL
    thumbnails = {v.photo: _three(intake.looked[v.photo].thumbnail) for v in ground.views}
    return methods.balance(ground.views, thumbnails, ground.surface, ground.grid.bounds)


def _three(thumbnail: NDArray[Any]) -> NDArray[Any]:
    return thumbnail[..., None] if thumbnail.ndim == 2 else thumbnail


def composer(
    intake: Intake,
    ground: Ground,
    alignment: Alignment,
    exposure: Exposure,
    methods: Methods,
    pixels: PhotoPixels,
) -> Composer:
    """The composer of the survey's map."""
    first = intake.photos[ground.views[0].photo]
    return Composer(
        grid=ground.grid,
        views=ground.views,
        surface=ground.surface,
        blend=methods.blend,
        pixels=pixels,
        bands=first.channels,
        dtype=np.dtype(first.dtype),
        exposure=exposure,
    )


def geotransform(
    grid: Grid, alignment: Alignment
) -> tuple[float, float, float, float, float, float]:
    """The six numbers of a north-up raster in the output CRS."""
    x, y = alignment.frame.origin
    return grid.gsd, 0.0, grid.west + x, 0.0, -grid.gsd, grid.north + y


def mosaic_spec(
    compose: Composer, alignment: Alignment, settings: MosaicSettings, unit: str
) -> RasterSpec:
    """How mosaic.tif is written."""
    picture = compose.dtype == np.uint8
    compress = cast(Compression, settings.compress)
    if settings.compress == "auto":
        compress = "jpeg" if picture and compose.bands in (1, 3) else "zstd"
    if compress == "jpeg" and not (picture and compose.bands in (1, 3)):
        raise UsageError(
            f"--compress jpeg is for 8-bit pictures; these photos are {compose.dtype},"
            f" {compose.bands} bands"
        )
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


def draw(
    output: Path,
    compose: Composer,
    alignment: Alignment,
    settings: MosaicSettings,
    store: Store,
    key: str,
    unit: str,
    jobs: int,
) -> Steps[Drawn]:
    """Writes mosaic.tif, provenance.tif and views.tif; a killed run goes on at the block where it
    stopped.
    """
    whole = _Companions(compose.grid, compose.bands, compose.dtype)
    spec = mosaic_spec(compose, alignment, settings, unit)
    path, spool = output / "mosaic.tif", output / STATE / SPOOL
    keep, table = _keeper(compose, alignment, settings), _shot_numbers(compose)

    def one(block: Block) -> tuple[Block, NDArray[Any], NDArray[np.bool_], BlockExtras]:
        composed = compose(_window(block))
        valid = composed.photo >= 0
        if keep is not None:
            valid &= keep(block)
        return (
            block,
            _blanked(composed.pixels, valid),
            valid,
            _extras(composed, valid, table, whole.factor),
        )

    if store.get("blocks", digest(key, "file")) != _stamp(path):
        with CogWriter(path, spec, spool=spool, digest=key) as writer:
            todo, total = list(writer.blocks()), len(_blocks(spec))
            for done, (block, pixels, valid, extras) in enumerate(in_order(one, todo, jobs=jobs)):
                store.put("blocks", digest(key, block.row0, block.col0), extras)
                writer.write_block(block, pixels, valid)
                yield total - len(todo) + done + 1, total
        store.put("blocks", digest(key, "file"), _stamp(path))
    for block in _blocks(spec):
        kept = store.get("blocks", digest(key, block.row0, block.col0))
        whole.add(block.row0, block.col0, kept or one(block)[3])  # none where the store was damaged
    _write_companions(output, whole, alignment)
    return Drawn(
        provenance=whole.provenance,
        provenance_grid=whole.fine,
        views=whole.views,
        views_grid=whole.coarse,
        preview=coloured(whole.preview, whole.shown),
        preview_grid=whole.grid.coarser(whole.factor),
    )


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


def _shot_numbers(compose: Composer) -> NDArray[np.uint32]:
    """Number in shots.geojson of each photo; the last entry, which index -1 (no photo) finds,
    is 0.
    """
    number = {v.photo: k + 1 for k, v in enumerate(sorted(compose.views, key=lambda v: v.photo))}
    table = np.zeros(max(number) + 2, np.uint32)
    table[list(number)] = list(number.values())
    return table


def _extras(
    composed: Composed, valid: NDArray[np.bool_], table: NDArray[np.uint32], factor: int
) -> BlockExtras:
    preview, shown = _reduced(composed.pixels, valid, factor)
    numbers = table[np.where(_thinned(valid), _thinned(composed.photo), -1)]
    return BlockExtras(provenance=numbers, views=composed.views, preview=preview, shown=shown)


def _thinned(numbers: NDArray[Any]) -> NDArray[Any]:
    """Every PROVENANCE-th pixel in both directions, from the middle of its cell."""
    rows, columns = (
        np.minimum(np.arange(PROVENANCE // 2, size + PROVENANCE // 2, PROVENANCE), size - 1)
        for size in numbers.shape
    )
    return np.asarray(numbers[rows][:, columns])


def _blanked(pixels: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[Any]:
    if pixels.dtype.kind == "f":
        pixels[~valid] = np.nan
    return pixels


def _window(block: Block) -> Window:
    return Window(row=block.row0, column=block.col0, height=block.height, width=block.width)


def _keeper(
    compose: Composer, alignment: Alignment, settings: MosaicSettings
) -> Callable[[Block], NDArray[np.bool_]] | None:
    if settings.boundary is None or alignment.frame.crs is None:
        return None
    from skyquilt.raster.boundary import inside as inside_polygon
    from skyquilt.raster.boundary import read_boundary

    polygon = read_boundary(settings.boundary, alignment.frame.crs)
    transform = geotransform(compose.grid, alignment)
    return lambda b: inside_polygon(
        polygon, transform, row0=b.row0, col0=b.col0, height=b.height, width=b.width
    )


def preview_factor(grid: Grid) -> int:
    """Map pixels per preview pixel: a power of two that brings the longest side to 1600 px or
    less.
    """
    factor = 1
    while max(grid.width, grid.height) / factor > 1600 and factor < 2048:
        factor *= 2
    return factor


def _reduced(
    pixels: NDArray[Any], valid: NDArray[np.bool_], factor: int
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Area averages of the valid pixels (h, w, bands), and how much of each cell is valid (0 to
    255).
    """
    opaque = valid.view(np.uint8) * np.uint8(255)
    size = (-(-pixels.shape[1] // factor), -(-pixels.shape[0] // factor))
    share = np.asarray(averaged(opaque, size), np.uint8)
    solid = np.nan_to_num(pixels) if pixels.dtype.kind == "f" else pixels
    mean = averaged(solid, size).reshape(*share.shape, -1)
    if share.min() < 255:  # pixels that are not valid are zero: divide by what was
        whole = mean.astype(np.float32) * (255.0 / np.maximum(share, 1))[..., None]
        mean = (np.minimum(whole, 255) if pixels.dtype == np.uint8 else whole).astype(pixels.dtype)
    return mean, share


def coloured(preview: NDArray[Any], shown: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """RGBA (h, w, 4) of a preview: pictures as they are, measured values from dark to bright
    (inferno).
    """
    if preview.dtype == np.uint8 and preview.shape[2] == 3:
        return np.dstack([preview, shown])
    value = preview[..., 0].astype(np.float32)
    seen = value[shown > 127]
    low, high = np.percentile(seen, [1, 99]) if seen.size else (0.0, 1.0)
    index = np.clip((value - low) / max(float(high - low), 1e-6) * 255, 0, 255).astype(np.uint8)
    if preview.dtype == np.uint8:
        return np.dstack([preview[..., :1]] * 3 + [shown])
    return np.dstack([cv2.applyColorMap(index, cv2.COLORMAP_INFERNO)[..., ::-1], shown])


class _Companions:
    """Provenance, views and preview, assembled from blocks."""

    def __init__(self, grid: Grid, bands: int, dtype: np.dtype) -> None:
        self.grid, self.factor = grid, preview_factor(grid)
        self.fine, self.coarse, small = (
            grid.coarser(PROVENANCE),
            grid.coarser(STEP),
            grid.coarser(self.factor),
        )
        self.provenance = np.zeros((self.fine.height, self.fine.width), np.uint32)
        self.views = np.zeros((self.coarse.height, self.coarse.width), np.uint16)
        self.preview = np.zeros((small.height, small.width, bands), dtype)
        self.shown = np.zeros((small.height, small.width), np.uint8)

    def add(self, row: int, column: int, extras: BlockExtras) -> None:
        for target, part, step in (
            (self.provenance, extras.provenance, PROVENANCE),
            (self.views, extras.views, STEP),
            (self.preview, extras.preview, self.factor),
            (self.shown, extras.shown, self.factor),
        ):
            r, c = row // step, column // step
            target[r : r + part.shape[0], c : c + part.shape[1]] = part


def _write_companions(output: Path, whole: _Companions, alignment: Alignment) -> None:
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
            array.astype(kind),
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
    x, y = np.meshgrid(coarse.x(np.arange(coarse.width)), coarse.y(np.arange(coarse.height)))
    about = {"VERTICAL_DATUM": alignment.frame.vertical_datum, "SOURCE": ground.surface.source}
    spec = RasterSpec(
        width=coarse.width,
        height=coarse.height,
        bands=1,
        dtype="float32",
        transform=geotransform(coarse, alignment),
        crs=alignment.frame.crs,
        compress="zstd",
        nodata=float("nan"),
        tags={"SOFTWARE": "Skyquilt"} | about,
    )
    write_array(output / "surface.tif", ground.surface.at(x, y).astype(np.float32), spec)


def used_photos(views: Sequence[View]) -> list[int]:
    """Photos that are in the map, in the order of shots.geojson."""
    return sorted(v.photo for v in views)


def unit_of(intake: Intake) -> str:
    """Unit of the map's values; empty for pictures."""
    return intake.photos[0].unit


def single_kind(intake: Intake) -> Intake:
    """The photos whose pixels are of the most frequent kind: a map has one type of pixel."""
    kinds = [(p.channels, p.dtype, p.band) for p in intake.photos]
    common = max(set(kinds), key=lambda k: (kinds.count(k), k))
    keep = [i for i, k in enumerate(kinds) if k == common]
    from skyquilt.model.photo import RejectedPhoto

    odd = tuple(
        RejectedPhoto(
            name=p.name,
            reason=f"its pixels ({p.channels} x {p.dtype}, {p.band}) differ from the survey's"
            f" ({common[0]} x {common[1]}, {common[2]})",
        )
        for i, p in enumerate(intake.photos)
        if i not in keep
    )
    return replace(
        intake,
        photos=tuple(intake.photos[i] for i in keep),
        looked=tuple(intake.looked[i] for i in keep),
        rejected=(*intake.rejected, *odd),
    )
