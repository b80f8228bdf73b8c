"""File headers: JPEG segments, size, type, EXIF, XMP, raw thermal data."""

import hashlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

from skyquilt.errors import UnreadablePhotoError
from skyquilt.outside import MOST_MP, check_picture, open_regular
from skyquilt.photos.tags import Exif, Xmp, parse_exif, parse_xmp

SOI, EOI, SOS = 0xD8, 0xD9, 0xDA
APP0, APP1, APP3 = 0xE0, 0xE1, 0xE3
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_UNUSUAL = frozenset({0xC3, 0xC7, 0xCB, 0xCF, 0xF7})  # coded without loss; the last is JPEG-LS
_NOT_EIGHT_BITS = (
    "it is a JPEG of more than 8 bits, or coded without loss, which is not read; save it as usual"
    " JPEG, TIFF or PNG"
)
_BARE = frozenset({0x01, *range(0xD0, 0xD8)})  # markers without a length
_FLIR = b"FLIR\x00"
_EXIF = b"Exif\x00"
_XMP = b"http://ns.adobe.com/xap/1.0/\x00"
_XMP_MORE = b"http://ns.adobe.com/xmp/extension/\x00"
_SEVERAL_SCANS = frozenset({0xC2, 0xC6, 0xCA, 0xCE})
MOST_SCANS = 64
"""Largest number of scans of a JPEG: each is decoded over the whole picture."""
MOST_SEGMENTS, MOST_HEADER_BYTES, MOST_FILL = 5000, 64_000_000, 4096
"""Largest number of segments before a JPEG's pixels, of their bytes, and of bytes between them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JpegHeader:
    """The content of a JPEG file before the first scan."""

    width: int
    """Width in px as encoded."""
    height: int
    """Height in px as encoded."""
    channels: int
    """Colour components: 1, 3 or 4."""
    segments: tuple[tuple[int, bytes], ...]
    """Marker and payload of every APP segment, in the order of the file."""
    scan_offset: int
    """Byte at which the first scan begins."""
    sampling: tuple[int, ...] = ()
    """Sampling factors of each component: 16 times the horizontal one plus the vertical one."""
    several_scans: bool = False
    """Whether the pixels come in several scans (progressive, or a band at a time), so that decoding
    keeps all coefficients in memory.
    """

    @property
    def radiometric(self) -> bool:
        """Whether segments of the kind that FLIR and DJI keep raw thermal data in are there."""
        return any(m == APP3 or (m == APP1 and p.startswith(_FLIR)) for m, p in self.segments)

    @property
    def coding(self) -> str:
        """What tells the program that wrote the file from others, whatever the quality: sampling
        factors, as `2x1 1x1 1x1`, and whether there is a JFIF segment.
        """
        factors = [f"{factor >> 4}x{factor & 15}" for factor in self.sampling]
        jfif = any(m == APP0 and p.startswith(b"JFIF") for m, p in self.segments)
        return " ".join((*factors, "JFIF")) if jfif else " ".join(factors)

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
        """Payloads of one marker that start with `prefix`, joined without the prefix."""
        return b"".join(
            p[len(prefix) :] for m, p in self.segments if m == marker and p.startswith(prefix)
        )


def _next_marker(file: BinaryIO) -> int:
    byte = file.read(1)
    if byte != b"\xff":
        raise UnreadablePhotoError("its JPEG header is broken or truncated")
    for _ in range(MOST_FILL):
        byte = file.read(1)
        if not byte:
            raise UnreadablePhotoError("its JPEG header is truncated")
        if byte != b"\xff":  # fill bytes may precede a marker
            return byte[0]
    raise UnreadablePhotoError("its JPEG header is broken or truncated")


def _payload(file: BinaryIO) -> bytes:
    length = int.from_bytes(file.read(2), "big") - 2
    payload = file.read(max(length, 0))
    if length < 0 or len(payload) < length:
        raise UnreadablePhotoError("its JPEG header is truncated")
    return payload


def read_jpeg_header(file: BinaryIO) -> JpegHeader:
    """Reads the segments up to the first scan.

    Raises `UnreadablePhotoError` where the header is broken, truncated or declares no image.
    """
    file.seek(2)
    segments: list[tuple[int, bytes]] = []
    frame: tuple[int, int, int] | None = None
    sampling: tuple[int, ...] = ()
    several = False
    for _ in range(MOST_SEGMENTS):
        marker = _next_marker(file)
        if marker == SOS:
            break
        if marker in _BARE:
            continue
        if marker == EOI:
            raise UnreadablePhotoError("it is a JPEG without an image in it")
        payload = _payload(file)
        if marker in _UNUSUAL or (marker in _FRAMES and payload[:1] not in (b"", b"\x08")):
            raise UnreadablePhotoError(_NOT_EIGHT_BITS)
        if marker in _FRAMES and len(payload) >= 6:
            height, width = (int.from_bytes(payload[k : k + 2], "big") for k in (1, 3))
            frame, several = (width, height, payload[5]), marker in _SEVERAL_SCANS
            sampling = tuple(payload[7 : 6 + 3 * payload[5] : 3])
        elif 0xE0 <= marker <= 0xEF:
            segments.append((marker, payload))
        if file.tell() > MOST_HEADER_BYTES:
            break
    else:
        marker = 0
    if marker != SOS:
        raise UnreadablePhotoError(
            f"its JPEG header has more than {MOST_SEGMENTS} segments or"
            f" {MOST_HEADER_BYTES // 10**6} MB"
        )
    if frame is None or 0 in frame:
        raise UnreadablePhotoError("it is a JPEG that declares no image size")
    offset = file.tell()
    bands = file.read(3)[2:]
    return JpegHeader(
        width=frame[0],
        height=frame[1],
        channels=frame[2],
        segments=tuple(segments),
        scan_offset=offset,
        sampling=sampling,
        several_scans=several or (bool(bands) and bands[0] < frame[2]),
    )


def check_jpeg(head: JpegHeader, file: BinaryIO, most_mp: float = MOST_MP) -> None:
    """Refuses a JPEG by its declared size, or by its number of scans.

    A decoder keeps three bytes per pixel; of pictures in several scans also all coefficients.
    """
    size = file.seek(0, io.SEEK_END)
    bytes_per_px = 3 + 2 * head.channels if head.several_scans else 3
    check_picture(head.width, head.height, bytes_per_px, file_bytes=size, most_mp=most_mp)
    if not head.several_scans:
        return
    file.seek(head.scan_offset)
    scans, last = 1, b""
    while block := file.read(1 << 20):
        scans += (last + block).count(b"\xff\xda")
        last = block[-1:]
        if scans > MOST_SCANS:
            raise UnreadablePhotoError(f"its JPEG data have more than {MOST_SCANS} scans")


def has_end(file: BinaryIO, scan_offset: int) -> bool:
    """Whether the pixels end with an end-of-image marker.

    Inside the coded pixels FF D9 cannot occur (FF is stuffed), so the first one after the scan's
    start is the image's own end, whatever previews or padding follow it. The end of the file is
    searched first, because the marker is usually there.
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


Dtype = Literal["uint8", "uint16", "float32"]
Kind = Literal["jpeg", "tiff", "png", "webp"]
_WHOLE = 1 << 20
_END = 1 << 18
_TIFF_MAGIC = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")


@dataclass(frozen=True, kw_only=True, eq=False)
class Header:
    """The header of one image file."""

    kind: Kind
    """Format by content, independent of the file name."""
    width: int
    """Width in px."""
    height: int
    """Height in px."""
    channels: int
    """Bands without alpha."""
    dtype: Dtype
    """Type of the decoded pixels."""
    exif: Exif
    """EXIF tags."""
    xmp: Xmp
    """XMP properties."""
    jpeg: JpegHeader | None = None
    """The segments, of a JPEG."""
    alpha: bool = False
    """Whether pixels may be see-through."""
    stored: str = ""
    """Type of the values in the file (`int16`), of a TIFF."""
    notes: tuple[str, ...] = ()
    """Sentences on what of the file is not read."""


def read_header(path: Path, *, most_mp: float = MOST_MP) -> Header:
    """Reads the header of an image; raises `UnreadablePhotoError` with the reason, and no other
    exception. `most_mp`: largest area in megapixels.
    """
    try:
        with open_regular(path) as file:
            kind = kind_of(file.read(HEAD_BYTES))
            if kind == "jpeg":
                return _jpeg(file, most_mp)
            if kind == "webp":
                from skyquilt.photos.webp import read_webp  # most are JPEGs

                return read_webp(file, most_mp)
            from skyquilt.photos.lossless_headers import read_png, read_tiff

            return (read_tiff if kind == "tiff" else read_png)(file, most_mp)
    except UnreadablePhotoError:
        raise
    except OSError as error:
        raise UnreadablePhotoError(f"it cannot be read ({error.strerror or error})") from error
    except Exception as error:  # tifffile and Pillow raise many exceptions on broken data
        broken = f"its header is broken ({type(error).__name__}: {error})"
        raise UnreadablePhotoError(broken) from error


def content_digest(path: Path) -> str:
    """BLAKE2b of the file (hex); for a JPEG over 1 MiB, of its size and its first and last 256 KiB.

    A change in coded pixels shifts all bytes after it, so it changes the end of the file; other
    formats are hashed completely.
    """
    digest = hashlib.blake2b(digest_size=16)
    with open_regular(path) as file:
        size = file.seek(0, io.SEEK_END)
        file.seek(0)
        if size > _WHOLE and file.read(2) == b"\xff\xd8":
            file.seek(0)
            digest.update(str(size).encode() + file.read(_END))
            file.seek(size - _END)
        else:
            file.seek(0)
        while block := file.read(_WHOLE):
            digest.update(block)
    return digest.hexdigest()


_OTHERS = {
    b"RIFF": "a film or sound (RIFF)",
    b"GIF8": "a GIF picture",
    b"BM": "a BMP picture",
    b"%PDF": "a PDF document",
    b"PK\x03\x04": "a ZIP archive",
    b"\xff\x0a": "a JPEG XL picture",
    b"\0\0\0\x0cJXL ": "a JPEG XL picture",
    b"\0\0\0\x0cjP  ": "a JPEG 2000 picture",
    b"<VRTData": "a virtual raster (VRT), which names the files that hold its pixels",
    b"\x89HDF": "a scientific data set (HDF5, NetCDF)",
    b"CDF": "a scientific data set (NetCDF)",
    b"SQLite f": "a database (GeoPackage or the like)",
    b"<": "a web page or other text",
    b"version ": "a pointer of Git LFS to a file that is not here",
    b"\0\x05\x16\x07": "macOS's notes on another file",
    b"\0" * 8: "empty (zeros), as of an interrupted copy",
}
"""How files of other formats begin that are found under the name of a photo."""
_DATA = ("its pixels", "NetCDF)", "the like)")
"""How those end from which other programs can export a GeoTIFF."""
_BOXES = {
    b"hei": "a HEIC picture",
    b"hev": "a HEIC picture",
    b"mif": "a HEIC picture",
    b"avi": "an AVIF picture",
    b"crx": "a raw picture (CR3)",
    b"mp4": "a video",
    b"iso": "a video",
    b"qt ": "a video",
}
"""The same of files of the ISO base media format, by their brand."""


RAW_PICTURES = frozenset(
    (".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".pef", ".r3d", ".raf", ".raw", ".rw2", ".srw")
) | {".insp"}
"""Endings of raw pictures, which cameras write beside photos, and of pictures of two fisheyes."""
PREVIEWS = frozenset((".lrv", ".thm"))
"""Endings of small copies of videos, and pictures of them, which cameras write beside these."""


def unread_by_name(name: str) -> str:
    """Why a file of this name is not read, whatever its content; empty for others."""
    ending = Path(name).suffix.lower()
    if ending in PREVIEWS:
        return f"it is a camera's small copy of a video ({ending}); the video itself is read"
    if ending in RAW_PICTURES:
        return f"pictures of this kind ({ending}) are not read; take the JPEG that the camera wrote"
    return ""


HEAD_BYTES = 12
"""So many bytes at the beginning of a file tell its kind."""


def kind_of(head: bytes) -> Kind:
    """The kind of photo that begins so; raises `UnreadablePhotoError` with what it is otherwise."""
    if not head:
        raise UnreadablePhotoError("it is empty (0 bytes)")
    if head[:2] == b"\xff\xd8":
        return "jpeg"
    if head[:4] in _TIFF_MAGIC:
        return "tiff"
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        return "png"
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "webp"
    known = next((name for magic, name in _OTHERS.items() if head.startswith(magic)), "")
    if head[4:8] == b"ftyp":
        known = _BOXES.get(head[8:11], "a video or HEIF picture")
    if known:
        saved = "; save it as JPEG, TIFF or PNG with its metadata" if "picture" in known else ""
        saved = "; export its picture as a GeoTIFF" if known.endswith(_DATA) else saved
        raise UnreadablePhotoError(f"its content is {known}, whatever its name{saved}")
    raise UnreadablePhotoError("its content is neither JPEG, TIFF, PNG nor WebP, whatever its name")


def _jpeg(file: BinaryIO, most_mp: float) -> Header:
    head = read_jpeg_header(file)
    check_jpeg(head, file, most_mp)
    if not has_end(file, head.scan_offset):
        raise UnreadablePhotoError("it is truncated: its JPEG data never end")
    return Header(
        kind="jpeg",
        width=head.width,
        height=head.height,
        channels=1 if head.channels == 1 else 3,
        dtype="uint8",
        exif=parse_exif(head.exif),
        xmp=parse_xmp(head.xmp),
        jpeg=head,
    )
