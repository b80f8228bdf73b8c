"""Pixels of a photo: always in sensor coordinates, EXIF Orientation never applied.

At `reduction` r a reduced pixel covers r x r full ones and the size is rounded up: pixel (i, j) of
the reduced image has its centre at (r * i + (r - 1) / 2, r * j + (r - 1) / 2) of the full one.
Reduced JPEGs are decoded directly at that scale.
"""

import re
from pathlib import Path
from typing import Any, BinaryIO, Literal

import cv2
import numpy as np
import simplejpeg
from imagecodecs import png_decode
from numpy.typing import NDArray

from skyquilt.errors import UnreadablePhotoError
from skyquilt.model.photo import Photo
from skyquilt.outside import open_regular
from skyquilt.photos.detector_faults import repaired
from skyquilt.photos.headers import HEAD_BYTES, content_digest, kind_of, read_header
from skyquilt.photos.tags import GDAL_METADATA, MAKE, MOST_XMP, Xmp, parse_xmp
from skyquilt.photos.thermal import (
    linear_gain,
    stated_scale,
    thermal_frame_of_jpeg,
    thermal_frame_of_values,
)
from skyquilt.photos.webp import decode_webp
from skyquilt.raster.fillings import without_fillings
from skyquilt.video.decoder import frame_of

Pixels = NDArray[Any]
Reduction = Literal[1, 2, 4, 8]
_XMP = 700
"""Tag of a TIFF with its XMP packet."""
_NODATA = 42113
"""GDAL's tag of a TIFF: the value of pixels that have none, as text."""
_HARMLESS = re.compile(r"JFIF|Inconsistent progression|Invalid SOS")
_LEFT_OVER = re.compile(r"\b(\d{1,2}) extraneous bytes before marker 0x([0-9a-f]{2})")
_FEW_BYTES = 4
"""So many bytes that no pixel needs mean nothing, whatever they are."""


def read_color(photo: Photo, *, reduction: Reduction = 1) -> Pixels:
    """Pixels as recorded: (height, width, 3) uint8 RGB, (height, width) for a single band, or
    (height, width, bands).

    Type and unit are `photo.dtype` and `photo.unit`; thermal frames are float32 with NaN where
    there is no measurement. Raises `UnreadablePhotoError` where the data are broken.
    """
    return _read(photo, reduction, gray=False)


def read_gray(photo: Photo, *, reduction: Reduction = 1) -> NDArray[np.uint8]:
    """Brightness (height, width) uint8 for feature detection; see `to_gray` for other types.

    Raises `UnreadablePhotoError` where the data are broken.
    """
    return to_gray(_read(photo, reduction, gray=True))


def lost(photo: Photo) -> str:
    """What became of a photo's file since it was read, as a reason to leave the photo out: gone, no
    longer readable, or with another content. Empty where nothing did.
    """
    try:
        with open_regular(photo.path):
            pass
        same = photo.frame_s is not None or content_digest(photo.path) == photo.digest
    except FileNotFoundError:
        return "its file is gone"
    except OSError as error:
        return f"its file can no longer be read ({error.strerror or error})"
    return "" if same else "its file was changed after it had been read"


def to_gray(pixels: Pixels) -> NDArray[np.uint8]:
    """Brightness (height, width) uint8 of decoded pixels; other types than uint8 are stretched.

    Each frame is stretched from its own 0.5 and 99.5 percentiles of finite values to 0-255; NaN
    becomes 0.
    """
    if pixels.ndim == 3 and pixels.dtype == np.uint8 and pixels.shape[2] == 3:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    flat = pixels if pixels.ndim == 2 else pixels.mean(axis=2, dtype=np.float32)
    if flat.dtype == np.uint8:
        return flat
    real = flat.astype(np.float32)
    finite = real[np.isfinite(real)]
    low, high = np.percentile(finite, [0.5, 99.5]) if finite.size else (0.0, 1.0)
    scaled = (real - low) * (255.0 / max(high - low, 1e-6))
    return np.clip(np.nan_to_num(scaled, nan=0.0), 0, 255).astype(np.uint8)


def reduce_pixels(pixels: Pixels, reduction: int) -> Pixels:
    """Area mean over reduction x reduction px; the size is rounded up, type and band layout are
    kept.
    """
    if reduction == 1:
        return pixels
    height, width = pixels.shape[:2]
    below, right = -height % reduction, -width % reduction
    padded = cv2.copyMakeBorder(pixels, 0, below, 0, right, cv2.BORDER_REPLICATE)
    size = (padded.shape[1] // reduction, padded.shape[0] // reduction)
    return np.asarray(cv2.resize(padded, size, interpolation=cv2.INTER_AREA))


def _read(photo: Photo, reduction: Reduction, *, gray: bool) -> Pixels:
    try:
        pixels = _decode(photo, reduction, gray=gray)
    except UnreadablePhotoError:
        raise
    except Exception as error:  # decoders raise many exceptions; all mean: unreadable
        raise UnreadablePhotoError(f"its pixels cannot be decoded ({error})") from error
    want = (-(-photo.height // reduction), -(-photo.width // reduction))
    if pixels.shape[:2] != want:
        found = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise UnreadablePhotoError(
            f"its pixels are {found} but its header states {want[1]}x{want[0]}"
        )
    return pixels


def _decode(photo: Photo, reduction: Reduction, *, gray: bool) -> Pixels:
    """Decodes the file. Its size was checked when its header was read, and is compared with that
    before anything is allocated: the file may have been replaced.
    """
    if photo.frame_s is not None:
        pixels = frame_of(photo.path, photo.frame_s)
        return reduce_pixels(to_gray(pixels) if gray else pixels, reduction)
    size = (photo.width, photo.height)
    with open_regular(photo.path) as file:
        head = file.read(HEAD_BYTES)
        file.seek(0)
        if head[:2] == b"\xff\xd8" and photo.unit:
            return reduce_pixels(_mended(_thermal_jpeg(photo.path), photo), reduction)
        if head[:2] == b"\xff\xd8":
            data = file.read()
            _same_size(simplejpeg.decode_jpeg_header(data)[1::-1], size)
            return decode_jpeg(data, gray=gray or photo.channels == 1, reduction=reduction)
        if head[:4] == b"\x89PNG":
            return reduce_pixels(_png(file, photo), reduction)
        if kind_of(head) == "webp":
            pixels = decode_webp(file, size)
            if photo.alpha:
                pixels = _emptied(pixels[..., :-1], pixels[..., -1])
            return reduce_pixels(to_gray(pixels) if gray else pixels, reduction)
        pixels = read_tiff(file, size, scaled=bool(photo.unit), stored=photo.stored)
    if photo.channels == 1:
        pixels = pixels[..., 0]
    elif photo.channels == 3 and pixels.shape[2] == 1:  # grey among photos in colour
        pixels = np.repeat(pixels, 3, axis=2)
    if photo.unit:
        pixels = _mended(thermal_frame_of_values(pixels, photo.stored).values, photo)
    return reduce_pixels(pixels, reduction)


def _mended(frame: Pixels, photo: Photo) -> Pixels:
    """A thermal frame without the faults that its detector is known to have."""
    if photo.faults is None or frame.shape != (photo.height, photo.width):
        return frame
    return repaired(frame, photo.faults)


def _same_size(found: tuple[int, ...], stated: tuple[int, int]) -> None:
    if tuple(found) != stated:
        raise UnreadablePhotoError(
            f"its pixels are {found[0]}x{found[1]} but its header states {stated[0]}x{stated[1]}"
        )


def decode_jpeg(data: bytes, *, gray: bool = False, reduction: Reduction = 1) -> NDArray[np.uint8]:
    """A JPEG file's bytes as (height, width, 3) RGB or (height, width), at full or reduced scale.

    Raises `UnreadablePhotoError` where data are missing or corrupt, where a decoder would fill in
    grey.
    """
    height, width, _, _ = simplejpeg.decode_jpeg_header(data)
    wanted = {
        "colorspace": "GRAY" if gray else "RGB",
        "min_height": -(-height // reduction) if reduction > 1 else 0,
        "min_width": -(-width // reduction) if reduction > 1 else 0,
    }
    try:
        pixels = simplejpeg.decode_jpeg(data, **wanted)
    except ValueError as error:
        if not _is_harmless(str(error), data):
            raise UnreadablePhotoError(f"its JPEG data are damaged ({error})") from error
        pixels = simplejpeg.decode_jpeg(data, strict=False, **wanted)
    return np.asarray(pixels[..., 0] if gray else pixels, dtype=np.uint8)


def _is_harmless(complaint: str, data: bytes) -> bool:
    """Whether all pixels are there in spite of what the decoder complains of. Bytes that it did not
    need are what a camera fills up with where they are few or all alike; others are pixels, which a
    wrong bit before has moved out of their places.
    """
    left = _LEFT_OVER.search(complaint)
    if left is None:
        return _HARMLESS.search(complaint) is not None
    number, marker = int(left[1]), re.escape(b"\xff" + bytes.fromhex(left[2]))
    alike = rb"(.)\1{%d}" % (number - 1) + marker
    return number <= _FEW_BYTES or re.search(alike, data, re.DOTALL) is not None


def _thermal_jpeg(path: Path) -> Pixels:
    header = read_header(path)
    frame = header.jpeg and thermal_frame_of_jpeg(header.jpeg, make=header.exif.text(MAKE))
    if not frame:
        raise UnreadablePhotoError("its radiometric frame is missing")
    return frame.values


def _png(file: BinaryIO, photo: Photo) -> Pixels:
    """The pixels of a PNG; see-through ones are black."""
    from PIL.PngImagePlugin import PngImageFile  # most photos are JPEGs

    with PngImageFile(file) as image:
        _same_size(image.size, (photo.width, photo.height))
        if photo.dtype == "uint16":  # of colours, Pillow would keep 8 bits
            file.seek(0)
            pixels = np.asarray(png_decode(file.read()))
        else:
            mode = ("L" if photo.channels == 1 else "RGB") + ("A" if photo.alpha else "")
            pixels = np.asarray(image.convert(mode))
    if photo.alpha:
        pixels = _emptied(pixels[..., :-1], pixels[..., -1])
        pixels = pixels[..., 0] if photo.channels == 1 else pixels
    return pixels


def _emptied(pixels: Pixels, alpha: Pixels) -> Pixels:
    """Pixels (h, w[, bands]) in which those that alpha (h, w) makes see-through hold no value: a
    program may have left anything there.
    """
    most = np.iinfo(alpha.dtype).max if alpha.dtype.kind == "u" else max(float(alpha.max()), 1e-9)
    empty = np.nan if pixels.dtype.kind == "f" else 0
    shown = (alpha >= most / 2).reshape(*alpha.shape, *(1,) * (pixels.ndim - 2))
    return np.where(shown, pixels, np.asarray(empty, pixels.dtype))


def read_tiff(
    file: BinaryIO, size: tuple[int, int], *, scaled: bool = False, stored: str = ""
) -> Pixels:
    """The page of a TIFF that is the photo as (height, width, bands) without alpha, signed and
    wide types as float32, black and white as 0 and 255, palettes and inks as RGB, pixels that are
    see-through or hold the value that stands for none as black or NaN, and so what programs fill
    real numbers with; `size`: the width and height
    that were checked; `scaled`: by the scale and offset that GDAL's tags state, or where values
    mean kelvins (`stored`), by FLIR's kelvins per count.
    """
    import tifffile  # imported here because most photos are JPEGs

    from skyquilt.photos.lossless_headers import has_band_beside, measured_page

    with tifffile.TiffFile(file) as tiff:
        page, _ = measured_page(tiff)
        _same_size((int(page.imagewidth), int(page.imagelength)), size)
        pixels = np.asarray(page.asarray(maxworkers=1))
        planar = page.planarconfig == 2 and pixels.ndim == 3
        kind, palette = int(page.photometric), page.colormap
        alpha = [int(e) in (1, 2) for e in page.extrasamples]
        void, beside = _void_value(page), has_band_beside(page)
        scale = stated_scale(_text(page, GDAL_METADATA)) if scaled else None
        if scaled and scale is None and stored == "kelvin" and pixels.dtype == np.uint16:
            gain = linear_gain(_xmp_of(tiff.pages.first))
            scale = None if gain is None else (gain, 0.0)
    if planar:
        pixels = np.moveaxis(pixels, 0, -1)
    if pixels.dtype == np.bool_:  # one bit for each pixel; `white` is the one that stands for it
        white = kind != tifffile.PHOTOMETRIC.MINISWHITE
        pixels = np.where(pixels == white, 255, 0).astype(np.uint8)
    elif pixels.dtype == np.uint8 and kind == tifffile.PHOTOMETRIC.MINISWHITE:
        pixels = np.uint8(255) - pixels
    if beside and pixels.ndim == 3:
        pixels = pixels[..., :1]
    empty = None if void is None else _equal(pixels, void)
    if pixels.dtype not in (np.uint8, np.uint16):
        real = pixels.dtype.kind == "f"
        with np.errstate(over="ignore"):  # what fills gaps may be larger
            pixels = pixels.astype(np.float32)
        pixels = without_fillings(pixels) if real else pixels
    pixels = pixels if pixels.ndim == 3 else pixels[..., None]
    if kind == tifffile.PHOTOMETRIC.PALETTE and palette is not None:
        pixels = np.moveaxis(palette[:, pixels[..., 0]] // 257, 0, -1).astype(np.uint8)
    elif kind == tifffile.PHOTOMETRIC.SEPARATED and pixels.dtype == np.uint8:
        light = np.uint16(255) - pixels[..., :4]
        pixels = ((light[..., :3] * light[..., 3:] + np.uint16(127)) // 255).astype(np.uint8)
    elif True in alpha:
        kinds = [*[False] * (pixels.shape[2] - len(alpha)), *alpha]
        pixels = _emptied(pixels[..., np.invert(kinds)], pixels[..., kinds.index(True)])
    if empty is not None and empty.any():
        pixels[empty] = np.nan if pixels.dtype.kind == "f" else 0
    if scale is not None:
        pixels = pixels.astype(np.float32) * np.float32(scale[0]) + np.float32(scale[1])
        if empty is not None:
            pixels[empty] = np.nan
    return np.ascontiguousarray(pixels)


def _xmp_of(page: Any) -> Xmp:
    """The XMP packet of a page of a TIFF."""
    told = page.tags.get(_XMP)
    packet = told.value if told is not None and told.count <= MOST_XMP else b""
    return parse_xmp((packet,) if isinstance(packet, bytes) and packet else ())


def _void_value(page: Any) -> float | None:
    """The value that stands for none in a page of a TIFF, as GDAL states it; None where it states
    none.
    """
    try:
        return float(_text(page, _NODATA))
    except ValueError:
        return None


def _text(page: Any, tag: int) -> str:
    """The text of a tag of a page; empty where there is none."""
    told = page.tags.get(tag)
    return told.value.strip("\0 ") if told is not None and isinstance(told.value, str) else ""


def _equal(pixels: Pixels, void: float) -> NDArray[np.bool_]:
    """(h, w) which pixels (h, w[, bands]) hold that value in all bands; programs write it with the
    digits of a real number of 32 bits or of 64.
    """
    with np.errstate(over="ignore"):
        same = (
            pixels == void if pixels.dtype.kind in "iu" else pixels.astype("f4") == np.float32(void)
        )
    return np.asarray(same if same.ndim == 2 else same.all(axis=2))
