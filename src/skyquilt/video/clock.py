"""How the clocks of a clip and of its positions differ, found from the flight itself.

The pictures tell how the ground moved below the camera, up to a rotation and a scale; the positions
tell how the drone moved. Both agree at the right offset only, if the flight turns or changes speed.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.frames import METRES_PER_DEGREE
from skyquilt.model.clip import Looks, Track
from skyquilt.video.positions import places_at

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
LEAST_SHARE = 1e-4
"""Smallest share of a motion that counts as noise: times of rows are rounded."""


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
    as twice the negative logarithm of the likelihood. Turns of the picture against the headings
    that the track tells, and changes of scale against its heights, add theirs: at constant speed a
    camera that looks ahead by a second's flight cannot be told from a clock that is a second late,
    by positions alone.
    """

    grid_s: float = 0.2
    """Step of the search."""
    half_s: float = 3.0
    """Displacements are taken from so long before to so long after."""
    wide_s: float = 8.0
    """The same for the last step, around the best offset: over a whole turn the drone is displaced
    by more, and its receiver errs by no more. At most a sixth of the clip.
    """
    short_s: float = 1.5
    """The same for headings and heights, which are known better and change faster."""
    inside: float = 0.6
    """Share of the clip that positions must cover."""
    apart_s: float = 2.0
    """Offsets further apart than this are different answers."""
    certain: float = 18.0
    """Least difference of twice the log-likelihood to any different answer."""
    version: int = 3
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
        if not found.clear:
            return found
        around = steps[np.abs(steps * self.grid_s - found.seconds) <= self.apart_s / 2]
        half = min(self.wide_s, last_look / 6)
        wide = self._compared(looks, track, zero_s, around, half) if half > self.half_s else None
        options = [_nearest(c) for c in (near, wide) if c is not None]
        seconds, sigma = min(options, key=lambda o: o[1])
        return replace(found, seconds=seconds, sigma_s=sigma)

    def _compared(
        self, looks: Looks, track: Track, zero_s: float, steps: Array, half: float
    ) -> "_Compared | None":
        """Displacements at offsets of so many steps; None where too little moves or overlaps."""
        t = np.arange(0, float(looks.time_s[-1]) + 1e-9, self.grid_s)
        path, heading, climb = _image_path(looks)
        image = np.stack(
            [_displacements(looks.time_s, p, t, half) for p in (path, heading)], axis=1
        )
        known = int(np.isfinite(image[:, 0]).sum())
        if known < 20 or not len(steps):
            return None
        there = zero_s + np.arange(
            steps[0] * self.grid_s, steps[-1] * self.grid_s + t[-1] + self.grid_s / 2, self.grid_s
        )
        moved = _track_displacements(track, there, half)
        offsets = steps[: len(moved) - len(t) + 1] * self.grid_s
        parts = [slice(k, k + len(t)) for k in range(len(offsets))]
        share = np.array([_misfit(image, moved[p], self.inside) for p in parts])
        if not np.isfinite(share).any():
            return None
        shares, weights = [share], [max(known * self.grid_s / half * 2, 1.0)]
        short = self.short_s
        for seen, told, apart in (
            (_angle(heading), _yaw(track, there, short), 2 * short),
            (climb, _risen(track, there, short), 4 * short),  # a tilt looks like a climb for long
        ):
            x = _displacements(looks.time_s, seen, t, short)
            shares.append(np.array([_unlike(x, told[p], self.inside) for p in parts]))
            weights.append(max(known * self.grid_s / apart, 1.0))
        return _Compared(
            offsets=offsets, shares=np.stack(shares), weights=np.array(weights),
            image=image, moved=moved, half=half,
        )  # fmt: skip

    def _judged(self, found: "_Compared") -> Offset:
        offsets, share, fit = found.offsets, found.shares[0], found.fit
        best = int(np.nanargmin(fit))
        near, sigma = _nearest(found)
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
    shares: Array
    """(3, n) shares of the motion, the heading and the height that the pictures do not explain; NaN
    where too little is known of the motion, 1 where nothing is of the others.
    """
    weights: Array
    """(3,) number of independent differences of each."""
    image: Complex
    """(m, 2) of the picture's middle and of a point fixed to the drone, px."""
    moved: Complex
    """(m + n - 1,) of the positions, m."""
    half: float
    """Half their duration, s."""

    @property
    def fit(self) -> Array:
        """Twice the negative logarithm of the likelihood (n,), but for a constant."""
        return np.asarray(self.weights @ np.log(np.maximum(self.shares, LEAST_SHARE)))


def _nearest(found: _Compared) -> tuple[float, float]:
    """The best offset and its deviation: shares are parabolas there, their logarithms are not."""
    best = int(np.nanargmin(found.fit))
    noise = np.maximum(found.shares[:, best], LEAST_SHARE)
    return _parabola(found.offsets, (found.weights / noise) @ found.shares, best)


def _image_path(looks: Looks) -> tuple[Complex, Complex, Array]:
    """Path (n,) of the middle of the picture on the ground, in px of the first picture, x to the
    right and y up; the direction of the picture there, of length 1; and the logarithm of the height
    above the ground, from 0. NaN outside the longest unbroken run of looks.

    Changes of scale do not enter the path: flights that map keep their height, and the small errors
    of many looks would add up.
    """
    path = np.zeros(len(looks.time_s), np.complex128)
    heading = np.ones(len(path), np.complex128)
    climb = np.zeros(len(path))
    run = np.zeros(len(path), np.int64)
    turn, at, high = 1 + 0j, 0j, 0.0
    for i in range(1, len(path)):
        if not looks.linked[i]:
            turn, at, high = 1 + 0j, 0j, 0.0
            run[i:] += 1
        at += turn * looks.shift[i]
        size = abs(looks.turn[i])
        turn *= looks.turn[i] / size
        high += float(np.log(size))
        path[i], heading[i], climb[i] = at, turn, high
    longest = np.bincount(run).argmax() if len(run) else 0
    known = run == longest
    return (
        np.where(known, path.conj(), np.nan),
        np.where(known, heading.conj(), np.nan),
        np.where(known, climb, np.nan),
    )


def _displacements(time: Array, path: Any, t: Array, half: float) -> Any:
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


def _angle(heading: Complex) -> Array:
    """Angles (n,) of directions without jumps; NaN stays."""
    angle = np.angle(heading)
    known = np.isfinite(angle)
    angle[known] = np.unwrap(angle[known])
    return np.asarray(angle)


def _yaw(track: Track, t: Array, half: float) -> Array:
    """Turn (n,) of the picture, else of the aircraft, from `half` before to `half` after each of t,
    degrees counted anticlockwise; NaN where unknown.
    """
    yaw, pitch, roll = np.radians(track.gimbal_deg.T)
    # the top of the picture is opposite to the gimbal's downward axis, as in `belly_from_gimbal`:
    # where it looks down, its yaw and roll alone are arbitrary
    north = -np.cos(yaw) * np.sin(pitch) * np.cos(roll) - np.sin(yaw) * np.sin(roll)
    east = -np.sin(yaw) * np.sin(pitch) * np.cos(roll) + np.cos(yaw) * np.sin(roll)
    top = np.degrees(np.arctan2(east, north))
    top = top if np.isfinite(top).sum() > 1 else track.flight_yaw_deg
    known = np.isfinite(top)
    return -_differences(track.height_time_s[known], np.unwrap(top[known], period=360), t, half)


def _risen(track: Track, t: Array, half: float) -> Array:
    """Climb (n,) in m from `half` before to `half` after each of t; NaN where unknown."""
    takeoff = track.takeoff_m
    height = takeoff if np.isfinite(takeoff).sum() > 1 else track.sea_level_m
    known = np.isfinite(height)
    return _differences(track.height_time_s[known], height[known], t, half)


def _differences(time: Array, value: Array, t: Array, half: float) -> Array:
    if len(time) < 2:
        return np.full(len(t), np.nan)
    return np.asarray(_displacements(time, value, t, half))


def _unlike(seen: Array, told: Array, inside: float) -> float:
    """Share of what is `told` (n,) that a positive multiple of what is `seen` (n,) leaves; 1 where
    too little is known.
    """
    known = np.isfinite(seen) & np.isfinite(told)
    if known.sum() < max(inside * np.isfinite(seen).sum(), 15):
        return 1.0
    x, y = seen[known], told[known]
    both, power = float(x @ y), float(x @ x) * float(y @ y)
    return 1.0 - both**2 / power if both > 0 and power > 0 else 1.0


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
