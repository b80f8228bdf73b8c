"""Rows of timed positions, as files tell them, -> `Track`."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from skyquilt.errors import SideFileError
from skyquilt.model.clip import Track


@dataclass(frozen=True, kw_only=True)
class Fix:
    """One row of a file; NaN = it does not say so."""

    time_s: float
    """s."""
    latitude_deg: float = np.nan
    """WGS 84."""
    longitude_deg: float = np.nan
    """WGS 84."""
    takeoff_m: float = np.nan
    """Height above take-off."""
    sea_level_m: float = np.nan
    """Height above sea level."""
    gimbal_deg: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    """Yaw, pitch, roll."""
    flight_yaw_deg: float = np.nan
    """Heading of the aircraft."""


def track_of(
    fixes: Sequence[Fix],
    *,
    file: str,
    source: str,
    on_clip: bool,
    step_deg: float,
    start: datetime | None = None,
    focal_35mm: float | None = None,
    zoom: float = 1.0,
) -> Track:
    """A track of rows in any order; raises `SideFileError` where none has a position."""
    rows = sorted(fixes, key=lambda f: f.time_s)
    times = np.array([f.time_s for f in rows])
    places = np.array([(f.latitude_deg, f.longitude_deg) for f in rows]).reshape(-1, 2)
    known = np.isfinite(places).all(axis=1) & (np.abs(places) > 0).any(axis=1)
    if not known.any():
        raise SideFileError(
            f"{file} contains no position: none of its {len(rows)} rows has a latitude and a"
            " longitude other than 0."
        )
    t, p = times[known], places[known]
    changed = np.concatenate([[True], (np.diff(p, axis=0) != 0).any(axis=1)])
    changed &= np.concatenate([[True], np.diff(t) > 0])
    values = np.array([(f.takeoff_m, f.sea_level_m, *f.gimbal_deg, f.flight_yaw_deg) for f in rows])
    content = hashlib.blake2b(times.tobytes() + places.tobytes() + values.tobytes()).hexdigest()
    once = np.concatenate([[True], np.diff(times) > 0])
    return Track(
        file=file,
        source=source,
        digest=content[:32],
        on_clip=on_clip,
        time_s=t[changed],
        latitude_deg=p[changed, 0],
        longitude_deg=p[changed, 1],
        step_deg=step_deg,
        height_time_s=times[once],
        takeoff_m=values[once, 0],
        sea_level_m=values[once, 1],
        gimbal_deg=values[once, 2:5],
        flight_yaw_deg=values[once, 5],
        start=start,
        focal_35mm=focal_35mm,
        zoom=zoom,
        rows=len(rows),
        zeros=int((~known).sum()),
        repeats=int((~changed).sum()),
    )
