"""Rasters as data URIs, colour scales, and outlines of opaque areas."""

import struct
import zlib
from base64 import b64encode
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

SEQUENTIAL = cv2.COLORMAP_VIRIDIS
ACCENT = (31, 111, 139)


def shrunk(image: NDArray[Any], longest: int, interpolation: int = cv2.INTER_AREA) -> NDArray[Any]:
    """The image, reduced so that its longer side is at most `longest` px."""
    factor = longest / max(image.shape[:2])
    if factor >= 1:
        return image
    size = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    return cv2.resize(image, size, interpolation=interpolation)


def jpeg_uri(rgba: NDArray[Any], quality: int = 80) -> str:
    """A JPEG of (H, W, 4) uint8, without its alpha channel."""
    data = simplejpeg.encode_jpeg(
        np.ascontiguousarray(rgba),
        quality=quality,
        colorspace="RGBX",
        colorsubsampling="420",
        fastdct=True,
    )
    return "data:image/jpeg;base64," + b64encode(data).decode()


def png_uri(index: NDArray[np.uint8], colours: NDArray[np.uint8]) -> str:
    """A PNG of (H, W) indices into colours (n <= 256, 4) RGBA."""
    height, width = index.shape
    rows = np.zeros((height, width + 1), np.uint8)  # each row starts with its PNG filter type: none
    rows[:, 1:] = index
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
        (b"PLTE", np.ascontiguousarray(colours[:, :3]).tobytes()),
        (b"tRNS", np.ascontiguousarray(colours[:, 3]).tobytes()),
        (b"IDAT", zlib.compress(rows.tobytes(), 5)),
        (b"IEND", b""),
    )
    data = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in chunks
    )
    return "data:image/png;base64," + b64encode(data).decode()


def thinned(values: NDArray[Any], most: int) -> NDArray[Any]:
    """Every n-th row and column, so that neither side has more than about `most`."""
    step = max(1, -(-max(values.shape[:2]) // most))
    return values[::step, ::step]


def scale(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Colours (..., 3) RGB of values in [0, 1] on the sequential scale."""
    index = np.clip(np.nan_to_num(values) * 255, 0, 255).astype(np.uint8)
    bgr = cv2.applyColorMap(np.atleast_2d(index), SEQUENTIAL)
    return np.ascontiguousarray(bgr[..., ::-1], np.uint8).reshape(*index.shape, 3)


def css(rgb: NDArray[Any]) -> str:
    """`#rrggbb`."""
    return "#" + "".join(f"{int(c):02x}" for c in rgb)


def outline(
    alpha: NDArray[np.uint8], *, tolerance: float = 0.7, limit: int = 200
) -> list[NDArray[np.float64]]:
    """Rings (k, 2) in px (the image spans 0 to its size) around opaque areas and around holes.

    At most `limit` rings, the largest ones.
    """
    solid = cv2.copyMakeBorder((alpha > 127).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT)
    rings = cv2.findContours(solid, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)[0]
    rings = sorted((r for r in rings if len(r) > 2), key=cv2.contourArea, reverse=True)[:limit]
    return [np.float64(1) * cv2.approxPolyDP(r, tolerance, True)[:, 0, :] - 0.5 for r in rings]


def shaded(z: NDArray[Any], cell: float) -> NDArray[np.uint8]:
    """RGBA (h, w, 4) of heights in m, shaded with light from the north-west; transparent where not
    finite.
    """
    valid = np.isfinite(z)
    low, high = height_range(z)
    filled = np.where(valid, z, low).astype(np.float32)
    east = cv2.Sobel(filled, cv2.CV_32F, 1, 0, scale=0.125 / cell)
    south = cv2.Sobel(filled, cv2.CV_32F, 0, 1, scale=0.125 / cell)
    light = np.clip(1 + 0.45 * (east + south) / np.sqrt(1 + east**2 + south**2), 0.45, 1.25)
    rgb = np.clip(scale((filled - low) / (high - low)) * light[..., None], 0, 255).astype(np.uint8)
    return np.dstack([rgb, np.where(valid, 255, 0).astype(np.uint8)])


def height_range(z: NDArray[Any]) -> tuple[float, float]:
    """Both ends of the colour scale for heights, of which some are finite."""
    low, high = (float(v) for v in np.percentile(z[np.isfinite(z)], [1, 99]))
    return (low, high) if high - low > 1e-6 else (low - 0.5, high + 0.5)
