"""Exports of a finished run: any part of it, in the formats of other programs.

Each is computed block by block from the files of the run, so memory stays bounded.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from skyquilt.engine.folder import EXPORTS, changed, make_folder
from skyquilt.errors import SideFileError, UsageError
from skyquilt.outside import put_in_place, read_bounded, remove_file, remove_folder
from skyquilt.raster import CogWriter, RasterSpec
from skyquilt.raster.atomic import mended, write_text
from skyquilt.raster.geopackage import write_polygons
from skyquilt.raster.map_source import Bounds, FileSource, MapSource, between, picture, values
from skyquilt.raster.picture_files import PngRows, image_bytes
from skyquilt.runs.grid import ExportGrid, grid_of
from skyquilt.runs.kmz import write_kmz
from skyquilt.runs.layers import RunLayer, figures_of, layers_in, range_of, unit_of, vertical_of
from skyquilt.runs.web_tiles import web_tiles, write_mbtiles_file
from skyquilt.typed import typed

WHAT = ("png", "kmz", "mbtiles", "tiles", "tif", "heights", "footprints")
"""What can be exported."""
PLACED = ("kmz", "mbtiles", "tiles")
"""What only a georeferenced map has."""


@dataclass(frozen=True, kw_only=True)
class Export:
    """A file or folder that was written."""

    path: Path
    """Where."""
    note: str = ""
    """What a reader needs to know of it."""


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """What is to be exported."""

    what: tuple[str, ...]
    """Some of `WHAT`."""
    layer: str = "mosaic"
    """Which raster; `heights` and `footprints` do not depend on it."""
    bounds: Bounds | None = None
    """West, south, east, north in `crs`; None = all."""
    crs: str | None = None
    """Coordinate system of the files; None = that of the map. Web tiles and KMZ have their own."""
    gsd_m: float | None = None
    """Size of a pixel in m; None = that of the map."""

    def __post_init__(self) -> None:
        typed(self)
        unknown = [w for w in self.what if w not in WHAT]
        if unknown or not self.what:
            raise UsageError(
                f"cannot export {', '.join(unknown) or 'nothing'}; choose of {', '.join(WHAT)}"
            )
        if self.gsd_m is not None and not 1e-4 <= self.gsd_m <= 1e4:
            raise UsageError(f"--gsd {100 * self.gsd_m:g} lies outside 0.01 to 1000000 cm")
        if self.bounds is not None and not (
            all(map(math.isfinite, self.bounds))
            and self.bounds[0] < self.bounds[2]
            and self.bounds[1] < self.bounds[3]
        ):
            raise UsageError("--bounds is west,south,east,north, and has no area here")
        if self.crs is not None:
            from skyquilt.alignment.priors import horizontal_crs  # PROJ, only where it is needed

            horizontal_crs(self.crs)


def parse_what(text: str) -> tuple[str, ...]:
    """Names separated by commas, each once."""
    return tuple(dict.fromkeys(w.strip() for w in text.split(",") if w.strip()))


def export(folder: Path, wanted: Wanted, output: Path | None = None) -> Iterator[Export]:
    """Writes each export to `output` (default: the folder `export` of the run), and yields it.

    Raises:
        UsageError: the folder is no finished run, or has no such part. OutputError: the disk is
            full or read-only.
    """
    layers = layers_in(folder)
    if "mosaic" not in layers:
        raise UsageError(
            f"{folder} holds no finished run (mosaic.tif); name the folder given to -o"
        )
    if wanted.layer not in layers:
        raise UsageError(f"{folder} has no layer {wanted.layer!r}; it has {', '.join(layers)}")
    if "heights" in wanted.what and "heights" not in layers:
        raise UsageError(f"{folder} has no heights (dsm.tif or surface.tif)")
    placed = [w for w in wanted.what if w in PLACED]
    if placed and not FileSource(path=folder / "mosaic.tif").crs:
        raise UsageError(
            f"the map is not georeferenced, which {', '.join(placed)} must be; png and tif need not"
        )
    target = output or folder / EXPORTS
    make_folder(target)
    other, bent = changed(folder), _distortion(folder, wanted)
    for what in wanted.what:
        layer = layers["heights" if what == "heights" else wanted.layer]
        done = _one(what, folder, layer, wanted, target)
        source = "footprints.geojson" if what == "footprints" else layer.file
        doubt = f"{source} is not as the run wrote it" if source in other else ""
        told = (done.note, "" if what in PLACED else bent, doubt)
        yield replace(done, note="; ".join(n for n in told if n))


def _distortion(folder: Path, wanted: Wanted) -> str:
    """What the coordinate system asked for does to the map, see `priors.distortion`."""
    source = FileSource(path=folder / "mosaic.tif")
    about = source.about()
    if wanted.crs is None or not source.crs or about is None:
        return ""
    from skyquilt.alignment.priors import distortion  # PROJ, only where it is needed

    west, south, east, north = about.bounds
    middle = between(source.crs, "EPSG:4326").transform((west + east) / 2, (south + north) / 2)
    return distortion(wanted.crs, latitude=middle[1], longitude=middle[0])


def _one(what: str, folder: Path, layer: RunLayer, wanted: Wanted, target: Path) -> Export:
    if what == "footprints":
        return _footprints(folder, wanted, target)
    source = FileSource(path=folder / layer.file)
    grid = grid_of(source, wanted.bounds, wanted.crs, wanted.gsd_m)
    if what in ("tif", "heights"):
        path, figures = target / f"{layer.name}.tif", figures_of(folder)
        same = grid.crs == source.crs
        if not write_tif(source, layer, grid, path, vertical_of(layer, figures) if same else None):
            raise UsageError("the map has no content within --bounds")
        return Export(path=path, note=unit_of(layer, figures) if layer.measured else "")
    scale = range_of(layer, source)
    note = ""
    if scale is not None and layer.measured:
        unit = unit_of(layer, figures_of(folder))
        note = f"colours from {scale[0]:.4g} to {scale[1]:.4g} {unit}".rstrip()
    if what == "png":
        path = _png(source, layer, grid, scale, target)
    elif what == "kmz":
        path = target / f"{layer.name}.kmz"
        write_kmz(path, source, grid, scale, layer, folder.resolve().name)
    elif what == "mbtiles":
        path = target / f"{layer.name}.mbtiles"
        write_mbtiles_file(path, source, grid, scale, layer)
    else:
        path = _tiles(source, layer, grid, scale, target)
    return Export(path=path, note=note)


def _png(
    source: FileSource,
    layer: RunLayer,
    grid: ExportGrid,
    scale: tuple[float, float] | None,
    target: Path,
) -> Path:
    """A picture with a world file (pixel centre of the top left) and its coordinate system."""
    path = target / f"{layer.name}.png"
    with PngRows(path, grid.width, grid.height) as file:
        for row, height in grid.strips():
            strip = np.zeros((height, grid.width, 4), np.uint8)
            for column, width in grid.columns():
                box = grid.bounds(row, column, height, width)
                found = picture(source, grid.crs, box, width, height, scale, layer.palette)
                if found is not None:
                    strip[:, column : column + width] = found
            file.write(strip)
    numbers = (grid.step, 0, 0, -grid.step, grid.west + grid.step / 2, grid.north - grid.step / 2)
    write_text(path.with_suffix(".pgw"), "".join(f"{v:.12g}\n" for v in numbers))
    if grid.crs:
        from pyproj import CRS

        write_text(path.with_suffix(".prj"), CRS(grid.crs).to_wkt("WKT1_ESRI"))
        srs = escape(CRS(grid.crs).to_wkt("WKT1_GDAL"))  # where GDAL and QGIS look for it
        about = f"<PAMDataset><SRS>{srs}</SRS></PAMDataset>\n"
        write_text(path.with_name(path.name + ".aux.xml"), about)
    return path


def write_tif(
    source: MapSource, layer: RunLayer, grid: ExportGrid, path: Path, vertical: int | None = None
) -> bool:
    """A Cloud Optimized GeoTIFF of the values themselves; False, and no file, where the map has
    none. `vertical`: EPSG code of the zero of heights.
    """
    about = source.about()
    if about is None:
        return False
    real = about.dtype.startswith("float")
    colours = about.dtype == "uint8" and not layer.measured
    spec = RasterSpec(
        width=grid.width,
        height=grid.height,
        bands=about.bands,
        dtype=about.dtype,
        transform=(grid.step, 0, grid.west, 0, -grid.step, grid.north),
        crs=grid.crs or None,
        vertical=vertical,
        nodata=float("nan") if real else None,
        compress="jpeg" if colours else "deflate",
        mask=not real,
        overviews="average" if real or colours else "nearest",
        tags=about.tags,
        band_names=about.names,
        band_units=about.units,
    )
    some = False
    with CogWriter(path, spec) as writer:
        for block in writer.blocks():
            box = grid.bounds(block.row0, block.col0, block.height, block.width)
            found = values(source, grid.crs, box, block.width, block.height)
            if found is None or not found[1].any():
                writer.finish_block(block)
                continue
            pixels, shown = found
            some = True
            if real:
                pixels = np.where(shown[..., None], pixels, np.float32(np.nan))
            writer.write_block(block, np.ascontiguousarray(pixels), None if real else shown)
    if not some:
        remove_file(path)
    return some


def _tiles(
    source: FileSource,
    layer: RunLayer,
    grid: ExportGrid,
    scale: tuple[float, float] | None,
    target: Path,
) -> Path:
    """A folder z/x/y.webp as web maps address tiles, and its description (TileJSON)."""
    folder = target / f"{layer.name}-tiles"
    partial = target / f"{layer.name}-tiles.partial"
    with mended(folder):
        remove_folder(partial)
        partial.mkdir()
        tiles = web_tiles(source, grid, scale, layer)
        for z, x, y, rgba in tiles:
            place = partial / str(z) / str(x)
            place.mkdir(parents=True, exist_ok=True)
            (place / f"{y}.webp").write_bytes(image_bytes(rgba, "image/webp"))
        about = {
            "tilejson": "3.0.0",
            "name": layer.title,
            "scheme": "xyz",
            "tiles": ["{z}/{x}/{y}.webp"],
            "minzoom": tiles.zooms[0],
            "maxzoom": tiles.zooms[1],
            "bounds": list(tiles.degrees),
        }
        (partial / "tiles.json").write_text(json.dumps(about, indent=1), "utf-8")
        remove_folder(folder)
        put_in_place(partial, folder)
    return folder


def _footprints(folder: Path, wanted: Wanted, target: Path) -> Export:
    """A GeoPackage of the ground that each photo shows."""
    source = FileSource(path=folder / "mosaic.tif")
    crs, box = wanted.crs or source.crs, wanted.bounds
    rings: list[tuple[np.ndarray, str]] = []
    try:
        features = json.loads(read_bounded(folder / "footprints.geojson"))["features"]
        for feature in features:
            ring = np.array(feature["geometry"]["coordinates"][0], float)[:, :2]
            if source.crs:  # GeoJSON is in degrees
                ring = np.column_stack(between("EPSG:4326", crs).transform(ring[:, 0], ring[:, 1]))
            low, high = ring.min(0), ring.max(0)
            if box is None or (
                low[0] < box[2] and high[0] > box[0] and low[1] < box[3] and high[1] > box[1]
            ):
                rings.append((ring, str(feature["properties"]["filename"])))
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise SideFileError(
            f"{folder / 'footprints.geojson'} cannot be read ({error}); make the map again"
        ) from error
    path = target / "footprints.gpkg"
    return Export(
        path=path, note=f"{write_polygons(path, 'footprints', rings, crs=crs or None)} photos"
    )
