"""What a file says before its pixels: size, type, EXIF, XMP, raw thermal data."""

import hashlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal

import numpy as np
from PIL import Image

from skyquilt.errors import UnreadablePhotoError
from skyquilt.photos.exif import Exif, parse_exif, read_tiff_tags
from skyquilt.photos.jpeg import JpegHeader, has_end, read_jpeg_header
from skyquilt.photos.xmp import Xmp, parse_xmp

if TYPE_CHECKING:
    import tifffile

Dtype = Literal["uint8", "uint16", "float32"]
Kind = Literal["jpeg", "tiff", "png"]
_WHOLE = 1 << 20
_END = 1 << 18
_TIFF_MAGIC = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")


@dataclass(frozen=True, kw_only=True, eq=False)
class Header:
    """The head of one image file."""

    kind: Kind
    """Format by content, whatever the name says."""
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


def read_header(path: Path) -> Header:
    """Read the head of an image; raises `UnreadablePhotoError` with the reason, nothing else."""
    try:
        with path.open("rb") as file:
            kind = _kind(file)
            return {"jpeg": _jpeg, "tiff": _tiff, "png": _png}[kind](file)
    except UnreadablePhotoError:
        raise
    except OSError as error:
        raise UnreadablePhotoError(f"it cannot be read ({error.strerror or error})") from error
    except Exception as error:  # tifffile and Pillow raise many kinds on garbage
        raise UnreadablePhotoError(
            f"its header is broken ({type(error).__name__}: {error})"
        ) from error


def content_digest(path: Path) -> str:
    """BLAKE2b of the file (hex); of a JPEG over 1 MiB of its size, first and last 256 KiB.

    Coded pixels shift everything behind a change, so the ends betray it; other formats are hashed
    whole.
    """
    digest = hashlib.blake2b(digest_size=16)
    with path.open("rb") as file:
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


def _kind(file: BinaryIO) -> Kind:
    head = file.read(8)
    if not head:
        raise UnreadablePhotoError("it is empty (0 bytes)")
    if head[:2] == b"\xff\xd8":
        return "jpeg"
    if head[:4] in _TIFF_MAGIC:
        return "tiff"
    if head == b"\x89PNG\r\n\x1a\n":
        return "png"
    raise UnreadablePhotoError("it is neither JPEG, TIFF nor PNG inside, whatever its name says")


def _jpeg(file: BinaryIO) -> Header:
    head = read_jpeg_header(file)
    if not has_end(file, head.scan_offset):
        raise UnreadablePhotoError("it is cut off: its JPEG data never end")
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


def _tiff(file: BinaryIO) -> Header:
    import tifffile  # most photos are JPEGs

    exif = read_tiff_tags(file)
    file.seek(0)
    with tifffile.TiffFile(file) as tiff:
        page = tiff.pages[0]
        if not isinstance(page, tifffile.TiffPage) or page.dtype is None:
            raise UnreadablePhotoError("it is a TIFF of a kind that cannot be decoded")
        _check_extent(page, file)
        packet = page.tags[700].value if 700 in page.tags else b""
        alpha = sum(int(e) in (1, 2) for e in page.extrasamples)
        return Header(
            kind="tiff",
            width=int(page.imagewidth),
            height=int(page.imagelength),
            channels=int(page.samplesperpixel) - alpha,
            dtype=_stored_as(page.dtype),
            exif=exif,
            xmp=parse_xmp((packet,) if isinstance(packet, bytes) and packet else ()),
        )


def _check_extent(page: "tifffile.TiffPage", file: BinaryIO) -> None:
    need = max(
        (o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=False)), default=0
    )
    have = file.seek(0, io.SEEK_END)
    if need > have:
        raise UnreadablePhotoError(
            f"it is cut off: its pixels need {need} bytes, the file has {have}"
        )


def _stored_as(dtype: "np.dtype[np.generic]") -> Dtype:
    if dtype == np.uint8:
        return "uint8"
    if dtype == np.uint16:
        return "uint16"
    if dtype.kind in "iuf":
        return "float32"
    raise UnreadablePhotoError(f"its pixels are of type {dtype}; whole or real numbers are needed")


def _png(file: BinaryIO) -> Header:
    file.seek(-12, io.SEEK_END)
    if b"IEND" not in file.read(12):
        raise UnreadablePhotoError("it is cut off: its PNG data never end")
    file.seek(0)
    with Image.open(file) as image:
        packet = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
        packet = packet.encode() if isinstance(packet, str) else packet
        block = image.info.get("exif") or b""
        gray = image.mode in ("1", "L", "LA") or image.mode.startswith(("I", "F"))
        return Header(
            kind="png",
            width=image.width,
            height=image.height,
            channels=1 if gray else 3,
            dtype="uint16" if image.mode.startswith("I") else "uint8",
            exif=parse_exif(block.removeprefix(b"Exif\x00\x00")),
            xmp=parse_xmp((packet,) if packet else ()),
        )
