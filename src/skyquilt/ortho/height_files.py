"""Files of heights: the surface and all that stands on it, its relief, bare ground, contours."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.heights import VERTICAL_EPSG
from skyquilt.model.poses import Alignment
from skyquilt.model.raster import Grid
from skyquilt.model.surface import STRIP
from skyquilt.ortho.bare_ground import bare_ground
from skyquilt.ortho.companions import Drawn, geotransform
from skyquilt.ortho.ground import Ground
from skyquilt.raster import RasterSpec, write_array
from skyquilt.settings import OutputSettings

Float = NDArray[np.float32]
AZIMUTH_DEG, ELEVATION_DEG = 315.0, 45.0
"""Direction of the light in hillshade.tif."""
CONTOUR_CELL_M = 0.5
"""Least side in m of the cells that contours are drawn from."""


def write_heights(
    output: Path, ground: Ground, drawn: Drawn, alignment: Alignment, settings: OutputSettings
) -> None:
    """dsm.tif and hillshade.tif where the map shows photos; dtm.tif and contours.gpkg on request.

    Contours are those of the bare ground.

    Raises:
        OutputError: a file cannot be written.
    """
    cells = _cells(ground)
    z = ground.surface.on(cells.x(np.arange(cells.width)), cells.y(np.arange(cells.height)))
    known = _shown(drawn, cells)
    datum = {"VERTICAL_DATUM": alignment.frame.vertical_datum, "SOURCE": ground.surface.source}
    shade = hillshade(z, cells.gsd)
    shade[~known] = 0
    _write(output / "hillshade.tif", shade, cells, alignment, {})
    wanted = settings.dtm or settings.contours_m is not None
    bare = bare_ground(z, known, cells.gsd) if wanted else z
    for heights in (z, bare):
        heights[~known] = np.nan
    _write(output / "dsm.tif", z, cells, alignment, datum)
    if settings.dtm:
        filter_ = {"FILTER": "simple morphological filter (Pingel et al. 2013)"}
        _write(output / "dtm.tif", bare, cells, alignment, datum | filter_)
    if settings.contours_m is not None:
        _contours(output / "contours.gpkg", bare, cells, alignment, settings.contours_m)


def hillshade(z: Float, cell: float) -> NDArray[np.uint8]:
    """Brightness (h, w), 1 to 255, of heights under light from the north-west (Horn 1981)."""
    out = np.empty(z.shape, np.uint8)
    for row in range(0, len(z), STRIP):
        above = min(row, 1)  # slopes need the row above and the row below
        part = _shaded(z[row - above : row + STRIP + 1], cell)
        out[row : row + STRIP] = part[above : above + STRIP]
    return out


def _shaded(z: Float, cell: float) -> NDArray[np.uint8]:
    down = cv2.Sobel(z, cv2.CV_32F, 0, 1, scale=1 / (8 * cell))
    right = cv2.Sobel(z, cv2.CV_32F, 1, 0, scale=1 / (8 * cell))
    azimuth, elevation = np.radians([AZIMUTH_DEG, ELEVATION_DEG])
    east, north = np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation)
    light = (np.sin(elevation) - right * east + down * north) / np.sqrt(1 + right**2 + down**2)
    return np.asarray(np.clip(1 + 254 * light, 1, 255), np.uint8)


def _cells(ground: Ground) -> Grid:
    """The cells of the surface, on the map's grid."""
    grid = ground.grid
    return grid.coarser(max(1, min(round(ground.surface.cell / grid.gsd), 64)))


def _shown(drawn: Drawn, cells: Grid) -> NDArray[np.bool_]:
    """Cells (h, w) where the map shows a photo."""
    row, column = drawn.provenance_grid.nearest(cells)
    return np.asarray(drawn.provenance[row][:, column] > 0)


def _write(
    path: Path, values: NDArray[np.generic], cells: Grid, alignment: Alignment, tags: dict[str, str]
) -> None:
    real = values.dtype.kind == "f"
    spec = RasterSpec(
        width=cells.width,
        height=cells.height,
        bands=1,
        dtype="float32" if real else "uint8",
        transform=geotransform(cells, alignment),
        crs=alignment.frame.crs,
        vertical=VERTICAL_EPSG.get(alignment.frame.vertical_datum) if real else None,
        nodata=float("nan") if real else 0.0,
        tags={"SOFTWARE": "Skyquilt"} | tags,
        band_units=("m",) if real and alignment.frame.metric else (),
    )
    write_array(path, values.astype(spec.dtype, copy=False), spec)


def _contours(path: Path, z: Float, cells: Grid, alignment: Alignment, step: float) -> None:
    # imported only where contours are wanted: both need Shapely
    from skyquilt.ortho.contours import contour_lines
    from skyquilt.raster.geopackage import write_lines

    factor = max(1, round(CONTOUR_CELL_M / cells.gsd))
    known = np.isfinite(z).astype(np.float32)
    h, w = z.shape[0] // factor * factor, z.shape[1] // factor * factor
    if min(h, w) < 2 * factor:
        write_lines(path, "contours", [], crs=alignment.frame.crs)
        return
    share, total = (
        np.asarray(a[:h, :w].reshape(h // factor, factor, w // factor, factor).mean((1, 3)))
        for a in (known, np.where(known > 0, z, 0))
    )
    mean = np.where(share == 1, total, np.nan)
    coarse = cells.coarser(factor)
    east, north = alignment.frame.origin

    def placed(line: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.column_stack([coarse.x(line[:, 0]) + east, coarse.y(line[:, 1]) + north])

    lines = contour_lines(mean.astype(np.float32), step) if (share == 1).any() else iter(())
    write_lines(
        path, "contours", ((placed(at), height) for at, height in lines), crs=alignment.frame.crs
    )
