"""Timed positions: DJI's SRT, GPX, CSV, or photos of another camera -> `Track`."""

import csv
import io
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import SideFileError
from skyquilt.model.clip import Track
from skyquilt.outside import open_regular, plain, real, text_of
from skyquilt.video.fixes import Fix, track_of
from skyquilt.video.srt import Sample, read_samples, side_text

Array = NDArray[np.float64]
TRACK_ENDINGS = (".srt", ".gpx", ".csv")
_FEET = 0.3048


def read_track(path: Path) -> Track:
    """Positions of an `.srt`, `.gpx` or `.csv`.

    Raises `SideFileError` where it is malformed or holds fewer than two positions.
    """
    ending = path.suffix.lower()
    reader = {".srt": _read_srt, ".gpx": _read_gpx, ".csv": _read_csv}.get(ending)
    if reader is None:
        raise SideFileError(
            f"{path.name} holds no timed positions; for a video give an .srt, .gpx or .csv with"
            " times."
        )
    return reader(path)


def _read_srt(path: Path) -> Track:
    return track_of_subtitles(read_samples(path), file=path.name)


def track_of_subtitles(samples: Sequence[Sample], *, file: str) -> Track:
    """A track of DJI's subtitles; raises `SideFileError` where none has a position."""
    timed = _clip_times(samples)
    fixes = [_fix(s, t) for s, t in zip(samples, timed, strict=True)]
    first = next((i for i, s in enumerate(samples) if s.moment), None)
    moment = None if first is None else samples[first].moment
    start = None
    if first is not None and moment is not None:
        # not `fromtimestamp`: Windows knows no time before 1970, as of a clock that was never set
        start = datetime(1970, 1, 1) + timedelta(seconds=unix_s(moment) - timed[first])
    decimals = max((s.decimals for s in samples), default=0)
    focal = [s.focal_35mm for s in samples if s.focal_35mm]
    zoom = [s.zoom for s in samples if s.zoom]
    return track_of(
        fixes,
        file=file,
        source="srt",
        on_clip=True,
        step_deg=10.0**-decimals,
        start=start,
        focal_35mm=float(np.median(focal)) if focal else None,
        zoom=_zoom(float(np.median(zoom))) if zoom else 1.0,
    )


def _zoom(value: float) -> float:
    """Digital zoom, which older files give in ten-thousandths."""
    value = value / 10000 if value >= 1000 else value
    return value if 1.0 <= value <= 16.0 else 1.0


def _clip_times(samples: Sequence[Sample]) -> list[float]:
    """Times of the subtitles in the clip; where they have none, those of their clock, or one per
    second.
    """
    if all(s.start_s is not None for s in samples):
        return [s.start_s or 0.0 for s in samples]
    moments = [s.moment for s in samples]
    if all(m is not None for m in moments):
        first = unix_s(moments[0])
        return [unix_s(m) - first for m in moments]
    return [float(s.index - samples[0].index) for s in samples]


def unix_s(moment: datetime | None) -> float:
    """Seconds since 1970 of a time; a time without zone counts as UTC."""
    assert moment is not None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _fix(sample: Sample, time: float) -> Fix:
    def number(value: float | None) -> float:
        return np.nan if value is None else value

    return Fix(
        time_s=time,
        latitude_deg=number(sample.latitude_deg),
        longitude_deg=number(sample.longitude_deg),
        takeoff_m=number(sample.takeoff_m),
        sea_level_m=number(sample.sea_level_m),
        gimbal_deg=sample.gimbal_deg or (np.nan, np.nan, np.nan),
        flight_yaw_deg=number(sample.flight_yaw_deg),
    )


def _read_gpx(path: Path) -> Track:
    """Track points of a GPX 1.0 or 1.1 file; a torn file is read up to where it is torn."""
    fixes: list[Fix] = []
    decimals = 0
    try:
        for _, node in ElementTree.iterparse(io.StringIO(side_text(path))):
            if node.tag.rpartition("}")[2] != "trkpt":
                continue
            inside = {c.tag.rpartition("}")[2]: (c.text or "").strip() for c in node}
            moment = _parsed_time(inside.get("time", ""))
            lat, lon = node.get("lat", ""), node.get("lon", "")
            if moment is None:
                continue
            decimals = max(decimals, *(len(v.partition(".")[2]) for v in (lat, lon)))
            fixes.append(
                Fix(
                    time_s=moment,
                    latitude_deg=_number(lat),
                    longitude_deg=_number(lon),
                    sea_level_m=_number(inside.get("ele", "")),
                )
            )
            node.clear()
    except ElementTree.ParseError as error:
        if not fixes:
            raise SideFileError(f"{path.name} is no GPX file ({error}).") from error
    if not fixes:
        raise SideFileError(
            f"{path.name} holds no track points with times; expected <trkpt> with <time>."
        )
    step = 10.0**-decimals
    return track_of(fixes, file=path.name, source="gpx", on_clip=False, step_deg=step)


_TIMES = ("timemillisecond", "time", "timestamp", "datetime", "datetimeutc", "seconds", "t", "utc")
_COLUMNS = {
    "latitude_deg": ("latitude", "lat", "latitudedeg", "gpslatitude", "osdlatitude"),
    "longitude_deg": ("longitude", "lon", "lng", "long", "longitudedeg", "osdlongitude"),
    "takeoff_m": (
        "relativealtitude",
        "relalt",
        "takeoff",
        "heightabovetakeoff",
        "osdheightft",
        "height",
    ),
    "sea_level_m": ("altitude", "alt", "elevation", "ele", "altitudeabovesealevel", "absalt"),
    "flight_yaw_deg": ("heading", "compassheading", "flightyaw", "osdyaw"),
}


def is_timed_csv(path: Path) -> bool:
    """Whether a CSV has a column of times and positions, but none that names photos."""
    try:
        with open_regular(path) as file:
            first = text_of(file.read(10_000)).partition("\n")[0]
    except OSError:
        return False
    heads = [_plain(h)[0] for h in re.split(r"[,;\t]", first.strip())]
    named = {"name", "filename", "file", "image", "imagename", "photo", "label"} & set(heads)
    return not named and bool(set(_TIMES) & set(heads)) and "latitude_deg" in _where(heads)


def _plain(head: str) -> tuple[str, str]:
    """Letters of a heading, and its unit: `height_above_takeoff(feet)`."""
    unit = re.search(r"[\[(](.*?)[\])]", head)
    bare = re.sub(r"[\[(].*", "", head)
    word = re.sub(r"[^a-z]", "", bare.lower())
    named = unit[1].strip().lower() if unit else ""
    return (word + named if word in ("time", "datetime") and named else word), named


def _where(heads: Sequence[str]) -> dict[str, int]:
    return {
        field: next(heads.index(a) for a in aliases if a in heads)
        for field, aliases in _COLUMNS.items()
        if set(aliases) & set(heads)
    }


def _read_csv(path: Path) -> Track:
    """Rows with a time and a position, such as flight logs: columns time (ISO 8601, seconds, or
    `time(millisecond)`), latitude, longitude, and altitude, height_above_takeoff, heading where
    there are any; `(feet)` after a name is understood.
    """
    text = side_text(path)
    lines = [line for line in text.splitlines() if line.strip()]
    delimiter = max(",;\t", key=lines[0].count) if lines else ","
    try:
        table = list(csv.reader(lines, delimiter=delimiter))
    except csv.Error as error:
        raise SideFileError(f"{path.name} is not a table ({error}).") from error
    heads = [_plain(h) for h in table[0]] if table else []
    words = [h[0] for h in heads]
    columns = _where(words)
    clock = next((w for w in _TIMES if w in words), None)
    if clock is None or "latitude_deg" not in columns or "longitude_deg" not in columns:
        head = plain(", ".join(table[0]), 200) if table else ""
        raise SideFileError(
            f"{path.name}: its header is '{head}'; expected columns time, latitude and longitude."
        )
    at = words.index(clock)
    fixes, seconds = [], []
    if delimiter != ",":  # then commas are those of decimals
        table = [table[0], *([c.replace(",", ".") for c in cells] for cells in table[1:])]
    for cells in table[1:]:
        time = _cell_time(cells[at] if at < len(cells) else "", milli="milli" in clock)
        if time is None:
            continue
        values: dict[str, Any] = {}
        for field, column in columns.items():
            feet = _FEET if heads[column][1] in ("feet", "ft") else 1.0
            values[field] = feet * _number(cells[column] if column < len(cells) else "")
        seconds.append(time)
        fixes.append(Fix(time_s=time, **values))
    if not fixes:
        raise SideFileError(f"{path.name} has no row with a time that can be read.")
    cells_of = [columns["latitude_deg"], columns["longitude_deg"]]
    cells_with = (c[k] for c in table[1:] for k in cells_of if k < len(c))
    decimals = max((len(c.partition(".")[2]) for c in cells_with), default=0)
    return track_of(
        fixes,
        file=path.name,
        source="csv",
        on_clip=max(seconds) < 1e8,
        step_deg=10.0 ** -min(decimals, 9),
    )


def _cell_time(text: str, *, milli: bool) -> float | None:
    value = _number(text.strip())
    if np.isfinite(value):
        return value / 1000 if milli or value > 1e11 else value
    return _parsed_time(text.strip())


def _parsed_time(text: str) -> float | None:
    """Seconds since 1970 of an ISO 8601 time; without a zone it counts as UTC."""
    try:
        return unix_s(datetime.fromisoformat(text.replace("Z", "+00:00").replace("/", "-")))
    except ValueError:
        return None


def _number(text: str) -> float:
    value = real(text)
    return float("nan") if value is None else value


def merged(tracks: Iterable[Track], *, file: str) -> Track:
    """One track of several whose times are seconds since 1970, such as all files of a folder."""
    parts = list(tracks)
    if len(parts) == 1:
        return parts[0]
    fixes = [
        Fix(time_s=float(t), latitude_deg=float(a), longitude_deg=float(o))
        for p in parts
        for t, a, o in zip(p.time_s, p.latitude_deg, p.longitude_deg, strict=True)
    ]
    fixes += [
        Fix(
            time_s=float(t),
            takeoff_m=float(p.takeoff_m[i]),
            sea_level_m=float(p.sea_level_m[i]),
            gimbal_deg=tuple(float(v) for v in p.gimbal_deg[i]),  # type: ignore[arg-type]
            flight_yaw_deg=float(p.flight_yaw_deg[i]),
        )
        for p in parts
        for i, t in enumerate(p.height_time_s)
    ]
    step = max(p.step_deg for p in parts)
    return track_of(fixes, file=file, source=parts[0].source, on_clip=False, step_deg=step)
