"""Looks through a clip: how sharp its frames are and how far the ground moved between them.

Each look costs, beside its decoding, a reduced grey picture, the finest detail of a few patches at
full size, and some 300 corners that are tracked from look to look (Lucas and Kanade 1981, in
pyramids as Bouguet 2001), to which a similarity is fitted.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.model.clip import Looks
from skyquilt.video.decoder import Decoder, Frame

Grey = NDArray[np.uint8]
_PATCHES_X, _PATCHES_Y, _PATCH = 4, 3, 192
_RENEWED = 70
_APART = 25
"""Corners are spread: where they crowd on what stands out, the rotation drifts."""
_AGREE_PX = 1.0


@dataclass(frozen=True, kw_only=True)
class Looker:
    """How a clip is looked through; part of the key of what was seen."""

    per_second: float = 5.0
    """Looks per second of the clip, at most."""
    longest: int = 640
    """Longest side in px of the pictures on which corners are tracked."""
    corners: int = 300
    """Corners that are tracked."""
    fewest: int = 12
    """Corners that must agree for a motion to count."""
    chunk: int = 300
    """Looks that are stored at once."""
    version: int = 3
    """Changes when the results do."""

    def step(self, fps: float) -> int:
        """Frames from one look to the next."""
        return max(1, round(fps / self.per_second))

    def chunks(self, fps: float, frames: int) -> int:
        """Number of chunks of a clip of so many frames."""
        return max(1, -(-max(frames, 1) // (self.step(fps) * self.chunk)))

    def __call__(
        self, decoder: Decoder, number: int, *, last: float | None, open_end: bool
    ) -> Iterator[int | Looks]:
        """Yields the number of looks done so far, then the looks of chunk `number`; `decoder` gives
        grey frames.

        `last`: time in s of the last look of the chunk before, None for the first chunk. With
        `open_end` the chunk goes on to the end of the clip, however long it is.
        """
        step = self.step(decoder.fps) / decoder.fps
        tracker = _Tracker(looker=self, size=(decoder.width, decoder.height))
        if last is not None and (found := decoder.at(last)):
            tracker.look(found[1])
        rows: list[tuple[float, float, complex, complex, bool]] = []
        at, end = number * self.chunk, (number + 1) * self.chunk
        seen = -1.0 if last is None else last
        while at < end or open_end:
            found = decoder.at(at * step)
            if found is None:
                break
            time, pixels = found
            at += 1
            if time <= seen:
                continue
            if time > at * step:  # a gap between frames: on with the grid behind it
                at = int(np.ceil(time / step - 1e-6)) + 1
            seen = time
            rows.append((time, sharpness(pixels), *tracker.look(pixels)))
            yield len(rows)
        columns = list(zip(*rows, strict=True)) if rows else [()] * 5
        kinds = (np.float64, np.float64, np.complex128, np.complex128, np.bool_)
        named = zip(("time_s", "sharp", "turn", "shift", "linked"), columns, kinds, strict=True)
        yield Looks(**{name: np.array(values, kind) for name, values, kind in named})


def joined(parts: list[Looks]) -> Looks:
    """Looks of consecutive chunks."""
    names = ("time_s", "sharp", "turn", "shift", "linked")
    return Looks(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})


def sharpness(pixels: Frame) -> float:
    """Logarithm of the variance of second differences at half size over those at an eighth, along
    the axis on which it is less.

    Of a blurred picture fine detail is gone before coarse detail. The ratio depends much less on
    what is seen than the detail itself, and the lesser of both axes shows a blur of any direction;
    at full size there are the artefacts of compression. Measured on patches spread over the frame.
    """
    height, width = pixels.shape[:2]
    size = min(_PATCH, height // _PATCHES_Y, width // _PATCHES_X) // 8 * 8
    fine, coarse = np.zeros(2), np.zeros(2)
    for y in np.linspace(0, height - size, _PATCHES_Y).astype(int):
        for x in np.linspace(0, width - size, _PATCHES_X).astype(int):
            grey = pixels[y : y + size, x : x + size]
            half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            fine += _second(half)
            coarse += _second(
                cv2.resize(half, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
            )
    return float(np.log((fine + 1e-3) / (coarse + 1e-3)).min())


def _second(grey: NDArray[Any]) -> NDArray[np.float64]:
    """Mean squares of second differences along x and y, without the noise of 8-bit values."""
    plain = grey.astype(np.float32)
    along = plain[:, 2:] - 2 * plain[:, 1:-1] + plain[:, :-2]
    across = plain[2:] - 2 * plain[1:-1] + plain[:-2]
    return np.array([float(np.mean(along**2)), float(np.mean(across**2))])


@dataclass(kw_only=True)
class _Tracker:
    """Follows corners from look to look."""

    looker: Looker
    size: tuple[int, int]
    _grey: Grey | None = None
    _points: NDArray[np.float32] | None = None

    def look(self, pixels: Frame) -> tuple[complex, complex, bool]:
        """Turn and shift to the look before, and whether they could be measured."""
        shrink = max(1, round(max(self.size) / self.looker.longest))
        height, width = (n // shrink * shrink for n in pixels.shape[:2])
        small = cv2.resize(
            pixels[:height, :width],
            (width // shrink, height // shrink),
            interpolation=cv2.INTER_AREA,
        )
        grey: Grey = np.asarray(small, dtype=np.uint8)
        found = self._follow(grey)
        self._grey = grey
        if found is None or self._points is None or len(self._points) < _RENEWED:
            self._points = self._corners(grey)
        if found is None:
            return 1.0 + 0j, 0j, False
        turn, move = found
        middle = complex(grey.shape[1] - 1, grey.shape[0] - 1) / 2
        return turn, (turn * middle + move - middle) * shrink, True

    def _corners(self, grey: Grey) -> NDArray[np.float32] | None:
        found = cv2.goodFeaturesToTrack(grey, self.looker.corners, 0.003, _APART)
        return None if found is None else np.asarray(found, np.float32).reshape(-1, 2)

    def _follow(self, grey: Grey) -> tuple[complex, complex] | None:
        """Similarity from this look to the one before, as complex factor and summand in px of the
        reduced pictures.
        """
        old, points = self._grey, self._points
        if old is None or points is None or len(points) < self.looker.fewest:
            return None
        moved, good, _ = cv2.calcOpticalFlowPyrLK(
            old, grey, points, points.copy(), winSize=(15, 15), maxLevel=5
        )
        new, kept = np.asarray(moved, np.float32).reshape(-1, 2), good.ravel() == 1
        inside = ((new >= 0) & (new < (grey.shape[1], grey.shape[0]))).all(axis=1)
        kept &= inside
        self._points = None
        if kept.sum() < self.looker.fewest:
            return None
        matrix, agree = cv2.estimateAffinePartial2D(
            new[kept],
            points[kept],
            method=cv2.RANSAC,
            ransacReprojThreshold=_AGREE_PX,
            maxIters=500,
        )
        if matrix is None or agree.sum() < max(self.looker.fewest, 0.4 * kept.sum()):
            return None
        self._points = np.ascontiguousarray(new[kept][agree.ravel() == 1])
        return complex(matrix[0, 0], matrix[1, 0]), complex(matrix[0, 2], matrix[1, 2])
