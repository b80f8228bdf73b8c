"""Headers of TIFF and PNG files: size, type, EXIF, XMP. Loaded only for these."""

import io
import logging
import zlib
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
import tifffile
from PIL.PngImagePlugin import PngImageFile

from skyquilt.errors import UnreadablePhotoError
from skyquilt.outside import MOST_MP, check_picture
from skyquilt.photos.headers import Dtype, Header
from skyquilt.photos.tags import MOST_XMP, Directories, parse_exif, parse_xmp, read_tiff_tags

# what it complains of is told by this program's own sentences, not on the terminal
logging.getLogger("tifffile").addHandler(logging.NullHandler())

_PNG_BITS = 24
"""Byte of a PNG that says how many bits a value has."""
MOST_CHUNKS = 100_000
"""Largest number of chunks of a PNG."""
_WIDTH, _HEIGHT, _BITS, _CODEC, _SAMPLES = 256, 257, 258, 259, 277
_STRIPS, _TILES, _XMP_TAG = 273, 324, 700
_CODECS = frozenset({1, 5, 7, 8, 32773, 32946, 34925, 50000})
"""None, LZW, JPEG, Deflate, PackBits, Deflate (old), LZMA, Zstandard."""
_CFA = 32803
"""Photometric interpretation of a colour filter array."""
_STRANGE_COLOURS, _YCBCR, _JPEGS = frozenset({8, 9, 10, 32844, 32845}), 6, frozenset({6, 7})
"""CIELAB and its kin, logarithmic light; YCbCr, which is decoded as RGB within JPEG only."""
MOST_PNG_TEXT = 8_000_000
"""Most bytes of a PNG's metadata that are read."""
_XMP_OF_JPEG = b"http://ns.adobe.com/xap/1.0/\x00"
MOST_STRIPS = 1_000_000
"""Largest number of strips or tiles of a TIFF."""
_MOST_PAGES = 8
"""Pages of a TIFF that are looked at."""
_SAME_SHAPE = 0.03
"""Relative difference of the ratios of their sides up to which two pages show the same."""
_LARGER = 1.5
"""A page so many times as wide as the first one, of its shape and bands, has that as a preview."""
_REDUCED, _MASK = 1, 4
"""Bits of a page's subtype."""


def check_tiff(file: BinaryIO, most_mp: float = MOST_MP) -> None:
    """Refuses a TIFF by what its first directory declares, before anything else is read."""
    try:
        directories = Directories(file)
        found = directories.read(
            directories.first, {_WIDTH, _HEIGHT, _BITS, _CODEC, _SAMPLES, _XMP_TAG}
        )
    except ValueError as error:
        raise UnreadablePhotoError(f"its header is broken ({error})") from error
    width, height, samples, codec = (
        int(found.get(tag, otherwise))
        for tag, otherwise in ((_WIDTH, 0), (_HEIGHT, 0), (_SAMPLES, 1), (_CODEC, 1))
    )
    bits = found.get(_BITS, 8)
    deep = max(bits) if isinstance(bits, tuple) else bits
    kept = samples * (deep + 7) // 8
    # values other than 8 and 16 bits become 32; one more copy is made where bands are interleaved
    check_picture(
        width,
        height,
        kept if deep <= 16 else kept + 4 * samples,
        file_bytes=file.seek(0, io.SEEK_END),
        most_mp=most_mp,
    )
    _check_codec(codec, max(directories.counts.get(_STRIPS, 0), directories.counts.get(_TILES, 0)))


def read_tiff(file: BinaryIO, most_mp: float) -> Header:
    """The header of a TIFF. Raises `UnreadablePhotoError`, and what tifffile raises."""
    check_tiff(file, most_mp)
    exif = read_tiff_tags(file)
    file.seek(0)
    with tifffile.TiffFile(file) as tiff:
        first, (page, pages) = tiff.pages[0], measured_page(tiff)
        if not isinstance(first, tifffile.TiffPage) or page.dtype is None:
            raise UnreadablePhotoError("its kind of TIFF cannot be decoded")
        _check_extent(page, file)
        if page is not first:
            _check_page(page, file.seek(0, io.SEEK_END), most_mp)
        packet = (
            first.tags[_XMP_TAG].value
            if _XMP_TAG in first.tags and first.tags[_XMP_TAG].count <= MOST_XMP
            else b""
        )
        kind = int(page.photometric)
        if kind == _CFA:
            raise UnreadablePhotoError(
                "it is a raw picture (DNG), whose pixels are not colours yet; save it as JPEG or"
                " TIFF by a program that develops raw pictures"
            )
        if kind in _STRANGE_COLOURS or (kind == _YCBCR and int(page.compression) not in _JPEGS):
            raise UnreadablePhotoError(
                "its colours are stored in a way that is not read (photometric interpretation"
                f" {kind}); save it as RGB"
            )
        inks = kind == tifffile.PHOTOMETRIC.SEPARATED and page.dtype == np.uint8
        coloured = inks or kind == tifffile.PHOTOMETRIC.PALETTE
        alpha = [int(e) in (1, 2) for e in page.extrasamples]
        beside = has_band_beside(page)
        return Header(
            kind="tiff",
            width=int(page.imagewidth),
            height=int(page.imagelength),
            channels=3 if coloured else int(page.samplesperpixel) - sum(alpha) - beside,
            dtype="uint8" if coloured else _stored_as(page.dtype),
            exif=exif,
            xmp=parse_xmp((packet,) if isinstance(packet, bytes) and packet else ()),
            alpha=any(alpha),
            stored=page.dtype.name,
            notes=(*_page_notes(page, first, pages), *([_BESIDE] if beside else [])),
        )


_BESIDE = "Its second band, of which the file does not say what it is, is left out."


def has_band_beside(page: tifffile.TiffPage) -> bool:
    """Whether a page has one band and a second one of unknown meaning (a mask, a confidence)."""
    grey = page.photometric in (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.MINISWHITE)
    return (
        grey and page.samplesperpixel == 2 and not any(int(e) in (1, 2) for e in page.extrasamples)
    )


def measured_page(tiff: tifffile.TiffFile) -> tuple[tifffile.TiffPage, int]:
    """The page of a TIFF that is the photo, and the number of its full-size pages.

    That is the first one, unless it is a preview: a page says that it is a reduced one and another
    is not (the largest of those); it has 8 bits and a later one, of the same shape, measurements
    of 16 bits or more in one band; or, whether it says so or not, a later one is the same larger.
    """
    first = tiff.pages.first
    if len(tiff.pages) == 1 and first.subifds is None:
        return first, 1
    pages = _pages(tiff)
    full = [p for p in pages if not int(p.subfiletype) & (_REDUCED | _MASK)]
    if int(first.subfiletype) & _REDUCED and full:
        first = max(full, key=lambda p: p.imagewidth * p.imagelength)
    alike = [p for p in full if _same_shape(p, first)]
    if first.dtype is not None and first.dtype.itemsize == 1:
        deep = (p for p in alike if p.dtype is not None and p.dtype.itemsize > 1)
        measured = next((p for p in deep if p.samplesperpixel == 1), None)
        if measured is not None:
            return measured, len(full)
    bands = [p for p in alike if p.samplesperpixel == first.samplesperpixel]
    larger = [p for p in bands if p.imagewidth > _LARGER * first.imagewidth]
    first = max(larger, key=lambda p: p.imagewidth, default=first)
    return first, len(full)


def _same_shape(a: tifffile.TiffPage, b: tifffile.TiffPage) -> bool:
    """Whether the sides of two pages have the same ratio."""
    shape = b.imagewidth / max(b.imagelength, 1)
    return bool(abs(a.imagewidth / max(a.imagelength, 1) / shape - 1) < _SAME_SHAPE)


def _pages(tiff: tifffile.TiffFile) -> list[tifffile.TiffPage]:
    """The first pages of a TIFF, and those below its first one."""
    found = [p for p in tiff.pages[:_MOST_PAGES] if isinstance(p, tifffile.TiffPage)]
    below = tiff.pages.first.pages if tiff.pages.first.subifds else None
    found += [p for p in (below or ())[:_MOST_PAGES] if isinstance(p, tifffile.TiffPage)]
    return found


def _page_notes(page: tifffile.TiffPage, first: tifffile.TiffPage, pages: int) -> tuple[str, ...]:
    told = f"{page.imagewidth}x{page.imagelength} px, {page.samplesperpixel} x {page.dtype}"
    if page is not first:
        return (f"Its first page is a preview; the page of {told} is read.",)
    return (f"It has {pages} pages; the first ({told}) is read.",) if pages > 1 else ()


def _check_page(page: tifffile.TiffPage, size: int, most_mp: float) -> None:
    """Refuses another page than the first by what it declares."""
    check_picture(
        page.imagewidth,
        page.imagelength,
        page.samplesperpixel * (page.dtype.itemsize + 4 if page.dtype is not None else 8),
        file_bytes=size,
        most_mp=most_mp,
    )
    _check_codec(int(page.compression), len(page.dataoffsets))


def _check_codec(codec: int, pieces: int) -> None:
    if codec not in _CODECS:
        name = (
            tifffile.COMPRESSION(codec).name if codec in list(tifffile.COMPRESSION) else "unknown"
        )
        raise UnreadablePhotoError(
            f"its TIFF compression {codec} ({name}) is not one that is read; save it uncompressed,"
            " or with LZW or Deflate"
        )
    if pieces > MOST_STRIPS:
        raise UnreadablePhotoError(f"its pixels are in more than {MOST_STRIPS} pieces")


def _check_extent(page: tifffile.TiffPage, file: BinaryIO) -> None:
    need = max(
        (o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=False)), default=0
    )
    have = file.seek(0, io.SEEK_END)
    if need > have:
        raise UnreadablePhotoError(
            f"it is truncated: its pixels need {need} bytes, the file has {have}"
        )


def _stored_as(dtype: np.dtype[np.generic]) -> Dtype:
    if dtype in (np.uint8, np.bool_):
        return "uint8"
    if dtype == np.uint16:
        return "uint16"
    if dtype.kind in "iuf":
        return "float32"
    raise UnreadablePhotoError(f"its pixels are {dtype}; integers or real numbers are needed")


@dataclass(frozen=True, kw_only=True)
class PngMetadata:
    """What chunks of a PNG tell of the photo."""

    exif: bytes
    """The EXIF block, empty where there is none."""
    xmp: tuple[bytes, ...]
    """XMP packets."""


def check_png(file: BinaryIO, most_mp: float = MOST_MP) -> PngMetadata:
    """What its chunks tell of the photo. Refuses a PNG by its declared size, its number of chunks,
    or a missing end.
    """
    size = file.seek(0, io.SEEK_END)
    file.seek(8)
    head = file.read(21)
    if len(head) < 21 or head[4:8] != b"IHDR":
        raise UnreadablePhotoError("its PNG header is broken or truncated")
    width, height = (int.from_bytes(head[k : k + 4], "big") for k in (8, 12))
    # Pillow keeps four bytes for a pixel that is not grey, and the result is a copy
    bytes_per_px = {0: 4.0, 4: 6.0, 2: 7.0, 3: 5.0}.get(head[17], 11.0)
    bytes_per_px *= 2 if head[16] == 16 else 1
    check_picture(width, height, bytes_per_px, file_bytes=size, most_mp=most_mp)
    file.seek(8)
    packets: list[bytes] = []
    exif, left = b"", MOST_PNG_TEXT
    for _ in range(MOST_CHUNKS):
        chunk = file.read(8)
        if len(chunk) < 8:
            raise UnreadablePhotoError("it is truncated: its PNG data never end")
        length, kind = int.from_bytes(chunk[:4], "big"), chunk[4:]
        if kind == b"IEND":
            return PngMetadata(exif=exif, xmp=tuple(packets))
        if kind in _TOLD and length <= left:
            left -= length
            name, content = _told(kind, file.read(length))
            file.seek(4, io.SEEK_CUR)
            if name == "exif":
                exif = exif or content
            elif name == "xmp":
                packets.append(content)
            continue
        file.seek(length + 4, io.SEEK_CUR)
    raise UnreadablePhotoError(f"it has more than {MOST_CHUNKS} PNG chunks")


_TOLD = (b"eXIf", b"iTXt", b"tEXt", b"zTXt")
"""Chunks of a PNG that may hold EXIF or XMP, before its pixels or behind them."""
_PROFILE = "raw profile type "


def _told(kind: bytes, content: bytes) -> tuple[str, bytes]:
    """`exif` or `xmp` and the block that a chunk holds; an empty name for any other text."""
    if kind == b"eXIf":
        return "exif", content
    word, _, rest = content.partition(b"\0")
    name = word.decode("latin-1").lower()
    if kind == b"iTXt":
        packed, rest = rest[:1] == b"\1", rest[2:].partition(b"\0")[2].partition(b"\0")[2]
    else:
        packed, rest = kind == b"zTXt", rest[1:] if kind == b"zTXt" else rest
    if name != "xml:com.adobe.xmp" and not name.startswith(_PROFILE):
        return "", b""
    if packed:
        try:
            rest = zlib.decompressobj().decompress(rest, MOST_PNG_TEXT)
        except zlib.error:
            return "", b""
    return ("xmp", rest) if not name.startswith(_PROFILE) else _profile(rest)


def _profile(text: bytes) -> tuple[str, bytes]:
    """A block in hexadecimal digits, as ImageMagick writes it: its kind, its length, its bytes."""
    lines = text.strip().split(b"\n", 2)
    try:
        block = bytes.fromhex(lines[-1].decode("ascii"))
    except ValueError:
        return "", b""
    if block.startswith(_XMP_OF_JPEG):
        return "xmp", block[len(_XMP_OF_JPEG) :]
    if lines[0].strip() == b"xmp":
        return "xmp", block
    return ("exif", block) if block[:4] in (b"Exif", b"II*\0", b"MM\0*") else ("", b"")


def read_png(file: BinaryIO, most_mp: float) -> Header:
    """The header of a PNG. Raises `UnreadablePhotoError`, and what Pillow raises."""
    told = check_png(file, most_mp)
    file.seek(0)
    with PngImageFile(file) as image:
        gray = image.mode in ("1", "L", "LA") or image.mode.startswith(("I", "F"))
        file.seek(_PNG_BITS)
        deep = file.read(1) == b"\x10"
        return Header(
            kind="png",
            width=image.width,
            height=image.height,
            channels=1 if gray else 3,
            dtype="uint16" if deep else "uint8",
            exif=parse_exif(told.exif.removeprefix(b"Exif\x00\x00")),
            xmp=parse_xmp(told.xmp),
            alpha=image.has_transparency_data and (not deep or image.mode in ("LA", "RGBA")),
        )
