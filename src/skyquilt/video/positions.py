"""Positions of a track at the times of frames, with the deviations that interpolation adds."""

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.frames import METRES_PER_DEGREE, belly_from_gimbal
from skyquilt.model.clip import Clip, Track
from skyquilt.model.photo import Attitude, Datum, GeoPosition

Array = NDArray[np.float64]
_ACCELERATION = 1.5
"""Standard deviation of a drone's acceleration in m/s^2."""
_COARSE_DEG = 0.9e-5
_SIGMA_M = 1.5
_LARGEST_SIGMA_M = 30.0
_OUTSIDE_S = 1.0
_HEIGHT_GAP_S = 5.0
_DATUMS: tuple[Datum, ...] = ("takeoff", "sea_level")


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Interpolated positions; NaN where the track says nothing."""

    latitude_deg: Array
    """(n,) WGS 84."""
    longitude_deg: Array
    """(n,) WGS 84."""
    sigma_m: Array
    """(n,) standard deviation of each horizontal axis."""


def places_at(track: Track, times_s: Array) -> Places:
    """Positions (n,) of a track at times on its own clock.

    Between two fixes the drone is taken to fly straight on. A drone that accelerates by a random
    constant of standard deviation a while `gap` passes is off that line by a t (gap - t) / 2.
    Where latitude and longitude are rounded to metres (1e-5 degrees) or more, each is interpolated
    between the moments at which it changes: there it is half-way between both values.
    """
    t = np.asarray(times_s, dtype=np.float64)
    low, high = track.height_time_s[[0, -1]]
    inside = (t >= low - _OUTSIDE_S) & (t <= high + _OUTSIDE_S)
    rounding = track.step_deg * METRES_PER_DEGREE / np.sqrt(12)
    if track.step_deg > _COARSE_DEG:
        # a change is seen in the first row after it
        knots = track.time_s - 0.5 * _row_s(track)
        latitude = _rounded(knots, track.latitude_deg, track.step_deg, t)
        longitude = _rounded(knots, track.longitude_deg, track.step_deg, t)
        bend = np.zeros(len(t))
    else:
        latitude = np.interp(t, track.time_s, track.latitude_deg)
        longitude = np.interp(t, track.time_s, track.longitude_deg)
        bend = _bend(track.time_s, t)
    sigma = np.sqrt(_SIGMA_M**2 + rounding**2 + bend**2)
    inside &= sigma <= _LARGEST_SIGMA_M
    return Places(
        latitude_deg=np.where(inside, latitude, np.nan),
        longitude_deg=np.where(inside, longitude, np.nan),
        sigma_m=np.where(inside, sigma, np.nan),
    )


def _row_s(track: Track) -> float:
    """Time between rows in s."""
    return float(np.median(np.diff(track.height_time_s))) if len(track.height_time_s) > 1 else 0.0


def _bend(knots: Array, t: Array) -> Array:
    """Deviation (n,) in m of a flight from the straight line between fixes; before the first and
    after the last one, of a drone that stands still there.
    """
    after = np.clip(np.searchsorted(knots, t), 1, max(len(knots) - 1, 1))
    if len(knots) < 2:
        return np.asarray(0.5 * _ACCELERATION * (t - knots[0]) ** 2)
    a, b = knots[after - 1], knots[after]
    within = 0.5 * _ACCELERATION * np.abs((t - a) * (b - t))
    beyond = np.minimum(np.abs(t - np.clip(t, knots[0], knots[-1])), 4.0)
    return np.where((t < knots[0]) | (t > knots[-1]), 0.5 * _ACCELERATION * beyond**2, within)


def _rounded(knots: Array, values: Array, step: float, t: Array) -> Array:
    """A rounded coordinate, interpolated between the moments at which it changes."""
    if len(knots) < 2:
        return np.full(len(t), values[0])
    changed = np.flatnonzero(np.diff(values) != 0) + 1
    if not len(changed):
        return np.full(len(t), values[0])
    jump = values[changed] - values[changed - 1]
    small = np.abs(jump) < 1.5 * step
    at = np.where(small, values[changed] - jump / 2, values[changed])
    return np.interp(t, knots[changed], at)


def clip_zero(track: Track, clip: Clip) -> float:
    """Time on the clock of a track at which a clip begins, as far as both files tell."""
    if track.on_clip:
        return 0.0
    if clip.start is None:
        return float(track.time_s[0])
    start = clip.start if clip.start.tzinfo else clip.start.replace(tzinfo=UTC)
    return start.timestamp()


def position_at(track: Track, places: Places, index: int, time_s: float) -> GeoPosition | None:
    """The position of one frame, `index` among `places`; None where the track has none."""
    latitude = float(places.latitude_deg[index])
    if not np.isfinite(latitude):
        return None
    heights = {
        "takeoff": _value_at(track.height_time_s, track.takeoff_m, time_s),
        "sea_level": _value_at(track.height_time_s, track.sea_level_m, time_s),
    }
    known: list[Datum] = [d for d in _DATUMS if heights[d] is not None]
    datum = known[0] if known else "unknown"
    return GeoPosition(
        latitude_deg=latitude,
        longitude_deg=float(places.longitude_deg[index]),
        altitude_m=heights.get(datum),
        datum=datum,
        sigma_xy_m=float(places.sigma_m[index]),
        sigma_z_m=float(max(3.0, places.sigma_m[index])),
        source=track.source,
        takeoff_m=heights["takeoff"],
        sea_level_m=heights["sea_level"],
    )


def _value_at(knots: Array, values: Array, time_s: float) -> float | None:
    """A height at a time; None where the file gives none near it."""
    known = np.isfinite(values)
    if not known.any():
        return None
    t = knots[known]
    if np.abs(t - time_s).min() > _HEIGHT_GAP_S:
        return None
    return float(np.interp(time_s, t, values[known]))


def attitude_at(track: Track, time_s: float) -> Attitude | None:
    """The gimbal's angles at a time; None where the track gives none within 1 s."""
    i = int(np.argmin(np.abs(track.height_time_s - time_s)))
    yaw, pitch, roll = (float(v) for v in track.gimbal_deg[i])
    if not np.isfinite(yaw) or abs(track.height_time_s[i] - time_s) > _OUTSIDE_S:
        return None
    yaw, pitch, roll = belly_from_gimbal(yaw, pitch, roll)
    return Attitude(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll, source=track.source)


def flight_yaw_at(track: Track, time_s: float) -> float | None:
    """The aircraft's heading at a time; None where the track gives none within 1 s."""
    i = int(np.argmin(np.abs(track.height_time_s - time_s)))
    yaw = float(track.flight_yaw_deg[i])
    if not np.isfinite(yaw) or abs(track.height_time_s[i] - time_s) > _OUTSIDE_S:
        return None
    return yaw


def moment_of(start: datetime) -> datetime:
    """A start as naive time."""
    return start.replace(tzinfo=None)
