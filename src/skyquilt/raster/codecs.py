"""Encodes a tile's pixels and mask as the bytes stored in a TIFF."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import cv2
import imagecodecs
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from skyquilt.raster.spec import RasterSpec

MCU = 16
"""Side in px of the unit that 4:2:0 JPEG codes together: ringing stays within it."""

KEPT_RIM, FADED_RIM = 8.0, 16.0
"""px outside the mask that keep the colours of its border, and px over which these then fade."""
DEFLATE_LEVEL = 6
ZSTD_LEVEL = 3


class TileEncoder:
    """Encodes tiles of one raster. It has no mutable state, so many threads may share it."""

    def __init__(self, spec: RasterSpec) -> None:
        self.spec = spec
        self._pack: Callable[[Any], bytes] = PACKERS.get(spec.compress, bytes)

    def __call__(
        self, pixels: NDArray[Any], valid: NDArray[np.bool_] | None
    ) -> tuple[bytes, bytes]:
        """Image and mask bytes of pixels (h, w, bands) with validity (h, w), None = all."""
        pixels = self._filled(pixels, valid)
        image = self._jpeg(pixels) if self.spec.compress == "jpeg" else self._lossless(pixels)
        return image, self._mask(valid) if self.spec.mask else b""

    @cached_property
    def jpeg_tables(self) -> bytes:
        """Quantisation and Huffman tables that all tiles share: the TIFF tag `JPEGTables`."""
        sample = np.zeros((MCU, MCU, self.spec.bands), np.uint8)
        return b"\xff\xd8" + split_jpeg(self._jpeg_stream(sample))[0] + b"\xff\xd9"

    @cached_property
    def blank(self) -> tuple[bytes, bytes]:
        """Image and mask bytes of a tile without a valid pixel."""
        side = self.spec.tile
        nothing = np.zeros((side, side, self.spec.bands), self.spec.numpy_dtype)
        return self(nothing, np.zeros((side, side), bool))

    @cached_property
    def _full_mask(self) -> bytes:
        return pack_mask(np.ones((self.spec.tile, self.spec.tile), bool))

    def _mask(self, valid: NDArray[np.bool_] | None) -> bytes:
        if valid is None:
            return self._full_mask
        whole = np.zeros((self.spec.tile, self.spec.tile), bool)
        whole[: valid.shape[0], : valid.shape[1]] = valid
        return pack_mask(whole)

    def _filled(self, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> NDArray[Any]:
        """The whole tile (tile, tile, bands): pixels outside the raster repeat its edge, invalid
        pixels get values that do no harm.
        """
        tile = self.spec.tile
        below, right = tile - pixels.shape[0], tile - pixels.shape[1]
        if below or right:
            pixels = np.pad(pixels, ((0, below), (0, right), (0, 0)), mode="edge")
        if valid is None:
            return pixels
        valid = np.pad(valid, ((0, below), (0, right)))
        if self.spec.compress == "jpeg":
            return smooth_fill(pixels, valid)
        nodata = self.spec.nodata if self.spec.nodata is not None else 0
        return np.where(valid[..., None], pixels, np.asarray(nodata, dtype=pixels.dtype))

    def _jpeg(self, pixels: NDArray[Any]) -> bytes:
        tables, rest = split_jpeg(stream := self._jpeg_stream(pixels))
        return rest if b"\xff\xd8" + tables + b"\xff\xd9" == self.jpeg_tables else stream

    def _jpeg_stream(self, pixels: NDArray[Any]) -> bytes:
        colour, sampling = ("RGB", "420") if self.spec.bands == 3 else ("GRAY", "Gray")
        fast = self.spec.quality <= 95  # the fast transform loses more than fine quantisation
        pixels = np.ascontiguousarray(pixels)
        return bytes(
            simplejpeg.encode_jpeg(pixels, self.spec.quality, colour, sampling, fastdct=fast)
        )

    def _lossless(self, pixels: NDArray[Any]) -> bytes:
        pixels = np.ascontiguousarray(pixels, dtype=self.spec.numpy_dtype)
        if predictor(self.spec) == 3:
            pixels = imagecodecs.floatpred_encode(pixels, axis=-2)
        elif predictor(self.spec) == 2:
            pixels = imagecodecs.delta_encode(pixels, axis=-2)
        return self._pack(pixels)


def predictor(spec: RasterSpec) -> int:
    """TIFF's predictor: 3 floating point, 2 horizontal differences, 1 none."""
    if spec.compress in ("jpeg", "none"):
        return 1
    return 3 if spec.dtype == "float32" else 2


def split_jpeg(stream: bytes) -> tuple[bytes, bytes]:
    """(tables, abbreviated stream) of an interchange JPEG; the application segment is dropped."""
    tables, rest, at = [], [stream[:2]], 2
    while stream[at + 1] != 0xDA:
        end = at + 2 + int.from_bytes(stream[at + 2 : at + 4], "big")
        if stream[at + 1] in (0xDB, 0xC4):
            tables.append(stream[at:end])
        elif not 0xE0 <= stream[at + 1] <= 0xEF:
            rest.append(stream[at:end])
        at = end
    return b"".join(tables), b"".join([*rest, stream[at:]])


def smooth_fill(pixels: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[Any]:
    """Pixels (uint8) with the invalid ones near to valid ones set to the nearest of these, ever
    darker: the border keeps its colours in JPEG's units, and programs that ignore masks show a rim
    that fades, without steps. All others are black.
    """
    if not valid.any():
        return np.zeros_like(pixels)
    mask = valid.view(np.uint8)
    out = np.zeros_like(pixels)
    cv2.copyTo(pixels, mask, out)
    if valid.all():
        return out
    # each valid pixel is a label; they are counted from 1 in the order of rows
    apart, place = cv2.distanceTransformWithLabels(
        1 - mask, cv2.DIST_L2, cv2.DIST_MASK_3, labelType=cv2.DIST_LABEL_PIXEL
    )
    apart = apart.ravel()
    fill = np.flatnonzero((apart > 0) & (apart < KEPT_RIM + FADED_RIM))
    nearest = np.flatnonzero(valid)[place.ravel()[fill] - 1]
    light = 1 - np.maximum(apart[fill] - KEPT_RIM, 0) / FADED_RIM
    flat = out.reshape(-1, out.shape[2])
    flat[fill] = np.rint(flat[nearest] * light[:, None])
    return out


def pack_mask(valid: NDArray[np.bool_]) -> bytes:
    """One bit per pixel, compressed with deflate."""
    return bytes(imagecodecs.zlib_encode(np.packbits(valid, axis=1).tobytes(), level=1))


def unpack_mask(data: bytes, height: int, width: int) -> NDArray[np.bool_]:
    """Inverse of `pack_mask`."""
    rows = np.frombuffer(imagecodecs.zlib_decode(data), np.uint8).reshape(height, -1)
    return np.unpackbits(rows, axis=1, count=width).astype(bool)


PACKERS: dict[str, Callable[[Any], bytes]] = {
    "deflate": lambda pixels: bytes(imagecodecs.deflate_encode(pixels, level=DEFLATE_LEVEL)),
    "zstd": lambda pixels: bytes(imagecodecs.zstd_encode(pixels, level=ZSTD_LEVEL)),
    "lzw": lambda pixels: bytes(imagecodecs.lzw_encode(pixels)),
}
