"""How the clocks of a clip and of its positions differ, found from the flight itself.

The pictures tell how the ground moved below the camera, up to a rotation and a scale; the positions
tell how the drone moved. Both agree at the right offset only, if the flight turns or changes speed.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.clip import Looks, Track
from skyquilt.video.positions import METRES_PER_DEGREE, places_at

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True, kw_only=True)
class Offset:
    """What was found."""

    seconds: float
    """To add to the clip's time to get the time of its positions."""
    sigma_s: float
    """Its standard deviation."""
    clear: bool
    """Whether the flight determines it."""
    misfit: float
    """Share of the positions' motion that the pictures do not explain, 0 to 1."""
    speed_ms: float
    """Root mean square speed of the positions there; what hovers cannot be compared."""


@dataclass(frozen=True, kw_only=True)
class OffsetSearch:
    """Compares displacements over a few seconds at all offsets.

    At each offset the displacements of the track, as complex numbers, are fitted by those of the
    pictures times one complex factor (rotation and scale), and by those of a point fixed to the
    drone: the middle of a picture is not the point below the drone where the camera is tilted. The
    share of the track's motion that is left, with n independent displacements, gives n ln(share)
    as twice the negative logarithm of the likelihood.
    """

    grid_s: float = 0.2
    """Step of the search."""
    half_s: float = 3.0
    """Displacements are taken from so long before to so long after."""
    wide_s: float = 8.0
    """The same for the last step, around the best offset: over a whole turn the drone is displaced
    by more, and its receiver errs by no more. At most a sixth of the clip.
    """
    inside: float = 0.6
    """Share of the clip that positions must cover."""
    apart_s: float = 2.0
    """Offsets further apart than this are different answers."""
    certain: float = 18.0
    """Least difference of twice the log-likelihood to any different answer."""
    version: int = 2
    """Changes when the results do."""

    def __call__(self, looks: Looks, track: Track, zero_s: float, reach_s: float) -> Offset | None:
        """The offset within `reach_s` of `zero_s` (track time at which the clip begins); None where
        too little moves or overlaps.
        """
        last_look = float(looks.time_s[-1])
        first = max(zero_s - reach_s, float(track.height_time_s[0]) - last_look)
        last = min(zero_s + reach_s, float(track.height_time_s[-1]))
        if last < first:
            return None
        # the grid holds the offset 0
        steps = np.arange(
            np.ceil((first - zero_s) / self.grid_s), np.floor((last - zero_s) / self.grid_s) + 1
        )
        near = self._compared(looks, track, zero_s, steps, self.half_s)
        if near is None:
            return None
        found = self._judged(near)
        around = steps[np.abs(steps * self.grid_s - found.seconds) <= self.apart_s / 2]
        half = min(self.wide_s, last_look / 6)
        wide = (
            self._compared(looks, track, zero_s, around, half)
            if found.clear and half > self.half_s
            else None
        )
        if wide is None:
            return found
        best = int(np.nanargmin(wide.share))
        seconds, sigma = _parabola(wide.offsets, self._fit(wide), best)
        return replace(found, seconds=seconds, sigma_s=sigma) if sigma < found.sigma_s else found

    def _compared(
        self, looks: Looks, track: Track, zero_s: float, steps: Array, half: float
    ) -> "_Compared | None":
        """Displacements at offsets of so many steps; None where too little moves or overlaps."""
        t = np.arange(0, float(looks.time_s[-1]) + 1e-9, self.grid_s)
        path, heading = _image_path(looks)
        image = np.stack(
            [_displacements(looks.time_s, p, t, half) for p in (path, heading)], axis=1
        )
        if np.isfinite(image[:, 0]).sum() < 20 or not len(steps):
            return None
        offsets = steps * self.grid_s
        there = zero_s + np.arange(offsets[0], offsets[-1] + t[-1] + self.grid_s / 2, self.grid_s)
        moved = _track_displacements(track, there, half)
        share = np.array(
            [
                _misfit(image, moved[k : k + len(t)], self.inside)
                for k in range(min(len(offsets), len(moved) - len(t) + 1))
            ]
        )
        if not np.isfinite(share).any():
            return None
        return _Compared(
            offsets=offsets[: len(share)], share=share, image=image, moved=moved, half=half
        )

    def _fit(self, found: "_Compared") -> Array:
        """Twice the negative logarithm of the likelihood (n,), but for a constant."""
        known = np.isfinite(found.image[:, 0]).sum()
        n = max(known * self.grid_s / found.half * 2, 1.0)
        return np.asarray(n * np.log(np.maximum(found.share, 1e-6)))

    def _judged(self, found: "_Compared") -> Offset:
        offsets, share, fit = found.offsets, found.share, self._fit(found)
        best = int(np.nanargmin(share))
        near, sigma = _parabola(offsets, fit, best)
        others = np.abs(offsets - offsets[best]) > self.apart_s
        rival = float(np.nanmin(fit[others])) if np.isfinite(fit[others]).any() else np.nan
        part = found.moved[best : best + len(found.image)]
        speed = float(np.sqrt(np.nanmean(np.abs(part) ** 2)) / (2 * found.half))
        clear = (
            np.isfinite(rival)
            and rival - fit[best] > self.certain
            and share[best] < 0.3
            and sigma < 1.0
        )
        return Offset(
            seconds=near,
            sigma_s=sigma,
            clear=bool(clear),
            misfit=float(share[best]),
            speed_ms=speed,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Compared:
    """Displacements of pictures and positions at several offsets."""

    offsets: Array
    """(n,) s."""
    share: Array
    """(n,) share of the motion that the pictures do not explain; NaN where too little is known."""
    image: Complex
    """(m, 2) of the picture's middle and of a point fixed to the drone, px."""
    moved: Complex
    """(m + n - 1,) of the positions, m."""
    half: float
    """Half their duration, s."""


def _image_path(looks: Looks) -> tuple[Complex, Complex]:
    """Path (n,) of the middle of the picture on the ground, in px of the first picture, x to the
    right and y up; and the direction of the picture there, of length 1. NaN outside the longest
    unbroken run of looks.

    Changes of scale are not accumulated: flights that map keep their height, and the small errors
    of many looks would add up.
    """
    path = np.zeros(len(looks.time_s), np.complex128)
    heading = np.ones(len(path), np.complex128)
    run = np.zeros(len(path), np.int64)
    turn, at = 1 + 0j, 0j
    for i in range(1, len(path)):
        if not looks.linked[i]:
            turn, at = 1 + 0j, 0j
            run[i:] += 1
        at += turn * looks.shift[i]
        turn *= looks.turn[i] / abs(looks.turn[i])
        path[i], heading[i] = at, turn
    longest = np.bincount(run).argmax() if len(run) else 0
    known = run == longest
    return np.where(known, path.conj(), np.nan), np.where(known, heading.conj(), np.nan)


def _displacements(time: Array, path: Complex, t: Array, half: float) -> Complex:
    """Displacements (n,) from `half` before to `half` after each of t; NaN where unknown."""
    out = np.interp(t + half, time, path, np.nan, np.nan) - np.interp(
        t - half, time, path, np.nan, np.nan
    )
    return np.asarray(out)


def _track_displacements(track: Track, t: Array, half: float) -> Complex:
    """The same in m, east + i north."""
    shrink = np.cos(np.radians(float(np.median(track.latitude_deg))))

    def at(times: Array) -> Complex:
        places = places_at(track, times)
        inside = (times >= track.height_time_s[0]) & (times <= track.height_time_s[-1])
        east = (places.longitude_deg - track.longitude_deg[0]) * shrink
        north = places.latitude_deg - track.latitude_deg[0]
        return np.asarray(
            np.where(inside, (east + 1j * north) * METRES_PER_DEGREE, np.nan), np.complex128
        )

    return at(t + half) - at(t - half)


def _misfit(image: Complex, moved: Complex, inside: float) -> float:
    """Share of the motion v (n,) that is not explained by columns of `image` (n, 2)."""
    known = np.isfinite(image[:, 0]) & np.isfinite(moved)
    if known.sum() < max(inside * np.isfinite(image[:, 0]).sum(), 15):
        return float("nan")
    w, v = image[known], moved[known]
    power = float(np.vdot(v, v).real)
    if power <= 0:
        return float("nan")
    gram, both = w.conj().T @ w, w.conj().T @ v
    # a hair of ridge: a flight without a turn tells nothing of the second column
    gram += 1e-6 * np.trace(gram).real * np.diag([0.0, 1.0])
    if abs(gram[0, 0]) <= 0:
        return float("nan")
    return 1.0 - float(np.vdot(both, np.linalg.solve(gram, both)).real) / power


def _parabola(x: Array, y: Array, best: int) -> tuple[float, float]:
    """Place of the minimum of a parabola through the least value and its neighbours, and the
    distance at which it has risen by 1.
    """
    around = slice(max(best - 2, 0), best + 3)
    good = np.isfinite(y[around])
    if good.sum() < 3:
        return float(x[best]), float("inf")
    a, b, _ = np.polyfit(x[around][good] - x[best], y[around][good], 2)
    if a <= 0:
        return float(x[best]), float("inf")
    step = float(np.clip(-b / (2 * a), -(x[1] - x[0]), x[1] - x[0])) if len(x) > 1 else 0.0
    return float(x[best]) + step, float(1 / np.sqrt(a))
