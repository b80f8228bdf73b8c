"""Output files of `depth`: a raster on the map grid, images, figures and a page."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.heights import VERTICAL_EPSG
from skyquilt.depth.pairs import PairField
from skyquilt.imaging.nodes import View
from skyquilt.matching.levelled import depth_map
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment
from skyquilt.model.raster import Grid
from skyquilt.model.surface import Surface
from skyquilt.ortho.companions import geotransform, preview_factor
from skyquilt.raster import Block, CogWriter, RasterSpec
from skyquilt.raster.atomic import whole_file

FILES = ("depth.tif", "depth.png", "depth.json", "report.html")
PAIRS = "pairs"
"""Folder for the images of the pairs' disparity fields."""
FIELD_PX = 750
"""Width of these images in px."""


def seen_twice(
    views: Sequence[View], grid: Grid
) -> Callable[[int, int, int, int], NDArray[np.bool_]]:
    """Function (row, column, height, width) -> (height, width) that gives the pixels covered by at
    least two footprints.
    """
    outlines = [np.stack(grid.pixel(v.footprint[:, 0], v.footprint[:, 1]), 1) for v in views]

    def inside(row: int, column: int, height: int, width: int) -> NDArray[np.bool_]:
        number = np.zeros((height, width), np.uint16)
        for outline in outlines:
            mask = np.zeros((height, width), np.uint8)
            cv2.fillPoly(mask, [np.round(outline - (column, row)).astype(np.int32)], 1)
            number += mask
        return np.asarray(number > 1)

    return inside


def write_depth(
    path: Path,
    surface: Surface,
    views: Sequence[View],
    grid: Grid,
    alignment: Alignment,
    tags: dict[str, str],
    *,
    measured: Surface | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Writes depth.tif in blocks; returns a preview (h, w) and its valid pixels: those that two
    photos cover, and where `measured`, if given, is 1.
    """
    spec = RasterSpec(
        width=grid.width,
        height=grid.height,
        bands=1,
        dtype="float32",
        transform=geotransform(grid, alignment),
        crs=alignment.frame.crs,
        vertical=VERTICAL_EPSG.get(tags["VERTICAL_DATUM"]),
        nodata=float("nan"),
        tags={"SOFTWARE": "Skyquilt"} | tags,
        band_units=(tags["UNIT"],),
    )
    inside = seen_twice(views, grid)
    with CogWriter(path, spec) as writer:
        for block in writer.blocks():
            known = inside(block.row0, block.col0, block.height, block.width)
            if measured is not None:
                known &= _heights(measured, grid, block) > 0.5
            writer.write_block(
                block, np.where(known, _heights(surface, grid, block), np.nan), known
            )
    small = grid.coarser(preview_factor(grid))
    whole = Block(row0=0, col0=0, height=small.height, width=small.width, tile=spec.tile)
    known = seen_twice(views, small)(0, 0, small.height, small.width)
    if measured is not None:
        known &= _heights(measured, small, whole) > 0.5
    return _heights(surface, small, whole), known


def _heights(surface: Surface, grid: Grid, block: Block) -> NDArray[np.float32]:
    x, y = np.meshgrid(
        grid.x(block.col0 + np.arange(block.width)), grid.y(block.row0 + np.arange(block.height))
    )
    return surface.at(x, y)


def false_colour(z: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """RGBA (h, w, 4): colour map turbo (low blue, high red) between the 1st and 99th percentile;
    transparent where unknown.
    """
    low, high = np.percentile(z[known], [1, 99]) if known.any() else (0.0, 1.0)
    index = np.clip((z - low) / max(float(high - low), 1e-6) * 255, 0, 255).astype(np.uint8)
    return np.dstack(
        [
            cv2.applyColorMap(index, cv2.COLORMAP_TURBO)[..., ::-1],
            known.astype(np.uint8) * np.uint8(255),
        ]
    )


def field_picture(field: PairField, photo: Photo) -> NDArray[np.uint8]:
    """RGB: the disparity field over photo b in the colours of (Y 4.8)."""
    factor = FIELD_PX / photo.width
    shape = max(1, round(photo.height * factor)), FIELD_PX
    return np.asarray(np.round(depth_map(field.px * factor, field.d_px, shape) * 255), np.uint8)


def field_name(a: Photo, b: Photo) -> str:
    """File name of a pair's image in the folder PAIRS."""
    return (
        "__".join(Path(p.name).with_suffix("").as_posix().replace("/", "_") for p in (a, b))
        + ".png"
    )


def former_fields(output: Path) -> list[Path]:
    """Images of pairs from a former run in the folder, as listed in its depth.json."""
    try:
        pairs = json.loads((output / "depth.json").read_text(encoding="utf-8"))["pairs"]
        return [output / PAIRS / Path(str(p["field"])).name for p in pairs]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    """Writes an RGB or RGBA image as PNG."""
    order = [2, 1, 0, 3][: picture.shape[2]]
    done, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., order]))
    assert done
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path, needed=len(data)) as file:
        file.write(data.tobytes())
