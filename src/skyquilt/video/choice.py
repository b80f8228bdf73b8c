"""Chooses frames of a clip by overlap, sharpness and motion."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.model.clip import ChosenFrame, ChosenFrames, Clip, Looks

Array = NDArray[np.float64]
STILL_PX = 1.0
"""Motion between two looks, in px of the clip at a width of 1000 px, that counts as none."""


@dataclass(frozen=True, kw_only=True)
class FrameChoice:
    """Frames that overlap as wanted: of those that come into question, the sharpest.

    Going along the looks, the overlap with the chosen frame before shrinks from 1. Frames come into
    question from an advance of `earliest` of the wanted one on, up to the wanted one; where all of
    these are blurred, up to `latest` of it. Blurred is what lies `blur` below the median of the
    `around` looks before and after, which allows for ground with more or less detail.
    """

    overlap: float = 0.78
    """Wanted share of a frame that the frame before shows too."""
    earliest: float = 0.72
    """As share of the wanted advance."""
    latest: float = 1.35
    """As share of the wanted advance."""
    blur: float = 0.3
    """Logarithm of the sharpness."""
    around: int = 50
    """Looks on each side."""
    version: int = 1
    """Changes when the results do."""

    def __call__(self, clip: Clip, looks: Looks) -> ChosenFrames:
        """The chosen frames of a clip."""
        sharp = relative_sharpness(looks, self.around)
        size = (clip.width, clip.height)
        chosen: list[ChosenFrame] = []
        for run in _runs(looks):
            found = self._run(run, looks, sharp, size)
            if chosen and found:
                found[0] = _renamed(found[0], "cut")
            chosen += found
        moved = np.abs(looks.shift) * 1000 / max(size)
        turned = np.abs(looks.turn - 1) * 500
        still = looks.linked & (np.maximum(moved, turned) < STILL_PX)
        return ChosenFrames(
            clip=clip.name,
            fps=clip.fps,
            looked=len(looks.time_s),
            chosen=tuple(chosen),
            blurred=int((sharp < -self.blur).sum()),
            still=int(still.sum()),
            overlap=self.overlap,
            focal=clip.focal,
            shutter=clip.shutter,
        )

    def _run(
        self, run: range, looks: Looks, sharp: Array, size: tuple[int, int]
    ) -> list[ChosenFrame]:
        """Frames of an unbroken run of looks."""
        if not len(run):
            return []
        step = 1 - self.overlap
        start = self._first(run, looks, sharp, size)
        chosen = [_frame(looks, start, np.nan, sharp, "first")]
        while True:
            advance = self._advances(start, run, looks, size)
            begun = np.flatnonzero(advance >= self.earliest * step)
            if not len(begun):
                break
            past = np.flatnonzero(advance > step)
            # at least one frame comes into question, however far the flight went between two looks
            end = max(int(past[0]) if len(past) else len(advance), int(begun[0]) + 1)
            window = np.arange(begun[0], end)
            if (sharp[start + 1 + window] < -self.blur).all():
                far = np.flatnonzero(advance > self.latest * step)
                window = np.arange(begun[0], max(int(far[0]) if len(far) else len(advance), end))
            # of equally sharp frames the furthest; a frame is not worth less overlap for nothing
            worth = np.minimum(sharp[start + 1 + window], 0.0) + 0.1 * np.minimum(
                advance[window] / step, 1.0
            )
            best = int(window[np.argmax(worth)])
            reason = "overlap" if best == window[-1] else "sharpest"
            start = start + 1 + best
            chosen.append(_frame(looks, start, 1 - float(advance[best]), sharp, reason))
        return self._last(chosen, start, run, looks, sharp, size)

    def _first(self, run: range, looks: Looks, sharp: Array, size: tuple[int, int]) -> int:
        """The first look of a run, or a sharper one that shows nearly the same."""
        advance = self._advances(run[0], run, looks, size)
        near = 1 + int((np.cumsum(advance > 0.3 * (1 - self.overlap)) == 0).sum())
        here = sharp[run[0] : run[0] + near]
        good = np.flatnonzero(here >= -self.blur)
        return run[0] + int(good[0] if len(good) else np.argmax(here))

    def _last(
        self,
        chosen: list[ChosenFrame],
        start: int,
        run: range,
        looks: Looks,
        sharp: Array,
        size: tuple[int, int],
    ) -> list[ChosenFrame]:
        """The end of a run shows ground that no chosen frame shows: its last sharp look is added,
        if that is worth a frame.
        """
        advance = self._advances(start, run, looks, size)
        worth = np.flatnonzero(
            (advance > 0.35 * (1 - self.overlap)) & (sharp[start + 1 : run.stop] >= -self.blur)
        )
        if len(worth) and len(chosen) > 0:
            best = int(worth[-1])
            chosen.append(_frame(looks, start + 1 + best, 1 - float(advance[best]), sharp, "last"))
        return chosen

    def _advances(
        self, start: int, run: range, looks: Looks, size: tuple[int, int]
    ) -> NDArray[np.float64]:
        """1 - overlap with look `start` of the looks after it, up to where it is far past what is
        wanted, or the run ends.
        """
        turn, shift, out = 1 + 0j, 0j, []
        for i in range(start + 1, run.stop):
            shift += turn * looks.shift[i]
            turn *= looks.turn[i]
            out.append(1 - shared(turn, shift, size))
            if out[-1] > 1.5 * self.latest * (1 - self.overlap) + 0.02:
                break
        return np.array(out)


def shared(turn: complex, shift: complex, size: tuple[int, int]) -> float:
    """Share of a frame that another one covers, which is turned and scaled by `turn` about its
    middle and moved by `shift` in px; of the smaller of both.
    """
    w, h = size
    corners = np.array([complex(-w, -h), complex(w, -h), complex(w, h), complex(-w, h)]) / 2
    other = corners * turn + shift
    area, _ = cv2.intersectConvexConvex(_points(corners), _points(other))
    return float(area) / (w * h * min(1.0, abs(turn) ** 2))


def _points(corners: NDArray[Any]) -> NDArray[np.float32]:
    z = np.asarray(corners)
    return np.stack([z.real, z.imag], axis=1).astype(np.float32)


def relative_sharpness(looks: Looks, around: int) -> Array:
    """Sharpness (n,) of looks against the median of those around each."""
    n = len(looks.sharp)
    middle = [np.median(looks.sharp[max(0, i - around) : i + around + 1]) for i in range(n)]
    return np.asarray(looks.sharp - np.array(middle).reshape(-1))


def _runs(looks: Looks) -> list[range]:
    """Runs of looks whose motion is known; those of one look without neighbours are left out where
    there are others.
    """
    n = len(looks.time_s)
    starts = [i for i in range(n) if i == 0 or not looks.linked[i]]
    runs = [range(a, b) for a, b in zip(starts, [*starts[1:], n], strict=True)]
    long_ = [r for r in runs if len(r) > 1]
    return long_ or runs[:1]


def _frame(looks: Looks, at: int, overlap: float, sharp: Array, reason: str) -> ChosenFrame:
    return ChosenFrame(
        look=at,
        time_s=float(looks.time_s[at]),
        overlap=overlap,
        sharp=float(sharp[at]),
        reason=reason,
    )


def _renamed(frame: ChosenFrame, reason: str) -> ChosenFrame:
    return ChosenFrame(
        look=frame.look,
        time_s=frame.time_s,
        overlap=frame.overlap,
        sharp=frame.sharp,
        reason=reason,
    )
