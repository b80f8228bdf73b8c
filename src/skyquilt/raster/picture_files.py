"""Pictures as files: encoded at once where they are small, row by row where they are large."""

import struct
import zlib
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import imagecodecs
import numpy as np
from numpy.typing import NDArray

from skyquilt.raster.atomic import whole_file

LEVEL = 6
"""Effort of the compression, 1 to 9."""


def image_bytes(rgba: NDArray[np.uint8], form: str, *, transparent: bool = True) -> bytes:
    """Encodes RGBA (h, w, 4) as PNG, WebP or JPEG; without transparency the background is white."""
    if not transparent or form == "image/jpeg":
        alpha = rgba[..., 3:].astype(np.uint16)
        rgb = ((rgba[..., :3] * alpha + 255 * (255 - alpha)) // 255).astype(np.uint8)
        picture_, bgr = rgb, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    else:
        picture_, bgr = rgba, cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA)
    if form == "image/webp":  # the fastest setting of the codec takes a third of the default's time
        return bytes(imagecodecs.webp_encode(np.ascontiguousarray(picture_), level=80, method=0))
    options = {
        "image/png": (".png", [cv2.IMWRITE_PNG_COMPRESSION, 1]),
        "image/jpeg": (".jpg", [cv2.IMWRITE_JPEG_QUALITY, 85]),
    }
    ending, settings = options[form]
    good, data = cv2.imencode(ending, bgr, settings)
    if not good:
        raise ValueError(f"a picture of {picture_.shape} cannot be written as {form}")
    return data.tobytes()


class PngRows:
    """Writes an RGBA picture as PNG from the top down, in the memory of the rows given at a time.

    As a context manager: the file appears when all rows were written, or not at all.
    """

    def __init__(self, path: Path, width: int, height: int) -> None:
        """Raises `OutputError` on entry where the file cannot be written."""
        self.width, self.height, self._rows = width, height, 0
        self._whole = whole_file(path)
        self._squeeze = zlib.compressobj(LEVEL)
        self._above = np.zeros((1, 4 * width), np.uint8)

    def __enter__(self) -> Self:
        self._file = self._whole.__enter__()
        self._file.write(b"\x89PNG\r\n\x1a\n")
        self._chunk(b"IHDR", struct.pack(">IIBBBBB", self.width, self.height, 8, 6, 0, 0, 0))
        return self

    def write(self, rgba: NDArray[np.uint8]) -> None:
        """The next rows (h, width, 4)."""
        flat = np.ascontiguousarray(rgba).reshape(len(rgba), -1)
        rows = np.concatenate([self._above, flat])
        filtered = np.empty((len(flat), 4 * self.width + 1), np.uint8)
        filtered[:, 0] = 2  # each byte minus the one above it
        np.subtract(rows[1:], rows[:-1], out=filtered[:, 1:])
        self._above = flat[-1:]
        self._rows += len(flat)
        if data := self._squeeze.compress(filtered.tobytes()):
            self._chunk(b"IDAT", data)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            if self._rows != self.height:
                raise ValueError(f"{self._rows} rows were written of {self.height}")
            self._chunk(b"IDAT", self._squeeze.flush())
            self._chunk(b"IEND", b"")
        self._whole.__exit__(kind, error, trace)

    def _chunk(self, name: bytes, data: bytes) -> None:
        self._file.write(struct.pack(">I", len(data)) + name + data)
        self._file.write(struct.pack(">I", zlib.crc32(name + data)))
