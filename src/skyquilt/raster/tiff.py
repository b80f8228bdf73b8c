"""Tags, directories and GeoTIFF keys of a TIFF or BigTIFF file as little-endian bytes.

TIFF 6.0 (Adobe, 1992); BigTIFF as libtiff reads it; OGC GeoTIFF 1.1.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from skyquilt.raster.spec import RasterSpec

ASCII, SHORT, LONG, RATIONAL, UNDEFINED, DOUBLE, LONG8 = 2, 3, 4, 5, 7, 12, 16
_NUMPY = {SHORT: "<u2", LONG: "<u4", RATIONAL: "<u4", DOUBLE: "<f8", LONG8: "<u8"}


@dataclass(frozen=True)
class Tag:
    """One entry of a directory."""

    code: int
    """Number of the tag."""
    kind: int
    """TIFF type, one of the constants of this module."""
    values: "Sequence[float] | np.ndarray | bytes"
    """Numbers, or bytes for ASCII (without the final NUL) and UNDEFINED."""

    def payload(self) -> tuple[int, bytes]:
        """(count, bytes) as stored in the file."""
        if isinstance(self.values, bytes):
            data = self.values + b"\0" if self.kind == ASCII else self.values
            return len(data), data
        data = np.asarray(self.values).astype(_NUMPY[self.kind]).tobytes()
        return len(self.values) // (2 if self.kind == RATIONAL else 1), data


def header(first_directory: int, big: bool) -> bytes:
    """The 8 (TIFF) or 16 (BigTIFF) bytes at the start of the file."""
    if big:
        return struct.pack("<2sHHHQ", b"II", 43, 8, 0, first_directory)
    return struct.pack("<2sHI", b"II", 42, first_directory)


def directories(ifds: Sequence[Sequence[Tag]], start: int, big: bool) -> bytes:
    """All directories, chained, each followed by its long values; `start` is their offset in the
    file.
    """
    out = bytearray()
    for number, tags in enumerate(ifds):
        out += _directory(tags, start + len(out), big, last=number == len(ifds) - 1)
    return bytes(out)


def _directory(tags: Sequence[Tag], start: int, big: bool, last: bool) -> bytes:
    count_format, word, inline = ("<Q", "Q", 8) if big else ("<H", "I", 4)
    entry = struct.Struct("<HH" + word)
    fixed = struct.calcsize(count_format) + len(tags) * (entry.size + inline) + inline
    entries, values = bytearray(struct.pack(count_format, len(tags))), bytearray()
    for tag in sorted(tags, key=lambda tag: tag.code):
        count, data = tag.payload()
        entries += entry.pack(tag.code, tag.kind, count)
        if len(data) <= inline:
            entries += data.ljust(inline, b"\0")
        else:
            entries += struct.pack("<" + word, start + fixed + len(values))
            values += data + bytes(-len(data) % 8)
    values += bytes(-(fixed + len(values)) % 8)
    following = 0 if last else start + fixed + len(values)
    return bytes(entries + struct.pack("<" + word, following) + values)


GEO_KEYS, GEO_DOUBLES, GEO_ASCII = 34735, 34736, 34737
PIXEL_SCALE, TIE_POINT, TRANSFORMATION = 33550, 33922, 34264


def place_tags(spec: RasterSpec) -> list[Tag]:
    """Scale and tie point (or the full matrix if rotated), and the keys of the CRS where there is
    one.
    """
    a, b, c, d, e, f = spec.affine
    if b == 0 and d == 0 and a > 0 and e < 0:
        tags = [Tag(PIXEL_SCALE, DOUBLE, (a, -e, 0)), Tag(TIE_POINT, DOUBLE, (0, 0, 0, c, f, 0))]
    else:
        tags = [Tag(TRANSFORMATION, DOUBLE, (a, b, 0, c, d, e, 0, f, 0, 0, 0, 0, 0, 0, 0, 1))]
    return tags + (list(crs_tags(spec.crs, spec.vertical)) if spec.crs else [])


@lru_cache(maxsize=16)
def crs_tags(crs: str, vertical: int | None = None) -> tuple[Tag, ...]:
    """GeoKeyDirectory, doubles and text of a CRS and the EPSG code of a vertical one; pixels are
    areas.

    A plain EPSG code is three keys; for any other CRS, GDAL writes a 1 x 1 file and its tags are
    copied.
    """
    import pyproj

    parsed = pyproj.CRS.from_user_input(crs)
    authority = parsed.to_authority(min_confidence=100)
    plain = parsed.type_name in ("Projected CRS", "Geographic 2D CRS")
    if plain and authority and authority[0] == "EPSG" and int(authority[1]) < 32767:
        model, key = (1, 3072) if parsed.is_projected else (2, 2048)
        keys = (1, 1, 0, 3, 1024, 0, 1, model, 1025, 0, 1, 1, key, 0, 1, int(authority[1]))
        tags: tuple[Tag, ...] = (Tag(GEO_KEYS, SHORT, keys),)
    else:
        tags = _tags_by_gdal(parsed.to_wkt())
    return tags if vertical is None else tuple(_with_vertical(t, vertical) for t in tags)


def _with_vertical(tag: Tag, vertical: int) -> Tag:
    """The key directory with a vertical CRS in metres, as GeoTIFF 1.1 defines it (OGC 19-008r4)."""
    if tag.code != GEO_KEYS:
        return tag
    version, revision, _, count, *keys = tag.values
    added = (4096, 0, 1, vertical, 4099, 0, 1, 9001)
    return Tag(GEO_KEYS, SHORT, (version, revision, 1, count + 2, *keys, *added))


def _tags_by_gdal(wkt: str) -> tuple[Tag, ...]:
    from rasterio.crs import CRS
    from rasterio.io import MemoryFile
    from rasterio.transform import Affine

    place = {"crs": CRS.from_wkt(wkt), "transform": Affine(1, 0, 1, 0, -1, 1)}
    with MemoryFile() as memory:
        with memory.open(driver="GTiff", width=1, height=1, count=1, dtype="uint8", **place):
            pass
        return _read_tags(bytes(memory.getbuffer()))


def _read_tags(file: bytes) -> tuple[Tag, ...]:
    """The three CRS tags of a small little-endian TIFF."""
    (start,) = struct.unpack_from("<I", file, 4)
    (entries,) = struct.unpack_from("<H", file, start)
    tags = []
    for at in range(start + 2, start + 2 + 12 * entries, 12):
        code, _, count, offset = struct.unpack_from("<HHII", file, at)
        if code == GEO_KEYS:
            tags.append(Tag(code, SHORT, struct.unpack_from(f"<{count}H", file, offset)))
        elif code == GEO_DOUBLES:
            values = struct.unpack_from(f"<{count}d", file, offset)
            tags.append(Tag(code, DOUBLE, values))
        elif code == GEO_ASCII:
            tags.append(Tag(code, ASCII, file[offset : offset + count - 1]))
    return tuple(tags)
