"""GoPro's telemetry in a clip (GPMF, a track of `gpmd`): positions of its receiver.

Format: GoPro's published description of GPMF (github.com/gopro/gpmf-parser). A key of four letters,
a type, the size of an element and their number; elements of type 0 hold others. `GPS5`: latitude,
longitude, height, speeds, some 18 times a second, with one `GPSF` (0: no fix) and `GPSU` (UTC) a
second; `GPS9` of newer cameras: the same with date, time, precision and fix for each.
"""

import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

from skyquilt.geometry.geoid import geoid_height
from skyquilt.video.fixes import Fix

_NESTED, _MOST_DEPTH = 0, 4
_TYPES = {
    ord(letter): (code, struct.calcsize(">" + code))
    for letter, code in zip("bBsSlLfdjJ", "bBhHiIfdqQ", strict=True)
}
_FIX = 2
"""Fixes from this number on have a place: 2 and 3 dimensions."""
_MEAN_SEA_LEVEL = b"MSLV"
_EPOCH = datetime(2000, 1, 1, tzinfo=UTC)


@dataclass(kw_only=True)
class GoProFixes:
    """What the samples of a track say."""

    fixes: list[Fix] = field(default_factory=list)
    """In the order of time."""
    start: datetime | None = None
    """UTC at the start of the clip."""


def gopro_fixes(samples: Iterable[tuple[float, float, bytes]]) -> GoProFixes:
    """Positions in samples, each with its time and duration in s; damaged parts are left out."""
    old, new = GoProFixes(), GoProFixes()
    for time, length, data in samples:
        for stream in _streams(data, 0):
            if b"GPS9" in stream:
                _add_newer(new, stream, time, length)
            elif b"GPS5" in stream:
                _add_older(old, stream, time, length)
    return new if new.fixes else old


_Value = tuple[int, int, bytes]
"""Type, size of an element in bytes, and the elements."""


def _entries(data: bytes) -> Iterator[tuple[bytes, _Value]]:
    """Keys and what they hold; ends where it is torn."""
    at = 0
    while at + 8 <= len(data):
        key, kind, size, count = struct.unpack_from(">4sBBH", data, at)
        length = size * count
        if at + 8 + length > len(data):
            return
        yield key, (kind, size, data[at + 8 : at + 8 + length])
        at += 8 + (length + 3) // 4 * 4


def _streams(data: bytes, depth: int) -> Iterator[dict[bytes, _Value]]:
    """Streams (`STRM`) at any depth, each by its keys; of a key that stands twice, the last."""
    for key, (kind, _, body) in _entries(data):
        if kind != _NESTED or depth > _MOST_DEPTH:
            continue
        if key == b"STRM":
            yield dict(_entries(body))
        else:
            yield from _streams(body, depth + 1)


def _rows(value: _Value, kinds: bytes) -> list[tuple[float, ...]]:
    """Elements as numbers, each of several of these types."""
    if not kinds or any(k not in _TYPES for k in kinds):
        return []
    code = ">" + "".join(_TYPES[k][0] for k in kinds)
    size = struct.calcsize(code)
    whole = len(value[2]) // size * size
    return list(struct.iter_unpack(code, value[2][:whole])) if size == value[1] else []


def _numbers(value: _Value | None) -> list[float]:
    """All elements of one simple type, one after the other."""
    if value is None or value[0] not in _TYPES:
        return []
    code, size = _TYPES[value[0]]
    whole = len(value[2]) // size * size
    return [row[0] for row in struct.iter_unpack(">" + code, value[2][:whole])]


def _scaled(stream: dict[bytes, _Value], key: bytes, columns: int) -> list[tuple[float, ...]]:
    """Rows of numbers in units, at least so many in each."""
    kind, size, _ = value = stream[key]
    if kind == ord("?"):
        kinds = stream.get(b"TYPE", (0, 0, b""))[2].rstrip(b"\0")
    else:
        kinds = bytes([kind]) * (size // _TYPES[kind][1]) if kind in _TYPES else b""
    rows = _rows(value, kinds)
    by = _numbers(stream.get(b"SCAL")) or [1.0]
    by = [b or 1.0 for b in (by if len(by) > 1 else by * len(kinds))]
    if len(kinds) < columns or len(by) < len(kinds):
        return []
    return [tuple(n / b for n, b in zip(row, by, strict=False)) for row in rows]


def _fix(row: tuple[float, ...], time: float, fixed: bool, sea: float) -> Fix:
    """A row of latitude, longitude and height; `sea`: height of the sea's level in it, m."""
    latitude, longitude, height = row[:3]
    if not fixed or abs(latitude) > 90 or abs(longitude) > 180:
        return Fix(time_s=time)
    return Fix(
        time_s=time, latitude_deg=latitude, longitude_deg=longitude, sea_level_m=height - sea
    )


def _sea(stream: dict[bytes, _Value], rows: Sequence[tuple[float, ...]]) -> float:
    """The sea's level in heights of a stream, which are ellipsoidal where it does not say so."""
    if not rows or stream.get(b"GPSA", (0, 0, b""))[2][:4] == _MEAN_SEA_LEVEL:
        return 0.0
    return float(geoid_height(*rows[0][:2]))


def _add_older(found: GoProFixes, stream: dict[bytes, _Value], time: float, length: float) -> None:
    rows = _scaled(stream, b"GPS5", 3)
    fixed, sea = (_numbers(stream.get(b"GPSF")) or [_FIX])[0] >= _FIX, _sea(stream, rows)
    for k, row in enumerate(rows):
        found.fixes.append(_fix(row, time + length * k / len(rows), fixed, sea))
    if found.start is None and fixed and b"GPSU" in stream:
        found.start = _moment(stream[b"GPSU"][2], time)


def _add_newer(found: GoProFixes, stream: dict[bytes, _Value], time: float, length: float) -> None:
    rows = _scaled(stream, b"GPS9", 9)
    sea = _sea(stream, rows)
    for k, row in enumerate(rows):
        at, fixed = time + length * k / len(rows), row[8] >= _FIX
        found.fixes.append(_fix(row, at, fixed, sea))
        if found.start is None and fixed and 0 < row[5] < 40_000:
            found.start = _EPOCH + timedelta(days=row[5], seconds=row[6] - at)


def _moment(text: bytes, time: float) -> datetime | None:
    """UTC at the start of the clip, from `yymmddhhmmss.sss` at a time in it."""
    try:
        told = datetime.strptime(text.rstrip(b"\0").decode("ascii"), "%y%m%d%H%M%S.%f")
        return told.replace(tzinfo=UTC) - timedelta(seconds=time)
    except (ValueError, OverflowError):
        return None
