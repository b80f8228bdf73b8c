"""RTKLIB's `.pos` of a flight's events: a position for each photo, without names."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import SideFileError
from skyquilt.model.photo import Photo
from skyquilt.outside import plain
from skyquilt.photos.side_rows import SideRow, accuracy, number, read_text

_TIME = re.compile(r"(\d{4})[/-](\d\d)[/-](\d\d) (\d\d):(\d\d):(\d\d(?:\.\d{1,9})?)", re.ASCII)
_WEEK = re.compile(r"(\d{1,5}) (\d{1,6}(?:\.\d{1,9})?)", re.ASCII)
_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
"""Where weeks of GPS begin."""
_TOGETHER_S = 2.0
"""Times of photos have whole seconds; those of events and photos differ by the same within this."""


@dataclass(frozen=True, kw_only=True)
class _Event:
    """One line of the file."""

    time_s: float
    latitude_deg: float
    longitude_deg: float
    height_m: float
    sigmas_m: tuple[float | None, float | None]
    """Horizontal and vertical."""


def read_pos(path: Path, photos: Sequence[Photo]) -> tuple[tuple[SideRow, ...], tuple[str, ...]]:
    """One row per photo, and a note on how events were given to photos.

    The photos, in order of capture, get the events in order of time. Where there are more events
    (of the ground before the flight), those are taken whose times go with the photos'.

    Raises:
        SideFileError: a line is malformed, or events and photos do not match.
    """
    events = _read(path)
    ordered = sorted(photos, key=lambda p: (p.time is None, _clock(p), p.name))
    begin = _first(path.name, events, ordered)
    rows = tuple(
        SideRow(
            name=photo.name,
            latitude_deg=event.latitude_deg,
            longitude_deg=event.longitude_deg,
            altitude_m=event.height_m,
            datum="ellipsoid",
            sigma_xy_m=event.sigmas_m[0],
            sigma_z_m=event.sigmas_m[1],
        )
        for photo, event in zip(ordered, events[begin:], strict=False)
    )
    left = len(events) - len(ordered)
    return rows, (
        f"{path.name} names no photos: its {len(events)} positions are given to them in order of"
        " capture"
        + (
            f", and {begin} before the first photo and {left - begin} behind are left"
            if left
            else ""
        )
        + ".",
    )


def _clock(photo: Photo) -> datetime:
    return photo.time.replace(tzinfo=None) if photo.time else datetime.max


def _first(file: str, events: Sequence[_Event], photos: Sequence[Photo]) -> int:
    """The event of the first photo.

    Raises:
        SideFileError: there are fewer events than photos, or their times tell of no match.
    """
    more = len(events) - len(photos)
    counts = f"{file} has {len(events)} positions, and there are {len(photos)} photos"
    if more < 0:
        raise SideFileError(
            f"{counts}. Give the file of all events (Emlid Studio and RTKLIB call it _events.pos),"
            " leave out photos that it lacks, or give a CSV with the names of the photos."
        )
    if any(p.time is None for p in photos):
        if more:
            raise SideFileError(
                f"{counts} without capture times, so nothing tells which belong together. Give a"
                " CSV with the names of the photos."
            )
        return 0
    taken = np.array([(_clock(p) - datetime(1980, 1, 6)).total_seconds() for p in photos])
    given = np.array([e.time_s for e in events])
    spreads = _spreads(given, taken)
    fits = np.flatnonzero(spreads < _TOGETHER_S)
    if len(photos) < 2 and more:
        fits = np.empty(0, int)
    if len(fits) == 1:
        return int(fits[0])
    raise SideFileError(
        f"{counts}, whose times do not go together"
        + (
            f" ({len(fits)} places of the file fit)"
            if len(fits)
            else f" (they differ by {spreads.min():.1f} s more in one place than in another)"
        )
        + ". Give the file of the events of this flight (Emlid Studio and RTKLIB call it"
        " _events.pos), or a CSV with the names of the photos."
    )


def _spreads(given: NDArray[np.float64], taken: NDArray[np.float64]) -> NDArray[np.float64]:
    """For each event that may be the first photo's: by how much differences of times differ, s."""
    return np.array(
        [np.ptp(given[k : k + len(taken)] - taken) for k in range(len(given) - len(taken) + 1)]
    )


def _read(path: Path) -> list[_Event]:
    lines = [
        (i, " ".join(line.replace(",", " ").split()))
        for i, line in enumerate(read_text(path).splitlines(), 1)
    ]
    head = next((line for _, line in lines if line.startswith("%") and "GPST" in line), "")
    head = head or next((line for _, line in lines if "latitude" in line), "")
    if any(word in head for word in ("ecef", "baseline", "d'")):
        raise SideFileError(
            f"{path.name} holds '{plain(head, 100)}'; expected latitude and longitude in degrees"
            " and height. Choose the format 'Lat/Lon/Height' and degrees in the program that"
            " computes it."
        )
    found = [
        _event(line, f"{path.name}, line {i}")
        for i, line in lines
        if line and not line.startswith("%")
    ]
    if not found:
        raise SideFileError(f"{path.name} has no positions; expected RTKLIB's lines of them.")
    return sorted(found, key=lambda e: e.time_s)


def _event(line: str, place: str) -> _Event:
    day, week = _TIME.match(line), _WEEK.match(line)
    moment = day or week
    values = [number(word) for word in line[moment.end() :].split()] if moment else []
    numbers = [v for v in values if v is not None]
    if moment is None or len(numbers) < 3 or len(numbers) != len(values):
        raise SideFileError(
            f"{place}: expected RTKLIB's 'date time latitude longitude height ...', found"
            f" '{plain(line, 100)}'. Use the file as the program wrote it."
        )
    sigmas = [accuracy(v, place) for v in numbers[5:8]] if len(numbers) >= 8 else []
    return _Event(
        time_s=_seconds(day, place) if day else float(moment[1]) * 604_800 + float(moment[2]),
        latitude_deg=numbers[0],
        longitude_deg=numbers[1],
        height_m=numbers[2],
        sigmas_m=(max(s or 0.0 for s in sigmas[:2]) or None, sigmas[2]) if sigmas else (None, None),
    )


def _seconds(day: re.Match[str], place: str) -> float:
    try:
        year, month, date, hour, minute = (int(day[k]) for k in range(1, 6))
        start = datetime(year, month, date, hour, minute, tzinfo=UTC)
    except ValueError as error:
        raise SideFileError(f"{place}: '{day[0]}' is no time. Correct that line.") from error
    return (start + timedelta(seconds=float(day[6])) - _EPOCH).total_seconds()
