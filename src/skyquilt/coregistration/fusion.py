"""Fusion of two registered images for display: 8-bit RGB on a's grid.

All take a and b on the same grid, grey (H, W) uint8, and `seen` (H, W), where b has valid pixels.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Rgb = NDArray[np.uint8]
Mask = NDArray[np.bool_]
_COLOURS = cv2.COLORMAP_INFERNO
_GAP = 8
_LINE = (64, 200, 255)


def shown(values: NDArray[Any], valid: Mask) -> Grey:
    """Grey levels of any image: stretched between its 1st and 99th percentile; 0 where invalid."""
    band = (
        values if values.ndim == 2 else cv2.cvtColor(values.astype(np.float32), cv2.COLOR_RGB2GRAY)
    )
    band = np.where(valid, band, np.nan).astype(np.float32)
    inside = band[np.isfinite(band)]
    if not inside.size:
        return np.zeros(band.shape, np.uint8)
    low, high = np.percentile(inside, [1, 99])
    return np.asarray(
        np.clip(np.nan_to_num((band - low) / max(float(high - low), 1e-6) * 255), 0, 255).astype(
            np.uint8
        )
    )


def false_colour(a: Grey, b: Grey, seen: Mask) -> Rgb:
    """a in green, b in red and blue: grey where both are equal, coloured fringes where edges do not
    coincide.
    """
    other = np.where(seen, b, 0).astype(np.uint8)
    return np.dstack([other, a, other])


def alpha(a: Grey, b: Grey, seen: Mask, weight: float = 0.5) -> Rgb:
    """b in warm colours over a; `weight` is b's share."""
    colours = cv2.cvtColor(cv2.applyColorMap(b, _COLOURS), cv2.COLOR_BGR2RGB).astype(np.float32)
    base = np.repeat(a[..., None], 3, 2).astype(np.float32)
    share = np.where(seen, weight, 0)[..., None]
    return np.asarray(np.rint(base * (1 - share) + colours * share).astype(np.uint8))


def error_colours(a: Grey, bound: NDArray[Any], tolerance: float) -> Rgb:
    """a, tinted by a bound of the error (H, W) from blue (0) over white (half the tolerance) to red
    (the tolerance and more); grey where the bound is NaN. Lines follow steps of a quarter of the
    tolerance.
    """
    level = np.clip(np.nan_to_num(bound / tolerance), 0, 1)[..., None]
    cold, warm = np.array([40, 80, 220.0]), np.array([220, 40, 40.0])
    low, high = np.minimum(2 * level, 1), np.maximum(2 * level - 1, 0)
    colour = (cold * (1 - low) + 255 * low) * (1 - high) + warm * high
    base = np.repeat(a[..., None], 3, 2).astype(np.float32)
    known = np.isfinite(bound)
    out = np.where(known[..., None], 0.55 * base + 0.45 * colour, base)
    steps = np.floor(4 * np.nan_to_num(bound / tolerance, nan=-1.0))
    line = np.zeros(a.shape, bool)
    line[:, 1:] |= steps[:, 1:] != steps[:, :-1]
    line[1:] |= steps[1:] != steps[:-1]
    out[line & known] = 20
    return np.asarray(np.rint(out).astype(np.uint8))


def checkerboard(a: Grey, b: Grey, seen: Mask, squares: int = 8) -> Rgb:
    """a and b in alternating squares; `squares`: their number along the longer side. Structures
    continue across the squares if the registration is right.
    """
    side = max(1, -(-max(a.shape) // squares))
    rows, columns = np.indices(a.shape)
    turn = ((rows // side + columns // side) % 2 == 1) & seen
    return np.repeat(np.where(turn, b, a)[..., None], 3, 2)


def side_by_side(a: Grey, b: Grey, px_a: NDArray[Any], px_b: NDArray[Any], most: int = 60) -> Rgb:
    """Both images unchanged, with inliers (n, 2) joined by lines; at most `most` of them, evenly
    chosen.
    """
    canvas = np.full(
        (max(a.shape[0], b.shape[0]), a.shape[1] + _GAP + b.shape[1], 3), 255, np.uint8
    )
    canvas[: a.shape[0], : a.shape[1]] = a[..., None]
    canvas[: b.shape[0], a.shape[1] + _GAP :] = b[..., None]
    chosen = np.unique(np.linspace(0, max(len(px_a) - 1, 0), min(most, len(px_a))).astype(int))
    for p, q in zip(px_a[chosen], px_b[chosen], strict=True):
        ends = [(round(float(p[0])), round(float(p[1])))]
        ends.append((round(float(q[0])) + a.shape[1] + _GAP, round(float(q[1]))))
        cv2.line(canvas, ends[0], ends[1], _LINE, 1, cv2.LINE_AA)
        for end in ends:
            cv2.circle(canvas, end, 3, _LINE, 1, cv2.LINE_AA)
    return canvas
