"""Colours of what a map's pixels mean: photos as they are, values in the colours of a palette."""

from collections.abc import Sequence
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Palette = Literal["heat", "heights", "counts", "plants", "numbers"]
"""Colours of measured values, of heights, of how many photos see a place, of indices of vegetation,
of which photo shows it.
"""
_PLANTS = (
    (0.0, "#7a3b10"),
    (0.3, "#d9b066"),
    (0.5, "#f5f0c0"),
    (0.75, "#7fbf5a"),
    (1.0, "#0b5a2b"),
)
"""Share of the range and colour: bare ground brown, plants green."""


def _between(stops: Sequence[tuple[float, str]]) -> NDArray[np.uint8]:
    """(256, 1, 3) BGR, straight lines between colours `#rrggbb`."""
    at = np.linspace(0, 1, 256)
    shares = [share for share, _ in stops]
    bands = [
        np.interp(at, shares, [int(colour[k : k + 2], 16) for _, colour in stops])
        for k in (5, 3, 1)
    ]
    return np.rint(np.stack(bands, -1)).astype(np.uint8)[:, None]


MAPS: dict[str, Any] = {
    "heat": cv2.COLORMAP_INFERNO,
    "heights": cv2.COLORMAP_TURBO,
    "counts": cv2.COLORMAP_VIRIDIS,
    "plants": _between(_PLANTS),
}
NUMBERED = np.array(
    [[(37 * k) % 200 + 40, (91 * k + 80) % 200 + 40, (151 * k + 30) % 200 + 40] for k in range(61)],
    np.uint8,
)
"""Colours of numbers, repeated after a prime number of them."""


def coloured(
    pixels: NDArray[Any], scale: Sequence[float] | None = None, palette: Palette = "heat"
) -> NDArray[np.uint8]:
    """RGB (h, w, 3) of a map's pixels: colours as they are, measured values in the colours of a
    palette, numbers of photos in colours that differ from their neighbours'.
    """
    if palette == "numbers":
        return NUMBERED[pixels[..., 0].astype(np.int64) % len(NUMBERED)]
    if pixels.dtype == np.uint8 and (pixels.shape[2] == 3 or scale is None):
        return pixels if pixels.shape[2] == 3 else np.repeat(pixels[..., :1], 3, 2)
    values = pixels[..., 0].astype(np.float32)
    low, high = scale if scale is not None else (float(values.min()), float(values.max()))
    grey = np.clip((values - low) / max(high - low, 1e-6) * 255, 0, 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(grey, MAPS[palette])[..., ::-1])


def ramp(palette: Palette, steps: int) -> list[str]:
    """Colours of a palette from the lowest to the highest value, for legends (`#rrggbb`)."""
    grey = np.linspace(0, 255, steps).astype(np.uint8)[None]
    bgr = cv2.applyColorMap(grey, MAPS[palette])[0].tolist()
    return [f"#{r:02x}{g:02x}{b:02x}" for b, g, r in bgr]
