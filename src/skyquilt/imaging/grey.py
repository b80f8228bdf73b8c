"""Images for feature detection: small, grey, 8 bit, for every kind of sensor."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

LEAST_SPAN, GOOD_SPAN = 75.0, 150.0
"""Grey values that a photo of ordinary contrast spans at least, and mostly."""
MOST_STRETCHED = 8.0
"""Most by which contrast is stretched: more would be noise."""
SAMPLED = 4
"""Every so many rows and columns tell the contrast."""
DETAIL_CELLS = 9, 12
"""Rows and columns of the cells of a picture in which detail is measured."""
DETAIL_PX = 64
"""Most px along a side of the patch in the middle of a cell that is measured."""
PLAIN = 0.05
"""Mean square of grey values that is added to detail: that of 8-bit rounding."""


def shrink(image: NDArray[Any], longest: int) -> tuple[NDArray[Any], float]:
    """The image area-averaged so that its longest side is at most `longest` px, and the scale
    factor.

    The scale is full-size px per px of the result; the size is rounded, so it is exact to within
    that rounding on both axes.
    """
    width, size = image.shape[1], _fitting(image, longest)
    return (image, 1.0) if size is None else (averaged(image, size), width / size[0])


def halved(image: NDArray[Any], longest: int) -> NDArray[Any]:
    """Halves the image (means of 2 x 2 px) while `shrink` to the longest side would do so; `shrink`
    then gives the same result.
    """
    size = _fitting(image, longest)
    return image if size is None else _halved(image, size)


def _fitting(image: NDArray[Any], longest: int) -> tuple[int, int] | None:
    """(width, height) with the requested longest side; None where the image is no longer than
    that.
    """
    height, width = image.shape[:2]
    scale = max(width, height) / longest
    return (max(1, round(width / scale)), max(1, round(height / scale))) if scale > 1 else None


def averaged(image: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    """The image (h, w[, bands]) area-averaged to a smaller size (width, height)."""
    image = _halved(image, size)
    if image.ndim == 3 and image.shape[2] > 4:  # more than OpenCV takes
        planes = [image[..., k].copy() for k in range(image.shape[2])]
        return np.stack([averaged(p, size) for p in planes], axis=-1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _halved(image: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    # OpenCV has a special path for averages of 2 x 2, ten times as fast as any other ratio
    while image.shape[1] >= 3 * size[0] and image.shape[0] % 2 == 0 and image.shape[1] % 2 == 0:
        half = (image.shape[1] // 2, image.shape[0] // 2)
        image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA))
    return image


def to_grey8(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Grey, 8 bit (H, W). Radiometric input is stretched between its 1st and 99th percentile, then
    equalised locally, because the few degrees of a scene fill a small part of a thermal sensor's
    range.
    """
    if image.ndim == 3:
        image = (
            image[..., 0]
            if image.shape[2] == 1
            else cv2.cvtColor(image[..., :3], cv2.COLOR_RGB2GRAY)
        )
    if image.dtype == np.uint8:
        return image
    values = image.astype(np.float32)
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.zeros(values.shape, np.uint8)
    low, high = np.percentile(finite, [1, 99])
    stretched = np.nan_to_num((values - low) / max(float(high - low), 1e-6) * 255, nan=0.0)
    grey = np.clip(stretched, 0, 255).astype(np.uint8)
    return np.asarray(cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(grey))


def stretched(*images: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], ...]:
    """Grey images (h, w), those of dusk, fog or haze with the contrast of others: where the values
    of all of them together, but for one in a thousand at either end, span less than `LEAST_SPAN`,
    they are stretched to `GOOD_SPAN`.
    """
    sample = np.concatenate([i[::SAMPLED, ::SAMPLED].ravel() for i in images])
    low, high = np.percentile(sample, [0.1, 99.9]) if sample.size else (0.0, 255.0)
    span = max(float(high - low), 1.0)
    if span >= LEAST_SPAN:
        return images
    factor = min(GOOD_SPAN / span, MOST_STRETCHED)
    values = (np.arange(256) - (low + high) / 2) * factor + 128
    table = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return tuple(np.asarray(cv2.LUT(i, table), np.uint8) for i in images)


def detail(pixels: NDArray[Any]) -> NDArray[np.float32]:
    """(rows, columns, 3) logarithms of detail of a photo (h, w[, bands]) in the cells of its
    picture: of fine over coarse detail along x and along y (mean squares of second differences at
    half size over those at an eighth), and of fine detail over the square of the grey value. NaN
    where it has no 8-bit values.

    Of a blurred picture fine detail is gone before coarse detail, and light changes their quotient
    least; at full size there are the artefacts of compression. Beneath a drop both are gone.
    """
    rows, columns = DETAIL_CELLS
    height, width = pixels.shape[:2]
    side = min(DETAIL_PX, height // rows, width // columns) // 8 * 8
    out = np.full((rows, columns, 3), np.nan, np.float32)
    if pixels.dtype != np.uint8 or side < 32:
        return out
    top = (2 * np.arange(rows) + 1) * height // (2 * rows) - side // 2
    left = (2 * np.arange(columns) + 1) * width // (2 * columns) - side // 2
    cells = [pixels[y : y + side, x : x + side] for y in top for x in left]
    grey = to_grey8(np.concatenate(cells))  # one below the other, so that all are reduced at once
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    eighth = cv2.resize(half, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    halves = half.reshape(-1, side // 2, side // 2).astype(np.float32)
    fine = _second(halves) + PLAIN
    coarse = _second(eighth.reshape(-1, side // 8, side // 8).astype(np.float32)) + PLAIN
    out[..., :2] = np.log(fine / coarse).reshape(rows, columns, 2)
    brightness = halves.mean((1, 2), dtype=np.float64)
    out[..., 2] = np.log(fine.mean(1) / (brightness**2 + 1)).reshape(rows, columns)
    return out


def _second(grey: NDArray[np.float32]) -> NDArray[np.float64]:
    """Mean squares (N, 2) of second differences along x and y of images (N, h, w)."""
    along = grey[:, :, 2:] - 2 * grey[:, :, 1:-1] + grey[:, :, :-2]
    across = grey[:, 2:] - 2 * grey[:, 1:-1] + grey[:, :-2]
    squares = [np.einsum("nij,nij->n", d, d) / (d.shape[1] * d.shape[2]) for d in (along, across)]
    return np.stack(squares, axis=1).astype(np.float64)


def full_px(px: NDArray[Any], shape: tuple[int, int], full: tuple[int, int]) -> NDArray[np.float64]:
    """Converts pixels (N, 2) of a shrunken image of `shape` (H, W) to those of the full image (H,
    W), centres at integers.
    """
    factor = np.array([full[1] / shape[1], full[0] / shape[0]])
    return np.asarray((np.asarray(px, np.float64) + 0.5) * factor - 0.5)


def shrunken_px(
    u: NDArray[Any], v: NDArray[Any], shape: tuple[int, ...], full: tuple[int, int]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Columns u and rows v of a full image (H, W) on a shrunken one of `shape` (H, W), centres at
    integers, in their precision. Both sides of that are rounded, so its pixels may be oblong by a
    thousandth: at the far rim half a pixel.
    """
    across, down = shape[1] / full[1], shape[0] / full[0]
    return (u + 0.5) * across - 0.5, (v + 0.5) * down - 0.5
