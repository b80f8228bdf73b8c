"""The segments of a JPEG file in front of its pixels, without decoding anything."""

import io
from dataclasses import dataclass
from typing import BinaryIO

from skyquilt.errors import UnreadablePhotoError

SOI, EOI, SOS = 0xD8, 0xD9, 0xDA
APP1, APP3 = 0xE1, 0xE3
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BARE = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a length
_EXIF = b"Exif\x00"
_XMP = b"http://ns.adobe.com/xap/1.0/\x00"
_XMP_MORE = b"http://ns.adobe.com/xmp/extension/\x00"


@dataclass(frozen=True, kw_only=True, eq=False)
class JpegHeader:
    """What stands before the first scan."""

    width: int
    """Width in px as coded."""
    height: int
    """Height in px as coded."""
    channels: int
    """Colour components: 1, 3 or 4."""
    segments: tuple[tuple[int, bytes], ...]
    """Marker and payload of every APP segment, in the order of the file."""
    scan_offset: int
    """Byte at which the first scan begins."""

    @property
    def exif(self) -> bytes:
        """The EXIF block (a TIFF without pixels), empty where there is none."""
        found = (p[6:] for m, p in self.segments if m == APP1 and p.startswith(_EXIF))
        return next(found, b"")

    @property
    def xmp(self) -> tuple[bytes, ...]:
        """XMP packets: the main one and the extended one joined from its parts."""
        main = [p[len(_XMP) :] for m, p in self.segments if m == APP1 and p.startswith(_XMP)]
        parts = [
            p[len(_XMP_MORE) :] for m, p in self.segments if m == APP1 and p.startswith(_XMP_MORE)
        ]
        parts.sort(key=lambda p: int.from_bytes(p[36:40], "big"))  # GUID 32, length 4, offset 4
        more = b"".join(p[40:] for p in parts)
        return (*main, more) if more else tuple(main)

    def joined(self, marker: int, prefix: bytes = b"") -> bytes:
        """Payloads of one marker that start with `prefix`, the prefix dropped, one after
        another.
        """
        return b"".join(
            p[len(prefix) :] for m, p in self.segments if m == marker and p.startswith(prefix)
        )


def _next_marker(file: BinaryIO) -> int:
    byte = file.read(1)
    if byte != b"\xff":
        raise UnreadablePhotoError("its JPEG header is broken or cut off")
    while byte == b"\xff":  # fill bytes may precede a marker
        byte = file.read(1)
    if not byte:
        raise UnreadablePhotoError("its JPEG header is cut off")
    return byte[0]


def _payload(file: BinaryIO) -> bytes:
    length = int.from_bytes(file.read(2), "big") - 2
    payload = file.read(max(length, 0))
    if length < 0 or len(payload) < length:
        raise UnreadablePhotoError("its JPEG header is cut off")
    return payload


def read_jpeg_header(file: BinaryIO) -> JpegHeader:
    """Walk the segments up to the first scan.

    Raises `UnreadablePhotoError` where the header is broken, cut off or declares no image.
    """
    file.seek(2)
    segments: list[tuple[int, bytes]] = []
    frame: tuple[int, int, int] | None = None
    while (marker := _next_marker(file)) != SOS:
        if marker in _BARE:
            continue
        if marker == EOI:
            raise UnreadablePhotoError("it is a JPEG without an image in it")
        payload = _payload(file)
        if marker in _FRAMES and len(payload) >= 6:
            frame = (
                int.from_bytes(payload[3:5], "big"),
                int.from_bytes(payload[1:3], "big"),
                payload[5],
            )
        elif 0xE0 <= marker <= 0xEF:
            segments.append((marker, payload))
    if frame is None or 0 in frame:
        raise UnreadablePhotoError("it is a JPEG that declares no image size")
    return JpegHeader(
        width=frame[0],
        height=frame[1],
        channels=frame[2],
        segments=tuple(segments),
        scan_offset=file.tell(),
    )


def has_end(file: BinaryIO, scan_offset: int) -> bool:
    """Whether the pixels are closed by an end-of-image marker.

    Inside the coded pixels FF D9 cannot occur (FF is stuffed), so the first one after the scan's
    start is the image's own end, whatever previews or padding follow it. The tail is tried first,
    as it mostly lies there.
    """
    size = file.seek(0, io.SEEK_END)
    file.seek(max(scan_offset, size - 2))
    if file.read(2) == b"\xff\xd9":
        return True
    file.seek(scan_offset)
    last = b""
    while block := file.read(1 << 20):
        if b"\xff\xd9" in last + block:
            return True
        last = block[-1:]
    return False
