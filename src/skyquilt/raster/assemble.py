"""Assembles encoded tiles into a Cloud Optimized GeoTIFF in GDAL's own order.

Directories first (full size, its mask, each overview, its mask), then tiles row by row, smallest
overview first, each mask tile after its image tile, with the leader and trailer that GDAL's
structural metadata promise (https://gdal.org/drivers/raster/cog.html).
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from skyquilt.raster.atomic import whole_file
from skyquilt.raster.codecs import TileEncoder, predictor
from skyquilt.raster.spec import RasterSpec
from skyquilt.raster.tiff import (
    ASCII,
    LONG,
    LONG8,
    RATIONAL,
    SHORT,
    UNDEFINED,
    Tag,
    directories,
    header,
    place_tags,
)

IMAGE, MASK = 1, 2
"""Columns of an index (see `pyramid.Pyramid.indices`): bytes of image, bytes of mask."""

CODES = {"jpeg": 7, "deflate": 8, "zstd": 50000, "lzw": 5, "none": 1}
BIG = 3_900_000_000
"""Files that would grow beyond this many bytes become BigTIFF."""
BLANK = 2**64 - 1
"""Offset of tiles without a valid pixel, whose bytes the encoder has."""

Index = NDArray[np.uint64]


def assemble(
    path: Path,
    encoder: TileEncoder,
    indices: Sequence[Index],
    read: Callable[[int, int], bytes],
    *,
    big: bool | None = None,
) -> None:
    """Write the file from one index (rows, columns, 3) per level; `read(offset, size)` fetches
    tiles.

    Tiles without a valid pixel are written too, since most programs but GDAL refuse a file that
    leaves some out. They are left out where they would double the file: a long strip across.
    """
    spec = encoder.spec
    indices = _with_blanks(encoder, indices)
    total = sum(int(_spans(spec, index).sum()) for index in indices)
    head_size = len(_head(encoder, indices, 0, big=True))
    if big is None:
        big = total + head_size > BIG
    head_size = len(_head(encoder, indices, 0, big=big))
    blank = b"".join(encoder.blank)
    with whole_file(path, needed=head_size + total) as file:
        file.write(_head(encoder, indices, head_size, big=big))
        for index in reversed(indices):
            for offset, image, mask in index.reshape(-1, 3).tolist():
                if not image:
                    continue
                data = blank if offset == BLANK else read(offset, image + mask)
                file.write(_framed(data[:image]))
                if spec.mask:
                    file.write(_framed(data[image:]))


def _with_blanks(encoder: TileEncoder, indices: Sequence[Index]) -> Sequence[Index]:
    """The indices with a blank tile for each empty one, unless these outweigh the others."""
    blank = np.array([BLANK, *(len(part) for part in encoder.blank)], np.uint64)
    filled = [np.where(index[..., IMAGE, None] > 0, index, blank) for index in indices]
    before, after = (
        sum(int(_spans(encoder.spec, index).sum()) for index in each) for each in (indices, filled)
    )
    return filled if after <= 2 * before else indices


def _framed(data: bytes) -> bytes:
    return len(data).to_bytes(4, "little") + data + data[-4:].rjust(4, b"\0")


def _spans(spec: RasterSpec, index: Index) -> NDArray[np.int64]:
    """Bytes that each tile takes up in the file, flattened row by row; 0 for empty ones."""
    sizes = index.reshape(-1, 3).astype(np.int64)
    frames = 16 if spec.mask else 8
    return np.where(sizes[:, IMAGE] > 0, sizes[:, IMAGE] + sizes[:, MASK] + frames, 0)


def _head(encoder: TileEncoder, indices: Sequence[Index], data_start: int, *, big: bool) -> bytes:
    """Everything before the first tile."""
    spec, ghost = encoder.spec, _ghost(encoder.spec.mask)
    starts: list[int] = []
    for index in reversed(indices):
        starts.insert(0, data_start)
        data_start += int(_spans(spec, index).sum())
    ifds = []
    for level, (index, start) in enumerate(zip(indices, starts, strict=True)):
        spans = _spans(spec, index)
        offsets = start + np.cumsum(spans) - spans + 4
        images, masks = (index.reshape(-1, 3)[:, column] for column in (IMAGE, MASK))
        ifds.append(_image_tags(encoder, level) + _tile_tags(offsets, images, big))
        if spec.mask:
            ifds.append(
                _mask_tags(spec, level)
                + _tile_tags(offsets + images.astype(np.int64) + 8, masks, big)
            )
    first = len(header(0, big)) + len(ghost)
    return header(first, big) + ghost + directories(ifds, first, big)


def _tile_tags(offsets: NDArray[Any], counts: NDArray[Any], big: bool) -> list[Tag]:
    return [
        Tag(324, LONG8 if big else LONG, np.where(counts > 0, offsets, 0)),
        Tag(325, LONG, counts),
    ]


def _ghost(mask: bool) -> bytes:
    """GDAL's structural metadata between header and first directory; the space at the end leaves
    room for YES.
    """
    text = (
        "LAYOUT=IFDS_BEFORE_DATA\nBLOCK_ORDER=ROW_MAJOR\nBLOCK_LEADER=SIZE_AS_UINT4\n"
        "BLOCK_TRAILER=LAST_4_BYTES_REPEATED\nKNOWN_INCOMPATIBLE_EDITION=NO\n "
    )
    text += "MASK_INTERLEAVED_WITH_IMAGERY=YES\n" if mask else ""
    ghost = f"GDAL_STRUCTURAL_METADATA_SIZE={len(text):06d} bytes\n{text}".encode()
    return ghost + bytes(-len(ghost) % 8)


def _size_tags(spec: RasterSpec, level: int, kind: int) -> list[Tag]:
    height, width = spec.levels[level]
    return [
        Tag(254, LONG, (kind,)),
        Tag(256, LONG, (width,)),
        Tag(257, LONG, (height,)),
        Tag(284, SHORT, (1,)),
        Tag(322, SHORT, (spec.tile,)),
        Tag(323, SHORT, (spec.tile,)),
    ]


def _mask_tags(spec: RasterSpec, level: int) -> list[Tag]:
    kinds = {258: 1, 259: CODES["deflate"], 262: 4, 277: 1}
    return _size_tags(spec, level, 5 if level else 4) + [
        Tag(code, SHORT, (value,)) for code, value in kinds.items()
    ]


def _image_tags(encoder: TileEncoder, level: int) -> list[Tag]:
    spec = encoder.spec
    ycc, rgb = (
        spec.compress == "jpeg" and spec.bands == 3,
        spec.dtype == "uint8" and spec.bands == 3,
    )
    tags = _size_tags(spec, level, 1 if level else 0)
    tags += [
        Tag(258, SHORT, (spec.numpy_dtype.itemsize * 8,) * spec.bands),
        Tag(259, SHORT, (CODES[spec.compress],)),
        Tag(262, SHORT, (6 if ycc else 2 if rgb else 1,)),
        Tag(277, SHORT, (spec.bands,)),
        Tag(339, SHORT, ({"u": 1, "i": 2, "f": 3}[spec.numpy_dtype.kind],) * spec.bands),
    ]
    if predictor(spec) > 1:
        tags.append(Tag(317, SHORT, (predictor(spec),)))
    if spec.bands > 1 and not rgb:
        tags.append(Tag(338, SHORT, (0,) * (spec.bands - 1)))
    if spec.compress == "jpeg":
        tags.append(Tag(347, UNDEFINED, encoder.jpeg_tables))
    if ycc:
        tags.append(Tag(530, SHORT, (2, 2)))
        tags.append(Tag(532, RATIONAL, (0, 1, 255, 1, 128, 1, 255, 1, 128, 1, 255, 1)))
    if spec.nodata is not None:
        tags.append(Tag(42113, ASCII, f"{spec.nodata:.17g}".encode()))
    if level == 0:
        tags += place_tags(spec)
        if spec.tags or spec.band_names or spec.band_units:
            tags.append(Tag(42112, ASCII, metadata_xml(spec).encode()))
    return tags


def metadata_xml(spec: RasterSpec) -> str:
    """The tag `GDAL_METADATA`."""
    items = [
        f"<Item name={quoteattr(_clean(key))}>{_text(value)}</Item>"
        for key, value in spec.tags.items()
    ]
    for role, name, values in (
        ("description", "DESCRIPTION", spec.band_names),
        ("unittype", "UNITTYPE", spec.band_units),
    ):
        items += [
            f'<Item name="{name}" sample="{band}" role="{role}">{_text(value)}</Item>'
            for band, value in enumerate(values)
        ]
    return "<GDALMetadata>\n  " + "\n  ".join(items) + "\n</GDALMetadata>\n"


def _text(value: str) -> str:
    return escape(escape(_clean(value)))  # GDAL escapes and unescapes twice


def _clean(text: str) -> str:
    """The text without the control characters that XML 1.0 cannot represent."""
    return "".join(letter for letter in str(text) if letter >= " " or letter in "\t\n\r")
