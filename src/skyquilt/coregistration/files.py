"""Output files of a registration: B on A's grid, images for display, a report page."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.fusion import (
    alpha,
    checkerboard,
    error_colours,
    false_colour,
    shown,
    side_by_side,
)
from skyquilt.coregistration.page import registration_page
from skyquilt.coregistration.pictures import Source
from skyquilt.coregistration.stated_error import error_map
from skyquilt.model.photo import RejectedPhoto
from skyquilt.model.registration import Matrix, RefusedRegistration, Registration
from skyquilt.raster.atomic import whole_file, write_text
from skyquilt.raster.cog import Block, CogWriter
from skyquilt.raster.read_map import MapFile
from skyquilt.raster.spec import RasterSpec

_TYPES = {
    "uint8": "Byte",
    "int8": "Int8",
    "uint16": "UInt16",
    "int16": "Int16",
    "uint32": "UInt32",
    "int32": "Int32",
    "uint64": "UInt64",
    "int64": "Int64",
    "float32": "Float32",
    "float64": "Float64",
}
_COLOURS = ("Red", "Green", "Blue")


def vrt(
    source: Path,
    *,
    size: tuple[int, int],
    bands: int,
    dtype: str,
    px: NDArray[Any],
    ground: NDArray[Any],
    crs: str | None,
    place: MapFile | None = None,
) -> str:
    """XML of a raster of `size` (width, height) whose pixels are those of `source`.

    px (n, 2) are columns and rows counted from the outer corner, ground (n, 2) x and y of `crs` (or
    pixels of another image, if None); place: what a map says of its values.
    """
    points = "\n".join(
        f'    <GCP Id="{k}" Pixel="{p[0]:.4f}" Line="{p[1]:.4f}" X="{g[0]:.9f}" Y="{g[1]:.9f}"/>'
        for k, (p, g) in enumerate(zip(px, ground, strict=True), 1)
    )
    said = _said(place) if place else ""
    body = "\n".join(_band(source, k, bands, _TYPES[dtype], said) for k in range(1, bands + 1))
    if place and place.masked and place.nodata is None:
        body += "\n  <MaskBand>\n" + _band(source, "mask,1", 1, "Byte", "") + "\n  </MaskBand>"
    return (
        f'<VRTDataset rasterXSize="{size[0]}" rasterYSize="{size[1]}">\n'
        f"  <GCPList Projection={quoteattr(crs or '')}>\n{points}\n "
        f" </GCPList>\n{body}\n</VRTDataset>\n"
    )


def _band(source: Path, number: int | str, bands: int, kind: str, said: str) -> str:
    colour = f"    <ColorInterp>{_COLOURS[int(number) - 1]}</ColorInterp>\n" if bands == 3 else ""
    named = f' band="{number}"' if isinstance(number, int) else ""
    return (
        f'  <VRTRasterBand dataType="{kind}"{named}>\n{said}{colour}    <SimpleSource>\n'
        f'      <SourceFilename relativeToVRT="0">{escape(str(source))}</SourceFilename>\n'
        f"      <SourceBand>{number}</SourceBand>\n    </SimpleSource>\n  </VRTRasterBand>"
    )


def _said(place: MapFile) -> str:
    """What every band of a map says of its values."""
    lines = []
    if place.nodata is not None:
        lines.append(f"<NoDataValue>{place.nodata!r}</NoDataValue>")
    if place.unit:
        lines.append(f"<UnitType>{escape(place.unit)}</UnitType>")
    if place.scale != (1.0, 0.0):
        lines += [f"<Offset>{place.scale[1]!r}</Offset>", f"<Scale>{place.scale[0]!r}</Scale>"]
    if place.palette is not None:
        rows = (
            '<Entry c1="{}" c2="{}" c3="{}" c4="{}"/>'.format(*c) for c in place.palette.tolist()
        )
        lines += ["<ColorInterp>Palette</ColorInterp>", f"<ColorTable>{''.join(rows)}</ColorTable>"]
    return "".join(f"    {line}\n" for line in lines)


OVERLAYS = ("side_by_side.png", "checkerboard.png", "false_colour.png", "alpha.png")
CONTRACT = ("registration.json", "report.html", "b_on_a.tif", "b.vrt", "error.tif", *OVERLAYS)
"""Files of an accepted registration; a refused one writes only the first two."""
ERROR_ACROSS = 128
"""Most pixels along the longer side of error.tif; the error changes slowly."""
LONGEST_SHOWN = 1600
"""Longer side in px of the images for display."""
_MARGIN = 2


def draw(output: Path, a: Source, b: Source, outcome: Registration) -> None:
    """Writes B on A's grid at full size, a virtual raster of B's own pixels with ground control
    points, and the images for display.
    """
    resample_onto(output / "b_on_a.tif", a, b, outcome.b_H_a)
    if not (b.photo and b.photo.unit):  # a virtual raster would show a radiometric photo's palette
        write_text(output / "b.vrt", _vrt(a, b, outcome.b_H_a))
    if outcome.error is not None:
        write_error(output / "error.tif", a, b, outcome)
    for name, picture in zip(OVERLAYS, overlays(a, b, outcome), strict=True):
        done, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
        assert done
        with whole_file(output / name, needed=len(data)) as file:
            file.write(data.tobytes())


def overlays(a: Source, b: Source, outcome: Registration) -> list[NDArray[np.uint8]]:
    """RGB images in the order of `OVERLAYS`, reduced to `LONGEST_SHOWN`."""
    small_a, _, a_S = _reduced(a)
    small_b, there_is, b_S = _reduced(b)
    there = b_S @ outcome.b_H_a @ np.linalg.inv(a_S)
    size = (small_a.shape[1], small_a.shape[0])
    back = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
    moved = np.asarray(cv2.warpPerspective(small_b, there, size, flags=back), np.uint8)
    seen = np.asarray(cv2.warpPerspective(there_is, there, size, flags=back)) > 127
    lines = side_by_side(small_a, small_b, _apply(a_S, outcome.px_a), _apply(b_S, outcome.px_b))
    return [
        lines,
        checkerboard(small_a, moved, seen),
        false_colour(small_a, moved, seen),
        alpha(small_a, moved, seen),
    ]


def write_error(path: Path, a: Source, b: Source, outcome: Registration) -> None:
    """Writes the error map: on a coarse grid over A, the distance in px of B within which the
    registration is right with 95 %.
    """
    step = max(1.0, max(a.height, a.width) / ERROR_ACROSS)
    bound = error_map(outcome, (a.height, a.width), (b.height, b.width), step)
    m = a.place.affine if a.place else (1.0, 0.0, 0.0, 0.0, -1.0, 0.0)
    spec = RasterSpec(
        width=bound.shape[1],
        height=bound.shape[0],
        bands=1,
        dtype="float32",
        transform=(m[0] * step, m[1] * step, m[2], m[3] * step, m[4] * step, m[5]),
        crs=a.place.crs if a.place else None,
        nodata=float("nan"),
        mask=False,
        compress="deflate",
        band_units=("px of B",),
        tags={"SOFTWARE": "Skyquilt"},
    )
    with CogWriter(path, spec) as writer:
        for block in writer.blocks():
            part = bound[
                block.row0 : block.row0 + block.height, block.col0 : block.col0 + block.width
            ]
            writer.write_block(block, part, np.isfinite(part))


def _error_picture(a: Source, b: Source, outcome: Registration, tolerance: float) -> list[Any]:
    """The error map in colours over A (RGB), in a list; none if the method states no error."""
    if outcome.error is None:
        return []
    grey, _, _ = _reduced(a)
    step = max(a.height, a.width) / max(grey.shape)
    bound = error_map(outcome, (a.height, a.width), (b.height, b.width), step)
    fine = cv2.resize(bound, (grey.shape[1], grey.shape[0]), interpolation=cv2.INTER_NEAREST)
    return [error_colours(grey, np.asarray(fine), tolerance)]


def page(
    record: dict[str, Any],
    opened: tuple[Source | RejectedPhoto, Source | RejectedPhoto],
    outcome: Registration | RefusedRegistration,
) -> str:
    """The report page as one self-contained file."""
    a, b = opened
    pictures: list[NDArray[np.uint8]] = []
    if isinstance(a, Source) and isinstance(b, Source):
        if isinstance(outcome, Registration):
            pictures = overlays(a, b, outcome)
            pictures += _error_picture(a, b, outcome, record["tolerance_px"])
        else:
            none = np.zeros((0, 2))
            pictures = [side_by_side(_reduced(a)[0], _reduced(b)[0], none, none)]
    return registration_page(record, pictures)


def _reduced(source: Source) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Matrix]:
    """Grey image for display, where it has content (255), and the transform from the file's pixels
    to its pixels.
    """
    values = source.picture.values
    valid = source.picture.valid
    if valid is None:
        valid = np.isfinite(values if values.ndim == 2 else values.sum(2, dtype=np.float32))
    grey = shown(values, valid)
    factor = min(1.0, LONGEST_SHOWN / max(grey.shape))
    size = (round(grey.shape[1] * factor), round(grey.shape[0] * factor))
    small = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
    x, y = size[0] / grey.shape[1], size[1] / grey.shape[0]
    shrinking = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1.0]])
    inside = np.where(valid, 255, 0).astype(np.uint8)
    inside = np.asarray(cv2.resize(inside, size, interpolation=cv2.INTER_AREA), np.uint8)
    return small, inside, shrinking @ np.linalg.inv(source.full_S_picture)


def _apply(matrix: NDArray[Any], px: NDArray[Any]) -> NDArray[Any]:
    moved = np.c_[px, np.ones(len(px))] @ matrix.T
    return np.asarray(moved[:, :2] / moved[:, 2:])


def resample_onto(
    path: Path, a: Source, b: Source, b_H_a: Matrix, tags: Mapping[str, str] | None = None
) -> None:
    """Writes B's values on A's pixels, with bilinear interpolation, block by block. The raster has
    A's georeference, or pixel coordinates if A has none.
    """
    sample = b.picture.values
    kind = sample.dtype.name if sample.dtype.name in ("uint8", "uint16") else "float32"
    bands = 3 if sample.ndim == 3 else 1
    spec = RasterSpec(
        width=a.width,
        height=a.height,
        bands=bands,
        dtype=kind,
        transform=a.place.affine if a.place else (1, 0, 0, 0, -1, 0),
        crs=a.place.crs if a.place else None,
        nodata=float("nan") if kind == "float32" else None,
        mask=kind != "float32",
        compress="deflate",
        band_units=(b.unit,) * bands if b.unit else (),
        tags={"SOFTWARE": "Skyquilt"} | dict(tags or {}),
    )
    with CogWriter(path, spec) as writer:
        for block in writer.blocks():
            writer.write_block(block, *_block(block, b, b_H_a, kind, bands))


def _block(
    block: Block, b: Source, b_H_a: Matrix, kind: str, bands: int
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Values (height, width[, 3]) and validity of one block."""
    shape = (block.height, block.width, bands) if bands > 1 else (block.height, block.width)
    start = np.array([[1, 0, block.col0], [0, 1, block.row0], [0, 0, 1.0]])
    part = _part(b, b_H_a @ start, block)
    if part is None:
        return np.zeros(shape, kind), np.zeros(shape[:2], bool)
    row, column, height, width = part
    values, valid = b.window(row, column, height, width)
    there = np.array([[1, 0, -column], [0, 1, -row], [0, 0, 1.0]]) @ b_H_a @ start
    factor = _shrinking(there, block)
    if factor > 1 and min(height, width) >= factor:
        size = (width // factor, height // factor)
        x, y = size[0] / width, size[1] / height
        values = cv2.resize(values.astype(np.float32), size, interpolation=cv2.INTER_AREA).astype(
            values.dtype
        )
        valid = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
        there = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1.0]]) @ there
    flags = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
    size = (block.width, block.height)
    moved = cv2.warpPerspective(
        np.where(_wide(valid, values), values, 0).astype(kind), there, size, flags=flags
    )
    seen = (
        np.asarray(cv2.warpPerspective(valid.astype(np.float32), there, size, flags=flags)) > 0.999
    )
    return np.asarray(np.where(_wide(seen, moved), moved, np.array(0, kind))), seen


def _wide(mask: NDArray[np.bool_], values: NDArray[Any]) -> NDArray[np.bool_]:
    return mask[..., None] if values.ndim == 3 else mask


def _part(b: Source, there: Matrix, block: Block) -> tuple[int, int, int, int] | None:
    """Row, column, height and width of the part of B within a block; None if there is none."""
    edge = np.linspace(0, 1, 9)
    x, y = np.meshgrid(edge * (block.width - 1), edge * (block.height - 1))
    px = _apply(there, np.c_[x.ravel(), y.ravel()])
    low = np.maximum(np.floor(px.min(0)).astype(int) - _MARGIN, 0)
    high = np.minimum(np.ceil(px.max(0)).astype(int) + _MARGIN + 1, [b.width, b.height])
    if (high - low < 1).any():
        return None
    return int(low[1]), int(low[0]), int(high[1] - low[1]), int(high[0] - low[0])


def _shrinking(there: Matrix, block: Block) -> int:
    """Number of B's pixels within one of A's, per axis; they are averaged to avoid aliasing."""
    middle = np.array([block.width / 2, block.height / 2])
    ends = _apply(there, middle + np.array([[0, 0], [1, 0], [0, 1]]))
    return max(1, int(min(np.linalg.norm(ends[1:] - ends[0], axis=1))))


def _vrt(a: Source, b: Source, b_H_a: Matrix) -> str:
    """A virtual raster of B's own file, with a grid of ground control points on A."""
    ends = np.linspace(0, 1, 6)
    x, y = np.meshgrid(ends * (b.width - 1), ends * (b.height - 1))
    px_b = np.c_[x.ravel(), y.ravel()]
    px_a = _apply(np.linalg.inv(b_H_a), px_b) + 0.5
    column, row = px_a.T
    ground = np.column_stack(a.place.ground(column, row) if a.place else (column, -row))
    values = b.picture.values
    bands, dtype = 3 if values.ndim == 3 else 1, values.dtype.name
    if b.place:  # as in the file, not as read
        bands, dtype = b.place.stored_bands, b.place.stored
    return vrt(
        b.path.resolve(),
        size=(b.width, b.height),
        bands=bands,
        dtype=dtype,
        px=px_b + 0.5,
        ground=ground,
        crs=a.place.crs if a.place else None,
        place=b.place,
    )
