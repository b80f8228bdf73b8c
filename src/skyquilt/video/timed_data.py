"""Tracks of data and text in an MP4 or MOV file, by samples: ISO/IEC 14496-12, 8.6 and 8.7."""

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from skyquilt.outside import open_regular
from skyquilt.video.container import boxes, is_mp4

Array = NDArray[np.float64]
_MOST_TABLE, _MOST_SAMPLES = 1 << 24, 1_000_000
"""Bytes of a table and samples of a track: an hour at 60 per second has 216,000, of 12 bytes at
most in each.
"""
_MOST_SAMPLE = 1 << 20


@dataclass(frozen=True, kw_only=True, eq=False)
class DataTrack:
    """Where the samples of one track lie in the file, in the order of time."""

    form: str
    """Four letters that tell what they are: `tx3g`, `text`, `gpmd`, `djmd` ..."""
    start_s: Array
    """(n,) when they begin, s from the start of the clip."""
    length_s: Array
    """(n,) how long they last, s."""
    offset: NDArray[np.int64]
    """(n,) of their first byte in the file."""
    size: NDArray[np.int64]
    """(n,) bytes."""


def data_tracks(path: Path) -> list[DataTrack]:
    """The tracks of a clip that are neither pictures nor sound; none where the file is no MP4 or
    MOV, or they are torn. Raises `OSError`.
    """
    with open_regular(path) as file:
        if not is_mp4(file):
            return []
        found = (_track(tables) for tables in _tables(file))
        return [track for track in found if track is not None]


def read_data(path: Path, track: DataTrack, most_bytes: int) -> Iterator[tuple[int, bytes]]:
    """Samples of a track with their indices, those of more than 1 MB left out; together not more
    than this, nor than the file has (damaged tables name the same bytes again and again). Raises
    `OSError`.
    """
    with open_regular(path) as file:
        most_bytes = min(most_bytes, file.seek(0, io.SEEK_END))
        for i, (offset, size) in enumerate(zip(track.offset, track.size, strict=True)):
            if not 0 < size <= _MOST_SAMPLE:
                continue
            most_bytes -= int(size)
            if most_bytes < 0:
                return
            file.seek(int(offset))
            yield i, file.read(int(size))


def _tables(file: BinaryIO) -> Iterator[dict[bytes, bytes]]:
    """The tables of each track, by name."""
    end = file.seek(0, io.SEEK_END)
    tables: dict[bytes, bytes] = {}
    for name, body, length in boxes(file, 0, end):
        if name == b"trak" and tables:
            yield tables
            tables = {}
        elif name in _READ and length <= _MOST_TABLE:
            file.seek(body)
            # a track has one handler; a second one in its data information is QuickTime's
            tables.setdefault(name, file.read(length))
    yield tables


_READ = frozenset((b"hdlr", b"mdhd", b"stsd", b"stts", b"stsz", b"stsc", b"stco", b"co64"))


def _track(tables: dict[bytes, bytes]) -> DataTrack | None:
    """The samples that the tables of a track describe."""
    if tables.get(b"hdlr", b"")[8:12] in (b"vide", b"soun", b""):
        return None
    try:
        scale = _scale(tables[b"mdhd"])
        sizes = _sizes(tables[b"stsz"])
        wide = b"co64" in tables
        chunks = _rows(tables[b"co64" if wide else b"stco"], ">u8" if wide else ">u4", 1)[:, 0]
        offset = _offsets(sizes, chunks, _rows(tables[b"stsc"], ">u4", 3))
        length = _lengths(_rows(tables[b"stts"], ">u4", 2), len(offset)) / scale
    except (KeyError, ValueError, struct.error):
        return None
    number = min(len(offset), len(length))
    return DataTrack(
        form=tables.get(b"stsd", b"")[12:16].decode("latin-1"),
        start_s=(np.cumsum(length) - length)[:number],
        length_s=length[:number],
        offset=offset[:number],
        size=sizes[:number],
    )


def _scale(header: bytes) -> int:
    """Ticks per second of a track's times, from its header (`mdhd`)."""
    (scale,) = struct.unpack_from(">I", header, 20 if header[:1] == b"\1" else 12)
    if scale == 0:
        raise ValueError("no time scale")
    return int(scale)


def _rows(table: bytes, kind: str, columns: int) -> NDArray[np.int64]:
    """Rows (n, columns) of a table after its count; fewer where it is torn."""
    (count,) = struct.unpack_from(">I", table, 4)
    whole = (len(table) - 8) // (np.dtype(kind).itemsize * columns)
    values: NDArray[Any] = np.frombuffer(table, kind, min(count, whole) * columns, 8)
    return values.astype(np.int64).reshape(-1, columns)


def _sizes(table: bytes) -> NDArray[np.int64]:
    """Bytes (n,) of each sample (`stsz`)."""
    alike, count = struct.unpack_from(">II", table, 4)
    if alike:
        return np.full(min(count, _MOST_SAMPLES), alike, np.int64)
    return _rows(table[4:], ">u4", 1)[:_MOST_SAMPLES, 0]


def _offsets(
    sizes: NDArray[np.int64], chunks: NDArray[np.int64], runs: NDArray[np.int64]
) -> NDArray[np.int64]:
    """First bytes (n,) of samples, which lie one after the other in chunks, as many in each as
    `runs` (first chunk, samples, description) say.
    """
    if not len(sizes) or not len(chunks) or not len(runs):
        return np.zeros(0, np.int64)
    run = np.searchsorted(runs[:, 0], np.arange(1, len(chunks) + 1), side="right") - 1
    held = np.minimum(runs[np.maximum(run, 0), 1], len(sizes))
    before = np.cumsum(held) - held
    used = before < len(sizes)
    chunk = np.repeat(np.flatnonzero(used), held[used])[: len(sizes)]
    inside = np.cumsum(sizes) - sizes
    first = before[chunk]
    number = len(chunk)
    return np.asarray(chunks[chunk] + inside[:number] - inside[first])


def _lengths(runs: NDArray[np.int64], number: int) -> NDArray[np.int64]:
    """Ticks (n,) that samples last, from runs (count, ticks); those that no run tells last as long
    as the last one.
    """
    if not len(runs):
        raise ValueError("no times")
    counts = np.minimum(runs[:, 0], number)
    counts = np.minimum(counts, np.maximum(number - (np.cumsum(counts) - counts), 0))
    told = np.repeat(runs[:, 1], counts)
    return np.concatenate([told, np.full(number - len(told), runs[-1, 1])])
