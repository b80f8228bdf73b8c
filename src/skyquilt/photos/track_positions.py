"""Positions of photos from a track: GPX or a table with times, of a receiver that flew along.

Cameras write local time, receivers UTC. Where photos tell no time zone, the one is taken in which
most of them were taken while the receiver moved.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import SideFileError
from skyquilt.geometry.frames import METRES_PER_DEGREE
from skyquilt.model.clip import Track
from skyquilt.model.photo import Photo
from skyquilt.photos.position_tables import has_header
from skyquilt.photos.side_rows import SideRow, sentence_of
from skyquilt.photos.together import whole_seconds
from skyquilt.video.positions import places_at, position_at
from skyquilt.video.tracks import is_timed_csv, read_track, unix_s

Array = NDArray[np.float64]
ZONES_H = np.arange(-12, 14.01, 0.25)
"""Time zones that are tried, hours ahead of UTC."""
MOVING = 0.7
"""Speed in m/s from which a receiver is flying, or carried."""
CLOCK_S = 1.0
"""Deviation of a camera's clock that nothing tells, in s."""
ROUNDED_S = float(1 / np.sqrt(12))
"""Deviation of times in whole seconds, in s."""
ALIKE = 0.9
"""Share of the most photos with which another time zone fits, too."""
_PER_DAY_DEG = 15.0
_SUMMER_DEG, _SUMMER = 30.0, (4, 10)
"""Latitude from which clocks are often put forward in summer, first and last month of the northern
one.
"""
_ODD_H = 1.0
"""Zones that are no whole hours from UTC are as rare as those an hour further from the sun's."""


def is_track(file: Path) -> bool:
    """Whether a side file holds positions by time, in a format that is read for photos."""
    ending = file.suffix.lower()
    return ending == ".gpx" or (ending == ".csv" and is_timed_csv(file) and not has_header(file))


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """Photos on a track, with one offset."""

    offset_s: float
    """Added to the photos' times to get those of the track."""
    inside: NDArray[np.bool_]
    """(n,) whether the track tells where a photo was taken."""
    moving: int
    """Number of these that were taken while it moved."""

    @property
    def rank(self) -> tuple[int, int]:
        """Compared with other fits."""
        return self.moving, int(self.inside.sum())


def read_track_rows(
    path: Path, photos: Sequence[Photo], clock_offset_s: float | None = None
) -> tuple[tuple[SideRow, ...], tuple[str, ...]]:
    """One row per photo that was taken while the track was recorded, and notes.

    `clock_offset_s`: seconds to add to the photos' times to get those of the track; None = found.

    Raises:
        SideFileError: the file is malformed, or no photo was taken while it was recorded.
    """
    track = read_track(path)
    timed = [p for p in photos if p.time is not None]
    if not timed:
        raise SideFileError(
            f"{path.name} holds positions by time, and no photo tells when it was taken. Give a CSV"
            " with the names of the photos."
        )
    taken = np.array([unix_s(p.time) for p in timed])
    zoned = all(p.time is not None and p.time.tzinfo is not None for p in timed)
    fits = [_fit(track, taken, o) for o in _offsets(clock_offset_s, zoned=zoned)]
    best = max(fits, key=lambda f: (*f.rank, -_from_sun(f, track)))
    if not best.inside.any():
        raise SideFileError(_nothing(path.name, track, taken, timed, clock_offset_s))
    times = taken + best.offset_s
    places, speed = places_at(track, times), _speed(track, times)
    unsure = 0.0 if clock_offset_s is not None else CLOCK_S
    late_s = np.hypot(unsure, ROUNDED_S if whole_seconds(timed) else 0.0)
    rows = []
    for k, photo in enumerate(timed):
        found = position_at(track, places, k, float(times[k]))
        if found is None:
            continue
        along = float(np.nan_to_num(speed[k])) * late_s
        rows.append(
            SideRow(
                name=photo.name,
                latitude_deg=found.latitude_deg,
                longitude_deg=found.longitude_deg,
                altitude_m=found.altitude_m,
                datum=found.datum,
                sigma_xy_m=float(np.hypot(found.sigma_xy_m, along)),
                sigma_z_m=found.sigma_z_m,
            )
        )
    return tuple(rows), tuple(_notes(path.name, best, fits, timed, clock_offset_s, zoned=zoned))


def _offsets(told: float | None, *, zoned: bool) -> Array:
    """Offsets that are tried, in s."""
    if told is not None:
        return np.array([told])
    return np.zeros(1) if zoned else -3600.0 * ZONES_H


def _fit(track: Track, taken: Array, offset: float) -> _Fit:
    times = taken + offset
    inside = np.isfinite(places_at(track, times).latitude_deg)
    moving = inside & (np.nan_to_num(_speed(track, times)) > MOVING)
    return _Fit(offset_s=float(offset), inside=inside, moving=int(moving.sum()))


def _speed(track: Track, times: Array) -> Array:
    """(n,) speed in m/s around times; NaN beyond the track."""
    before, after = (places_at(track, times + s) for s in (-1.0, 1.0))
    north = (after.latitude_deg - before.latitude_deg) * METRES_PER_DEGREE
    shrunk = np.cos(np.radians(track.latitude_deg.mean()))
    east = (after.longitude_deg - before.longitude_deg) * METRES_PER_DEGREE * shrunk
    return np.asarray(np.hypot(north, east) / 2)


def _from_sun(fit: _Fit, track: Track) -> float:
    """How far in hours a time zone lies from where the sun and the season would put it."""
    latitude, hours = float(np.median(track.latitude_deg)), -fit.offset_s / 3600
    month = datetime.fromtimestamp(float(track.time_s[0]), UTC).month
    summer = abs(latitude) > _SUMMER_DEG and (_SUMMER[0] <= month <= _SUMMER[1]) == (latitude > 0)
    sun = float(np.median(track.longitude_deg)) / _PER_DAY_DEG + summer
    return abs(hours - sun) + _ODD_H * (hours % 1 != 0)


def _clock(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _zone(offset_s: float) -> str:
    hours = -offset_s / 3600
    return f"UTC{int(np.trunc(hours)):+d}" + (
        f":{round(abs(hours) % 1 * 60):02d}" if hours % 1 else ""
    )


def _nothing(
    file: str, track: Track, taken: Array, photos: Sequence[Photo], told: float | None
) -> str:
    """Why no photo gets a position."""
    low, high = float(track.time_s[0]), float(track.time_s[-1])
    offset = f" with {told:g} s added (--clock-offset)" if told is not None else ""
    return (
        f"{file} was recorded from {_clock(low)} to {_clock(high)} UTC, and none of the"
        f" {len(photos)} photos was taken then, whatever their time zone: by their clock they were"
        f" taken from {_clock(float(taken.min()))} to {_clock(float(taken.max()))}{offset}. Give"
        " the track of this flight, or the error of the camera's clock as --clock-offset SECONDS."
    )


def _notes(
    file: str,
    best: _Fit,
    fits: Sequence[_Fit],
    photos: Sequence[Photo],
    told: float | None,
    *,
    zoned: bool,
) -> list[str]:
    """How the clocks were compared."""
    out = []
    if told is None and not zoned:
        out.append(f"The camera's clock is taken for {_zone(best.offset_s)}, as {file} has it.")
        others = [
            _zone(f.offset_s) for f in fits if f is not best and f.moving >= ALIKE * best.moving > 0
        ]
        if others:
            out.append(
                f"Photos lie on {file} as well with {sentence_of(others)}: it is longer than the"
                " flight. If the map is at a wrong place, give --clock-offset SECONDS."
            )
    beyond = [p.name for p, known in zip(photos, best.inside, strict=True) if not known]
    if beyond:
        out.append(f"{file} tells no place at the times of {sentence_of(beyond)}.")
    return out
