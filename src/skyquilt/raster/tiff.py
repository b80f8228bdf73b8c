"""The bones of a TIFF or BigTIFF file: tags and directories to bytes, little-endian.

TIFF 6.0 (Adobe, 1992); BigTIFF as libtiff reads it.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

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
    """Numbers, or bytes for ASCII (without the closing NUL) and UNDEFINED."""

    def payload(self) -> tuple[int, bytes]:
        """(count, bytes) as the file holds them."""
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
