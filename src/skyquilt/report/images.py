"""Rasters as data URIs, colour scales, and the outline of what is not transparent."""

from base64 import b64encode

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

SEQUENTIAL = cv2.COLORMAP_VIRIDIS
ACCENT = (31, 111, 139)


def shrunk(image: NDArray, longest: int, interpolation: int = cv2.INTER_AREA) -> NDArray:
    """The image with its longer side at most so many px."""
    factor = longest / max(image.shape[:2])
    if factor >= 1:
        return image
    size = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    return cv2.resize(image, size, interpolation=interpolation)


def jpeg_uri(rgb: NDArray, quality: int = 82) -> str:
    """A JPEG of (H, W, 3) uint8."""
    data = simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), quality=quality, colorspace="RGB")
    return "data:image/jpeg;base64," + b64encode(data).decode()


def png_uri(rgba: NDArray) -> str:
    """A PNG of (H, W, 4) uint8 RGBA."""
    ok, data = cv2.imencode(".png", cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA), (cv2.IMWRITE_PNG_COMPRESSION, 4))
    if not ok:
        raise ValueError(f"cannot encode a raster of shape {rgba.shape}")
    return "data:image/png;base64," + b64encode(data.tobytes()).decode()


def scale(values: NDArray) -> NDArray[np.uint8]:
    """Colours (..., 3) RGB of values in [0, 1] on the sequential scale."""
    index = np.clip(np.nan_to_num(values) * 255, 0, 255).astype(np.uint8)
    bgr = cv2.applyColorMap(np.atleast_2d(index), SEQUENTIAL)
    return np.ascontiguousarray(bgr[..., ::-1]).reshape(*index.shape, 3)


def css(rgb: NDArray) -> str:
    """`#rrggbb`."""
    return "#" + "".join(f"{int(c):02x}" for c in rgb)


def outline(alpha: NDArray[np.uint8], *, tolerance: float = 0.7, limit: int = 200) -> list[NDArray[np.float64]]:
    """Rings (k, 2) in px (corners of the image at 0 and its size) around all that is not transparent, holes too.

    At most `limit` rings, the largest ones.
    """
    solid = cv2.copyMakeBorder((alpha > 127).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT)
    rings = cv2.findContours(solid, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)[0]
    rings = sorted((r for r in rings if len(r) > 2), key=cv2.contourArea, reverse=True)[:limit]
    return [cv2.approxPolyDP(r, tolerance, True)[:, 0, :] - 0.5 for r in rings]


def shaded(z: NDArray, cell: float) -> tuple[NDArray[np.uint8], float, float]:
    """RGBA of heights, lit from the north-west, and the heights at both ends of the colour scale."""
    valid = np.isfinite(z)
    low, high = (float(v) for v in np.percentile(z[valid], [1, 99]))
    if high - low < 1e-6:
        low, high = low - 0.5, high + 0.5
    filled = np.where(valid, z, low).astype(np.float32)
    east = cv2.Sobel(filled, cv2.CV_32F, 1, 0, scale=0.125 / cell)
    south = cv2.Sobel(filled, cv2.CV_32F, 0, 1, scale=0.125 / cell)
    light = np.clip(1 + 0.45 * (east + south) / np.sqrt(1 + east**2 + south**2), 0.45, 1.25)
    rgb = np.clip(scale((filled - low) / (high - low)) * light[..., None], 0, 255).astype(np.uint8)
    return np.dstack([rgb, np.where(valid, 255, 0).astype(np.uint8)]), low, high
