"""Photos in WebP (RFC 9649), as web pages and messengers hand them out: header and pixels."""

import io
import math
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import UnreadablePhotoError
from skyquilt.outside import MOST_MP, check_picture
from skyquilt.photos.headers import Header
from skyquilt.photos.tags import MOST_XMP, parse_exif, parse_xmp

MOST_PARTS = 1000
"""Largest number of chunks of a file."""
_MOST_EXIF = 1_000_000
_ANIMATED, _SEE_THROUGH = 0x02, 0x10
"""Flags in the extended header (2.7)."""
_PER_PX = 8.0
"""Bytes that decoding takes for a pixel: colours and alpha, and a copy."""


def read_webp(file: BinaryIO, most_mp: float = MOST_MP) -> Header:
    """The header of a WebP, by its chunks: Pillow would allocate the picture to read it.

    Raises `UnreadablePhotoError` where it is truncated, too large, animated, or holds no picture.
    """
    whole = file.seek(0, io.SEEK_END)
    file.seek(4)
    end = 8 + int.from_bytes(file.read(4), "little")
    if end > whole:
        raise UnreadablePhotoError("it is truncated: its WebP data are not whole")
    at, size, flags = 12, (0, 0), 0
    blocks = {b"EXIF": b"", b"XMP ": b""}
    for _ in range(MOST_PARTS):
        if at + 8 > end:
            break
        file.seek(at)
        head = file.read(18)
        name, length = head[:4], int.from_bytes(head[4:8], "little")
        if at + 8 + length > end:
            raise UnreadablePhotoError("its WebP data are damaged")
        if name == b"VP8X":
            flags = head[8]
        elif name in (b"VP8 ", b"VP8L"):
            size, see_through = _coded(name, head[8:])
            flags |= _SEE_THROUGH * see_through
        elif name in blocks and length <= (_MOST_EXIF if name == b"EXIF" else MOST_XMP):
            file.seek(at + 8)
            blocks[name] = file.read(length)
        at += 8 + length + length % 2
    else:
        raise UnreadablePhotoError("its WebP data are damaged")
    if flags & _ANIMATED:
        raise UnreadablePhotoError("it is an animation, not a photo")
    if 0 in size:
        raise UnreadablePhotoError("it is a WebP without a picture in it")
    check_picture(*size, _PER_PX, file_bytes=whole, most_mp=most_mp)
    told = blocks[b"XMP "]
    return Header(
        kind="webp",
        width=size[0],
        height=size[1],
        channels=3,
        dtype="uint8",
        exif=parse_exif(blocks[b"EXIF"].removeprefix(b"Exif\0\0")),
        xmp=parse_xmp((told,) if told else ()),
        alpha=bool(flags & _SEE_THROUGH),
    )


def decode_webp(file: BinaryIO, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """Pixels (h, w, 3), or (h, w, 4) where they may be see-through; `size`: the width and height
    that were checked before, None = they are checked now.

    Raises `UnreadablePhotoError` where the file has another size, and what the decoder raises.
    """
    from imagecodecs import webp_decode  # most photos are JPEGs

    found = read_webp(file, MOST_MP if size is None else math.inf)
    if size is not None and (found.width, found.height) != size:
        raise UnreadablePhotoError(
            f"its pixels are {found.width}x{found.height} but its header states {size[0]}x{size[1]}"
        )
    file.seek(0)
    return np.asarray(webp_decode(file.read(), hasalpha=found.alpha), np.uint8)


def _coded(name: bytes, begin: bytes) -> tuple[tuple[int, int], bool]:
    """Width and height in px that a coded picture begins with, and whether it may be see-through;
    0 x 0 where it is none (RFC 6386, 9.1, and RFC 9649, 3.4).
    """
    if name == b"VP8L" and begin[:1] == b"\x2f":
        bits = int.from_bytes(begin[1:5], "little")
        return ((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1), bool(bits >> 28 & 1)
    if name == b"VP8 " and begin[3:6] == b"\x9d\x01\x2a":
        width, height = (int.from_bytes(begin[k : k + 2], "little") & 0x3FFF for k in (6, 8))
        return (width, height), False
    return (0, 0), False
