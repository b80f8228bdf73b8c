"""bands.tif: all bands on the map's grid, and a raster for each index of vegetation.

In every band each place is shown from the same capture, that of the map, so that a quotient of
bands compares pixels that were exposed together. Where a band's frame does not reach so far, or is
saturated, it takes the capture that shows the place from most above.
"""

from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.band_rig import BandRig
from skyquilt.engine.clock import Steps
from skyquilt.engine.folder import STATE
from skyquilt.engine.pixel_cache import PixelCache
from skyquilt.engine.workers import Workers
from skyquilt.imaging.nodes import STEP, View
from skyquilt.imaging.views import make_views, native_gsd
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, no_ties
from skyquilt.model.raster import Window
from skyquilt.multispectral.captures import BandFiles
from skyquilt.multispectral.indices import Index
from skyquilt.ortho.blend import Blend
from skyquilt.ortho.companions import geotransform
from skyquilt.ortho.compose import Composer
from skyquilt.ortho.ground import Ground
from skyquilt.ortho.labels import Labels
from skyquilt.ortho.orthomosaic import keeper
from skyquilt.raster import Block, CogWriter, RasterSpec
from skyquilt.workflows.photo_features import pixels_again
from skyquilt.workflows.second_camera import pose_beside

BANDS_FILE = "bands.tif"
_LARGER = 1.5
"""Pixels of a file along one of the map from which values are means of several."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedBand:
    """A band whose files are placed."""

    files: BandFiles
    """Its files."""
    of_photo: dict[int, int]
    """Index of the map's photo -> index of the file of the same capture."""
    rigs: dict[int, BandRig] = field(default_factory=dict)
    """Its camera beside that of the map's photo, by the latter's index: one for all, unless files
    are of several cameras; empty where the map's photos are its files."""
    velocities: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    """Velocity (3,) of the map's camera in m/s in the map frame, by the same index."""
    saturated: float = 0.0
    """Share of saturated pixels in its files."""
    detail: float | None = None
    """Fine detail of its files over that of the middle one of all bands; None: not known."""

    def without(self, names: Container[str]) -> "PlacedBand":
        """The band without files that cannot be read."""
        kept = {i: j for i, j in self.of_photo.items() if self.files.photos[j].name not in names}
        return replace(self, of_photo=kept)


def aligned_band(band: PlacedBand, placed: Alignment) -> Alignment:
    """The poses of a band's files, by the indices of the map's photos."""
    of_photo = [i for i in band.of_photo if i in placed.poses]
    if not band.rigs:
        return replace(placed, poses={i: placed.poses[i] for i in of_photo})
    poses = {i: pose_beside(placed.poses[i], band.rigs[i], band.velocities[i]) for i in of_photo}
    # by both cameras: a lens takes up what that of the map's photo leaves out
    name = {id(rig): f"{band.files.name} {n}" for n, rig in enumerate(band.rigs.values())}
    camera_of = {i: name[id(band.rigs[i])] for i in poses}
    return Alignment(
        method="rig",
        why="its camera is beside that of the map's photos",
        frame=placed.frame,
        poses=poses,
        cameras={camera_of[i]: band.rigs[i].camera for i in poses},
        camera_of=camera_of,
        blocks=(tuple(poses),),
        ties=no_ties(),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class BandsDrawing:
    """The rasters of bands and indices while they are drawn; a killed run goes on at its block."""

    output: Path
    """Folder of the files."""
    bands: Sequence[PlacedBand]
    """The bands, in the order of the file."""
    indices: Sequence[Index]
    """The indices that are drawn, too."""
    ground: Ground
    """Heights, grid and what the map's photos may show."""
    placed: Alignment
    """The map's poses."""
    labels: Labels | None
    """The capture shown at each place."""
    blend: Blend
    """How photos are joined."""
    boundary: Path | None
    """Polygon outside which the map is empty."""
    pixels_bytes: int
    """Bytes of decoded photos that may be kept."""
    key: str
    """What the rasters depend on."""
    tags: dict[str, str]
    """Metadata of the files."""
    version: ClassVar[int] = 3

    def blocks(self, workers: Workers) -> Steps[None]:
        """Writes the rasters.

        Raises:
            PhotoFailedError: a file cannot be read any more. OutputError: the disk is full.
        """
        one = self._block()
        with ExitStack() as stack:
            main = stack.enter_context(self._writer(BANDS_FILE, self._spec(None)))
            others = [
                stack.enter_context(self._writer(f"{i.name}.tif", self._spec(i)))
                for i in self.indices
            ]
            left = [{_corner(b) for b in writer.blocks()} for writer in (main, *others)]
            todo = [b for b in _all(main, others) if any(_corner(b) in some for some in left)]
            drawn = self._few_at_a_time(one, todo, workers)
            for done, (block, pixels) in enumerate(zip(todo, drawn, strict=True)):
                for writer, some, values in zip((main, *others), left, pixels, strict=True):
                    if _corner(block) in some:
                        writer.write_block(block, values, np.asarray(np.isfinite(values).any(2)))
                yield done + 1, len(todo)

    def _few_at_a_time(
        self,
        one: Callable[[Block], list[NDArray[np.float32]]],
        todo: Sequence[Block],
        workers: Workers,
    ) -> Iterator[list[NDArray[np.float32]]]:
        """The blocks of all rasters, of which no more are in memory than half of what photos may
        take: workers keep several each, and all bands of a block are many times one of a picture.
        """
        values = len(self.bands) + len(self.indices)
        largest = max((b.height * b.width * values * 4 for b in todo), default=1)
        number = max(1, self.pixels_bytes // 2 // largest)
        for k in range(0, len(todo), number):
            yield from workers.each(one, todo[k : k + number])

    def _writer(self, name: str, spec: RasterSpec) -> CogWriter:
        spool = self.output / STATE / f"{name}.spool"
        return CogWriter(self.output / name, spec, spool=spool, digest=self.key)

    def _spec(self, index: Index | None) -> RasterSpec:
        grid, files = self.ground.grid, [b.files for b in self.bands]
        units = tuple(f.photos[0].unit for f in files)
        return RasterSpec(
            width=grid.width,
            height=grid.height,
            bands=1 if index else len(files),
            dtype="float32",
            transform=geotransform(grid, self.placed),
            crs=self.placed.frame.crs,
            compress="deflate",
            nodata=float("nan"),
            band_names=(index.title,) if index else tuple(f.name for f in files),
            band_units=() if index or not any(units) else units,
            tags={"SOFTWARE": "Skyquilt", **self.tags},
        )

    def _block(self) -> Callable[[Block], list[NDArray[np.float32]]]:
        composers = [self._composer(b) for b in self.bands]
        keep = keeper(composers[0], self.placed, self.boundary)
        names = [b.files.name for b in self.bands]

        def drawn(block: Block) -> list[NDArray[np.float32]]:
            window = Window(
                row=block.row0, column=block.col0, height=block.height, width=block.width
            )
            values = np.concatenate([_whole(c, window) for c in composers], axis=2)
            if keep is not None:
                values[~keep(block)] = np.nan
            band = dict(zip(names, np.moveaxis(values, 2, 0), strict=True))
            return [values, *(i(band[i.a], band[i.b])[..., None] for i in self.indices)]

        return drawn

    def _composer(self, band: PlacedBand) -> Composer:
        photos, of_photo, converts = band.files.photos, band.of_photo, band.files.converts
        views = self._views(band)
        size = self.ground.grid.gsd / native_gsd(views, self.ground.surface) if views else 1.0

        def read(i: int) -> NDArray[Any]:
            values = _pixels(photos[of_photo[i]])
            if not photos[of_photo[i]].unit:
                values = converts[of_photo[i]](values)
            return averaged(values, size)

        share = self.pixels_bytes // 2 // len(self.bands)
        return Composer(
            grid=self.ground.grid,
            views=views,
            surface=self.ground.surface,
            blend=self.blend,
            pixels=PixelCache(read=read, budget_bytes=share),
            bands=1,
            dtype=np.dtype(np.float32),
            labels=self.labels,
            detailed=True,
        )

    def _views(self, band: PlacedBand) -> list[View]:
        if not band.rigs:
            return [v for v in self.ground.views if v.photo in band.of_photo]
        limits = replace(self.ground.limits, blanks={}, marks={})
        return make_views(aligned_band(band, self.placed), self.ground.surface, limits)


def _whole(compose: Composer, window: Window) -> NDArray[np.float32]:
    """A window (h, w, 1) of a band, with what the capture of the map does not show, or shows
    saturated, from others.
    """
    composed = compose(window)
    values = np.asarray(composed.pixels, np.float32)
    # beyond the cells that any photo covers there is nothing to be had
    covered = np.repeat(np.repeat(composed.views > 0, STEP, 0), STEP, 1)
    empty = np.isnan(values[..., 0])
    empty &= covered[: empty.shape[0], : empty.shape[1]]
    if compose.labels is not None and empty.any():
        part = _around(empty)
        more = replace(compose, labels=None)(
            Window(
                row=window.row + part[0].start,
                column=window.column + part[1].start,
                height=part[0].stop - part[0].start,
                width=part[1].stop - part[1].start,
            )
        )
        values[part][empty[part]] = more.pixels[empty[part]]
    return values


def _around(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns around what is true, by whole cells."""
    first_last = [np.flatnonzero(mask.any(axis))[[0, -1]] for axis in (1, 0)]
    rows, columns = (
        slice(int(a) // STEP * STEP, min(int(b) // STEP * STEP + STEP, n))
        for (a, b), n in zip(first_last, mask.shape, strict=True)
    )
    return rows, columns


def averaged(values: NDArray[Any], size: float) -> NDArray[Any]:
    """Values (h, w) as means over about so many px across, where a pixel of the map is larger than
    one of the file: a panchromatic band beside others, or a map that is asked for coarser than
    photos. A mean of measurements; NaN where most of them are none.
    """
    if size < _LARGER:
        return values
    sigma = float(np.sqrt((size**2 - 1) / 12))  # what a square of so many px adds to one
    known = np.isfinite(values)
    mean = cv2.GaussianBlur(np.where(known, values, 0).astype(np.float32), (0, 0), sigma)
    share = cv2.GaussianBlur(known.astype(np.float32), (0, 0), sigma)
    return np.where(share > 0.5, mean / np.maximum(share, 0.5), np.float32(np.nan))


def _corner(block: Block) -> tuple[int, int]:
    return block.row0, block.col0


def _all(main: CogWriter, others: Sequence[CogWriter]) -> Iterator[Block]:
    """The blocks that any of the writers lacks, each once; all have the same blocks."""
    seen: set[tuple[int, int]] = set()
    for writer in (main, *others):
        for block in writer.blocks():
            if _corner(block) not in seen:
                seen.add(_corner(block))
                yield block


def _pixels(photo: Photo) -> NDArray[Any]:
    """Values (h, w) of a file of one band.

    Raises:
        PhotoFailedError: it cannot be read any more.
    """
    pixels = pixels_again(photo)
    return np.asarray(pixels[..., 0] if pixels.ndim == 3 else pixels)
