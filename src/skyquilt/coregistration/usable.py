"""The part of an image that can be registered, and whether it is sufficient."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.blank import rim_labels
from skyquilt.model.registration import Picture, RefusedRegistration
from skyquilt.photos.detector_faults import thin

SHORTEST = 48
"""Least size in px of the shorter side; in smaller images no patch could confirm a registration."""
NEAR_END = 4
"""Largest deviation of a frame from its colour after JPEG compression, in 8-bit levels."""
PLAIN = 64.0
"""Range between the 1st and 99th percentile (8-bit levels) below which less deviation is allowed: a
hot object leaves a few levels for all the rest, and the darkest of them are no frame.
"""
LEAST_FRAME = 0.002
"""Least share of the image covered by a frame; smaller dark spots at the border belong to the
image.
"""
LEAST_BAR = 0.01
"""Least width of a bar, as a share of the image's side; a narrower one hides nothing."""
LEAST_VALID = 0.1
"""Least share of the image that must be valid."""
LEAST_RANGE = 3.0
"""Least range between the 1st and 99th percentile for an image to have contrast (8-bit levels;
counts for 16 bits).
"""
SPECK = 5
"""Side in px of the neighbourhood with whose median a pixel is compared."""
FAR = 1.0
"""How far from it, as a share of the range between the 5th and 95th percentile, a pixel of a
measuring camera is that its detector has wrong (dead, hot).
"""
THICK = 4
"""Side in px of squares without measurements that are no faults of single pixels and lines."""
LARGEST = 1e6
"""Largest value as it is: sums over patches of squares of larger ones may exceed single precision.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Usable:
    """An image as one band of real numbers."""

    grey: NDArray[np.float32]
    """(H, W), no gaps: where nothing was measured, the nearest value that was."""
    valid: NDArray[np.bool_]
    """(H, W) valid pixels."""
    reason: str = ""
    """Why it cannot be registered; empty if it can."""

    def __bool__(self) -> bool:
        return not self.reason


def usable(picture: Picture) -> Usable:
    """Brightness and valid part of an image. A black or white frame, as in rotated images, and bars
    of any one colour, as of screens, are excluded: their edges would be matched as structure, and
    a frame's shape would reveal the rotation.
    """
    band = one_band(picture.values)
    finite = np.isfinite(band)
    given = finite if picture.valid is None else finite & picture.valid
    grey = _in_reach(filled(np.where(finite, band, 0).astype(np.float32), given))
    if picture.values.dtype != np.uint8 and given.any():
        grey = filled(grey, ~_specks(grey, given))
        given = given | thin(~finite, THICK)
    slack = _slack(grey[given]) if picture.values.dtype == np.uint8 and given.any() else 0.0
    valid = given & ~_bars(grey, slack) & ~_frame(grey, given, slack)
    return Usable(grey=grey, valid=valid, reason=_reason(grey, valid))


def one_band(values: NDArray[Any]) -> NDArray[np.float32]:
    """(H, W) brightness of values (H, W) or (H, W, bands)."""
    if values.ndim == 2:
        return values.astype(np.float32)
    if values.shape[2] == 3:
        return np.asarray(cv2.cvtColor(values.astype(np.float32), cv2.COLOR_RGB2GRAY))
    return np.asarray(values.mean(2, dtype=np.float32))


def filled(grey: NDArray[np.float32], given: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The image (H, W) with the nearest given value wherever none is given (0 if none is at all).
    What stands there in a file may be anything (-9999, -3.4e38), and would be mixed into its
    neighbours when the image is reduced and smoothed.
    """
    if given.all():
        return grey
    if not given.any():
        return np.zeros_like(grey)
    _, label = cv2.distanceTransformWithLabels(
        (~given).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    values = np.zeros(label.max() + 1, np.float32)
    values[label[given]] = grey[given]  # each given pixel has a label of its own
    return np.asarray(values[label])


def _in_reach(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    """Values that are too large in another unit; no registration depends on that."""
    largest = max(abs(float(grey.max())), abs(float(grey.min())))
    return grey if largest <= LARGEST else grey * np.float32(LARGEST / largest)


def _specks(grey: NDArray[np.float32], given: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Single pixels and lines far from all around them. A few of these in a thousand have most of
    the contrast of a picture, and would hide what it shows.
    """
    low, high = np.percentile(grey[given], [5, 95])
    off = np.abs(grey - cv2.medianBlur(grey, SPECK))
    return np.asarray(off > FAR * max(float(high - low), 1e-6))


def _slack(values: NDArray[np.float32]) -> float:
    low, high = np.percentile(values, [1, 99])
    return NEAR_END * min(1.0, float(high - low) / PLAIN)


def _bars(grey: NDArray[np.float32], slack: float) -> NDArray[np.bool_]:
    """Whole rows, then whole columns between them, along the border that have one colour."""
    bars = np.zeros(grey.shape, bool)
    top, below = _ends(grey, slack)
    bars[:top] = bars[below:] = True
    if top < below:
        left, right = _ends(grey[top:below].T, slack)
        bars[:, :left] = bars[:, right:] = True
    return bars


def _ends(rows: NDArray[np.float32], slack: float) -> tuple[int, int]:
    """First row (of n, m) beyond a bar, and the end of the last one before another."""

    def count(ordered: NDArray[np.float32]) -> int:
        same = np.ptp(ordered, axis=1) <= slack
        same &= np.abs(ordered[:, 0] - ordered[0, 0]) <= slack
        wide = int(np.argmin(np.r_[same, False]))
        return wide if wide > LEAST_BAR * len(ordered) else 0

    first = count(rows)
    return first, max(len(rows) - count(rows[::-1]), first)


def _frame(grey: NDArray[np.float32], given: NDArray[np.bool_], slack: float) -> NDArray[np.bool_]:
    """Regions with the darkest or brightest value that touch the border of the given pixels."""
    frame = np.zeros(grey.shape, bool)
    if not given.any():
        return frame
    low, high = float(grey[given].min()), float(grey[given].max())
    for end in ((grey <= low + slack) & given, (grey >= high - slack) & given):
        _count, label, stats, _ = cv2.connectedComponentsWithStats(
            end.astype(np.uint8), connectivity=4
        )
        for region in rim_labels(label):
            if stats[region, cv2.CC_STAT_AREA] > LEAST_FRAME * grey.size:
                frame |= label == region
    return frame


def _reason(grey: NDArray[np.float32], valid: NDArray[np.bool_]) -> str:
    height, width = grey.shape
    if min(height, width) < SHORTEST:
        return f"has only {width} x {height} px, and {SHORTEST} per side are needed"
    share = float(valid.mean())
    if share < LEAST_VALID:
        return (
            f"is blank or saturated: {1 - share:.0%} of it is black, white or without data,"
            f" and {LEAST_VALID:.0%} must be valid"
        )
    low, high = np.percentile(grey[valid], [1, 99])
    if high - low < LEAST_RANGE * _unit(grey):
        return f"has no contrast: 98 % of its values lie between {low:g} and {high:g}"
    return ""


def _unit(grey: NDArray[np.float32]) -> float:
    """1 for levels and counts; 0.05 for measured values with finer steps, such as degrees."""
    return 1.0 if np.array_equal(grey[::7, ::7], np.rint(grey[::7, ::7])) else 0.05


def both_usable(a: Picture, b: Picture) -> tuple[Usable, Usable] | RefusedRegistration:
    """Both images, or the refusal of the first that cannot be used."""
    pair = usable(a), usable(b)
    for name, one in zip("AB", pair, strict=True):
        if not one:
            return RefusedRegistration(reason=f"picture {name} {one.reason}")
    return pair
