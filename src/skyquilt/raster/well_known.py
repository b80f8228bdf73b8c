"""Geometries from well-known binary and text, checked before GEOS sees them: it reads parts by
recursion and has no limit of depth, so 20,000 nested collections end the process.
"""

import struct

import numpy as np
from shapely import force_2d, from_wkb, from_wkt
from shapely.geometry.base import BaseGeometry

MOST_DEEP = 8
"""Collections within collections."""
MOST_PIECES = 200_000
"""Parts and rings of one geometry."""
_POINT, _LINE, _POLYGON, _COLLECTIONS = 1, 2, 3, range(4, 8)
_Z, _M, _SRID = 0x80000000, 0x40000000, 0x20000000


def of_wkb(blob: bytes) -> BaseGeometry:
    """A geometry in two dimensions (OGC 06-103r4 section 8, with the flags of PostGIS).

    Raises:
        ValueError: it is torn, nested too deeply, or has too many parts.
        shapely.errors.GEOSException: GEOS refuses it.
    """
    _check(blob)
    return force_2d(from_wkb(blob))


def of_wkt(text: str) -> BaseGeometry:
    """A geometry in two dimensions (OGC 06-103r4 section 7).

    Raises:
        ValueError: it is nested too deeply.
        shapely.errors.GEOSException: GEOS refuses it.
    """
    marks = np.frombuffer(text.encode("utf-8", "replace"), np.uint8)
    depth = np.cumsum((marks == ord("(")).astype(np.int32) - (marks == ord(")")))
    if depth.max(initial=0) > MOST_DEEP + 3:  # a polygon in a multipolygon has three
        raise ValueError(f"it is nested more than {MOST_DEEP} deep")
    return force_2d(from_wkt(text))


def _check(blob: bytes) -> None:
    """Walks the structure without recursion."""
    at, pieces = 0, 0
    missing = [1]
    """Parts that are still to come, at each depth."""
    try:
        while missing:
            if missing[-1] == 0:
                missing.pop()
                continue
            missing[-1] -= 1
            order = "<" if blob[at] else ">"
            (kind,) = struct.unpack_from(f"{order}I", blob, at + 1)
            flat, numbers = _kind(kind)
            at += 9 if kind & _SRID else 5
            if flat in _COLLECTIONS or flat == _POLYGON:
                (count,) = struct.unpack_from(f"{order}I", blob, at)
                at, pieces = at + 4, pieces + count
                if pieces > MOST_PIECES:
                    raise ValueError(f"a shape has more than {MOST_PIECES} parts")
            if flat in _COLLECTIONS:
                missing.append(count)
                if len(missing) > MOST_DEEP + 1:
                    raise ValueError(f"a shape is nested more than {MOST_DEEP} deep")
                continue
            for _ in range(count if flat == _POLYGON else 1):
                places = 1
                if flat != _POINT:
                    (places,) = struct.unpack_from(f"{order}I", blob, at)
                    at += 4
                at += 8 * numbers * places
    except (struct.error, IndexError) as error:
        raise ValueError("a shape is torn") from error
    if at > len(blob):
        raise ValueError("a shape is torn")


def _kind(code: int) -> tuple[int, int]:
    """The kind of a geometry, and numbers per place."""
    plain, thousands = (code & 0x0FFFFFFF) % 1000, (code & 0x0FFFFFFF) // 1000
    if plain not in (_POINT, _LINE, _POLYGON, *_COLLECTIONS) or thousands > 3:
        raise ValueError("a shape is none of points, lines and polygons")
    high = bool(code & _Z) or thousands in (1, 3)
    return plain, 2 + high + (bool(code & _M) or thousands in (2, 3))
