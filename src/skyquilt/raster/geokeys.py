"""Place on Earth as GeoTIFF tags (OGC 19-008r4)."""

import struct
from functools import lru_cache

from skyquilt.raster.spec import RasterSpec
from skyquilt.raster.tiff import ASCII, DOUBLE, SHORT, Tag

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
    return tags + (list(crs_tags(spec.crs)) if spec.crs else [])


@lru_cache(maxsize=16)
def crs_tags(crs: str) -> tuple[Tag, ...]:
    """GeoKeyDirectory, doubles and text of a CRS; pixels are areas.

    A plain EPSG code is three keys; for anything else GDAL writes a 1 x 1 file, whose tags are
    taken.
    """
    import pyproj

    parsed = pyproj.CRS.from_user_input(crs)
    authority = parsed.to_authority(min_confidence=100)
    plain = parsed.type_name in ("Projected CRS", "Geographic 2D CRS")
    if plain and authority and authority[0] == "EPSG" and int(authority[1]) < 32767:
        model, key = (1, 3072) if parsed.is_projected else (2, 2048)
        keys = (1, 1, 0, 3, 1024, 0, 1, model, 1025, 0, 1, 1, key, 0, 1, int(authority[1]))
        return (Tag(GEO_KEYS, SHORT, keys),)
    return _tags_by_gdal(parsed.to_wkt())


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
