"""Faults of a thermal camera's detector: pixels that are dead, stuck or hot, and columns and rows
that are warmer or colder than they ought to be. They stay at their places of the picture while the
ground moves on, so the frames of a flight tell them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.store import digest
from skyquilt.errors import UnreadablePhotoError
from skyquilt.model.photo import DetectorFaults, Photo, evenly

Values = NDArray[np.float32]
Mask = NDArray[np.bool_]
_NEAR = 5
"""Side in px of the neighbourhood with whose median a pixel is compared."""
_SLOW = 6.0
"""Standard deviation in px of the smoothing that leaves no errors of single lines."""
_TINY = 1e-6
_BESIDE = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, kw_only=True)
class FindFaults:
    """Looks for faults in some frames of a camera. What both halves of the flight show counts, so
    that the ground does not; frames that show the same ground at the same place count once.
    """

    looked_at: int = 16
    """Frames looked at, spread evenly over the flight."""
    fewest: int = 6
    """Fewest of them, of different ground."""
    same_view: float = 0.5
    """Correlation of two frames, without fine detail and slow changes, from which they show the
    same ground at the same place.
    """
    outlying: float = 6.0
    """Standard deviations of the other pixels by which a bad one differs in either half."""
    stuck: float = 0.1
    """Share of its neighbours' changes from frame to frame below which a pixel is stuck."""
    lasting: float = 0.9
    """Share of frames in which a stuck pixel must keep its value, and another bad one must differ
    to the same side, by a third of `outlying` at least: of few frames, half may be alike, or nearly
    all differ to one side, by chance.
    """
    apart: float = 0.75
    """Share of frames in which a stuck pixel differs from its neighbours by so much."""
    rounds: int = 3
    """Rounds of the search: where bad lines cross, most neighbours are bad, too."""
    most: float = 0.05
    """Largest share of bad pixels: more are no faults of single ones."""
    thick: int = 4
    """Side in px of squares of bad pixels that are no single ones: text and logos are marks
    (`matching.fixed_marks`), and areas without measurements stay so.
    """
    bands: int = 8
    """Parts of a column's length, each of which must show that it differs: what lies along columns
    on the ground is hardly ever quite straight in the picture.
    """
    alike: float = 0.5
    """Least correlation of what these parts and both halves of the flight show."""
    smooth: float = 0.5
    """Correlation of neighbouring columns from which they show ground: the lens blurs it over more
    than one pixel, while each column of a detector has an error of its own.
    """
    version: ClassVar[int] = 2

    def __call__(self, frames: Sequence[Values]) -> DetectorFaults | None:
        """The faults of one camera; None where there are none or frames do not tell.

        `frames`: (h, w) in their unit, NaN where there is no measurement, in order of capture.
        """
        kept = self._different(frames)
        if len(kept) < self.fewest:
            return None
        bad = self._bad(kept)
        mended = [filled(f, bad) for f in kept]
        columns = self._lines(mended)
        rows = self._lines([np.ascontiguousarray((f - columns).T) for f in mended])
        if not (bad.any() or columns.any() or rows.any()):
            return None
        return DetectorFaults(
            bad=np.flatnonzero(bad).astype(np.int32),
            columns=columns,
            rows=rows,
            key=digest(np.packbits(bad), columns, rows),
        )

    def _different(self, frames: Sequence[Values]) -> list[Values]:
        """Frames that do not show the same ground at the same place."""
        kept, seen = list[Values](), list[NDArray[np.float32]]()
        for frame in frames:
            # without lines and single pixels, which are what is looked for
            grey = cv2.medianBlur(_whole(frame), _NEAR)
            grey = np.clip(grey, *np.percentile(grey, [1, 99]).tolist()).astype(np.float32)
            view = cv2.GaussianBlur(grey, (0, 0), 4) - cv2.GaussianBlur(grey, (0, 0), 16)
            view = view / max(float(np.linalg.norm(view)), _TINY)
            if all(float(np.vdot(view, s)) < self.same_view for s in seen):
                kept.append(frame)
                seen.append(view)
        return kept

    def _bad(self, frames: Sequence[Values]) -> Mask:
        """(h, w) pixels that are no measurements."""
        whole = np.stack([_whole(f) for f in frames])
        void = np.asarray(np.isnan(np.stack(frames)).mean(0) > 0.5)
        bad = void
        for _ in range(self.rounds):
            before, bad = bad, void | self._beside(whole, bad)
            if np.array_equal(before, bad):
                break
        bad = thin(bad, self.thick)
        return bad if bad.mean() <= self.most else np.zeros_like(bad)

    def _beside(self, whole: NDArray[np.float32], bad: Mask) -> Mask:
        """Pixels (h, w) that look bad beside the others, without those taken for bad so far."""
        mended = np.stack([_whole(filled(f, bad)) for f in whole])
        off = whole - np.stack([cv2.medianBlur(f, _NEAR) for f in mended])
        half = len(whole) // 2
        scales = _scale(np.median(off[:half], 0)), _scale(np.median(off[half:], 0))
        outlying = self._outlying(off, scales)
        changes = _spread(mended - np.median(mended, (1, 2), keepdims=True))
        around = cv2.medianBlur(changes, _NEAR)
        # a stuck pixel keeps its value whatever its neighbours do, and seldom has theirs: those of
        # a saturated picture keep theirs, too
        apart = (np.abs(off) > self.stuck * around).mean(0) >= self.apart
        moved = np.abs(whole - np.median(whole, 0))
        still = np.quantile(moved, self.lasting, axis=0, method="lower") < self.stuck * around
        stuck = still & apart
        # bad ones beside it may have made a good one an outlier: good ones alone are to say so
        mended = np.stack([filled(f, bad | stuck | outlying) for f in whole])
        alone = self._outlying(np.where(np.isnan(mended), off, whole - mended), scales)
        return np.asarray(stuck | (outlying & alone))

    def _outlying(self, off: NDArray[np.float32], scales: tuple[float, float]) -> Mask:
        """(h, w) which pixels are off (n, h, w) their neighbours to the same side in nearly all
        frames, and far off in either half; `scales`: the standard deviation of all in each half.
        """
        half = len(off) // 2
        first, second = np.median(off[:half], 0), np.median(off[half:], 0)
        least = [self.outlying * s for s in scales]
        far = [np.abs(o) > x for o, x in zip((first, second), least, strict=True)]
        some = np.where(np.arange(len(off)) < half, *least)[:, None, None] / 3
        same = np.maximum((off > some).mean(0), (off < -some).mean(0)) >= self.lasting
        return np.asarray((first * second > 0) & far[0] & far[1] & same)

    def _lines(self, frames: Sequence[Values]) -> NDArray[np.float32]:
        """(w,) what is to be taken off each column; 0 where they do not differ for certain."""
        width = frames[0].shape[1]
        high = []
        for frame in frames:
            grey = _whole(frame)
            high.append(grey - cv2.GaussianBlur(grey, (0, 0), sigmaX=_SLOW, sigmaY=0.01))
        stack, half = np.stack(high), len(frames) // 2
        parts = [
            np.median(part, (0, 1))
            for frames_ in (stack[:half], stack[half:])
            for part in np.array_split(frames_, self.bands, axis=1)
        ]
        parts = [p - np.median(p) for p in parts]
        if min(float(np.ptp(p)) for p in parts) < _TINY:
            return np.zeros(width, np.float32)
        if np.corrcoef(parts).min() < self.alike:
            return np.zeros(width, np.float32)
        found = np.median(parts, 0)
        if np.corrcoef(found[1:], found[:-1])[0, 1] > self.smooth:
            return np.zeros(width, np.float32)
        # slow changes are the ground's, or those of a pattern (`ortho.frame_pattern`)
        return np.asarray(found - cv2.GaussianBlur(found[None], (0, 0), _SLOW)[0], np.float32)


def _scale(off: NDArray[Any]) -> float:
    """Robust standard deviation."""
    return max(1.4826 * float(np.median(np.abs(off - np.median(off)))), _TINY)


def _spread(stack: NDArray[Any]) -> NDArray[np.float32]:
    """(h, w) median deviation from the median over frames (n, h, w)."""
    return np.asarray(np.median(np.abs(stack - np.median(stack, 0)), 0), np.float32)


def _whole(frame: Values) -> Values:
    """A frame whose gaps hold its median."""
    gaps = ~np.isfinite(frame)
    if not gaps.any():
        return np.ascontiguousarray(frame, np.float32)
    middle = float(np.median(frame[~gaps])) if not gaps.all() else 0.0
    return np.where(gaps, np.float32(middle), frame).astype(np.float32)


def thin(bad: Mask, side: int) -> Mask:
    """What of a mask (h, w) is single pixels and lines: no areas that contain squares of `side`."""
    square = np.ones((side, side), np.uint8)
    thick = cv2.dilate(cv2.morphologyEx(bad.astype(np.uint8), cv2.MORPH_OPEN, square), _BESIDE)
    return np.asarray(bad & (thick == 0))


def filled(frame: Values, bad: Mask) -> Values:
    """The frame (h, w) with bad pixels (h, w) as weighted means of the good ones around them."""
    if not bad.any():
        return frame
    good = (~bad & np.isfinite(frame)).astype(np.float32)
    kernel = (2 * _NEAR + 1, 2 * _NEAR + 1)
    weight = cv2.GaussianBlur(good, kernel, 1.0)
    level = float(np.median(frame[good > 0])) if good.any() else 0.0  # keeps the sums exact
    total = cv2.GaussianBlur(np.where(good > 0, frame - level, 0).astype(np.float32), kernel, 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        around = np.where(weight > 1e-3, total / weight + level, np.nan)
    return np.where(bad, around, frame).astype(np.float32)


def repaired(frame: Values, faults: DetectorFaults) -> Values:
    """A frame (h, w) as its detector would have measured it without its faults."""
    bad = np.zeros(frame.size, bool)
    bad[faults.bad] = True
    return filled(frame, bad.reshape(frame.shape)) - faults.columns - faults.rows[:, None]


@dataclass(frozen=True, kw_only=True)
class Repair:
    """Tells photos the faults of their cameras' detectors."""

    find: FindFaults = field(default_factory=FindFaults)
    """The search."""

    def __call__(
        self, photos: Sequence[Photo], read: Callable[[Photo], Values]
    ) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
        """The photos (in order of capture), radiometric ones with their detectors' faults, and a
        sentence on each camera that has some; `read` decodes a frame.
        """
        kinds: dict[tuple[str, int, int, str], list[Photo]] = {}
        for p in photos:
            if p.unit and p.frame_s is None:
                kinds.setdefault(_kind(p), []).append(p)
        known, notes = dict[tuple[str, int, int, str], DetectorFaults](), list[str]()
        for kind, own in kinds.items():
            if len(own) < self.find.fewest:
                continue
            frames = []
            for k in evenly(len(own), self.find.looked_at):
                try:
                    frames.append(read(own[k]))
                except UnreadablePhotoError:  # it is left out by name when features are sought
                    continue
            faults = self.find(frames)
            if faults is not None:
                known[kind] = faults
                notes.append(_sentence(own[0], faults))
        if not known:
            return tuple(photos), ()
        told = [replace(p, faults=known.get(_kind(p)) if p.unit else None) for p in photos]
        return tuple(told), tuple(notes)


def _kind(photo: Photo) -> tuple[str, int, int, str]:
    return photo.camera_key, photo.width, photo.height, photo.unit


def _sentence(photo: Photo, faults: DetectorFaults) -> str:
    unit = "K" if photo.unit == "celsius" else "counts"
    told = []
    if len(faults.bad):
        share = 100 * len(faults.bad) / (photo.width * photo.height)
        told.append(
            f"{len(faults.bad)} pixels of its detector ({share:.2g} %) are dead, stuck or far off;"
            " their values are taken from the pixels around them"
        )
    for what, lines in (("columns", faults.columns), ("rows", faults.rows)):
        if lines.any():
            told.append(
                f"{what} of it are off by up to {float(np.abs(lines).max()):.2g} {unit}, which is"
                " taken off"
            )
    return f"Thermal camera {photo.camera_key}: {'; '.join(told)}."
