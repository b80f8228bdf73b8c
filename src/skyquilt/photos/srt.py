"""DJI's `.SRT`: telemetry of a video as subtitles, for frames taken from it.

Old form `GPS(lon,lat,satellites) BAROMETER:12.3` or `GPS (...), D .., H 6.00m`; new form
`[latitude: ..] [longitude: ..] [rel_alt: .. abs_alt: ..] [gb_yaw: .. gb_pitch: .. gb_roll: ..]`.
"""

import re
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from skyquilt.errors import SideFileError
from skyquilt.model.photo import Photo
from skyquilt.photos.metadata import parse_moment
from skyquilt.photos.side_rows import SideRow, read_lines

_NUMBER = r"([-+]?[0-9]{1,15}(?:\.[0-9]{1,20})?)"
_OLD = re.compile(rf"(?<!\w)GPS\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}", re.IGNORECASE)
_CLOCK = re.compile(r"\d{4}[-.]\d\d[-.]\d\d \d\d:\d\d:\d\d(?:[.,]\d{1,9})?", re.ASCII)
_MOST_BLOCK = 4000
"""Characters of one subtitle that are searched."""
_FRAME = re.compile(r"(?:^|frame|[_-])([0-9]{1,18})$", re.IGNORECASE)
_INDEX = re.compile(r"[0-9]{1,18}")
_NEAR_S = 0.5


@dataclass(frozen=True, kw_only=True)
class _Sample:
    index: int
    time: datetime | None
    row: SideRow


def read_srt(path: Path, photos: Sequence[Photo]) -> tuple[SideRow, ...]:
    """Positions for photos that are frames of the video; raises `SideFileError`.

    Matched by capture time within 0.5 s where both have one; else by the frame number at the end of
    the name, if every photo's name ends in a number that is in the file.
    """
    samples = _samples(path)
    if not samples:
        raise SideFileError(
            f"{path.name} contains no latitude and longitude; expected a DJI telemetry subtitle"
            " file."
        )
    rows = _by_time(samples, photos) or _by_frame(samples, photos)
    if not rows:
        raise SideFileError(
            f"{path.name} has {len(samples)} positions, but neither capture times nor numbers at"
            " the end of "
            "the photos' names identify them. Name the frames by their number"
            " (frame_000123.jpg)."
        )
    return rows


def _samples(path: Path) -> list[_Sample]:
    """Blocks of subtitles, which start with their number and a line `00:00:01,000 -->
    00:00:02,000`.
    """
    lines = [line for _, line in read_lines(path)]
    starts = [
        i
        for i, line in enumerate(lines)
        if "-->" in line and i > 0 and _INDEX.fullmatch(lines[i - 1])
    ]
    ends = [*(s - 1 for s in starts[1:]), len(lines)]
    samples = []
    for start, end in zip(starts, ends, strict=False):
        text = " ".join(lines[start + 1 : min(end, start + 40)])[:_MOST_BLOCK]
        row = _row(text)
        if row:
            clock = _CLOCK.search(text)
            time = parse_moment(clock[0].replace(",", ".")) if clock else None
            samples.append(_Sample(index=int(lines[start - 1]), time=time, row=row))
    return samples


def _row(text: str) -> SideRow | None:
    latitude, longitude = _value(text, "latitude"), _value(text, "long?t?itude")
    if latitude is None or longitude is None:
        old = _OLD.search(text)
        if not old:
            return None
        longitude, latitude = float(old[1]), float(old[2])
        if abs(latitude) > 90:
            longitude, latitude = latitude, longitude
    relative = _value(text, "rel_alt", "BAROMETER", r"(?<![\w.])H")
    absolute = _value(text, "abs_alt", "altitude")
    yaw, pitch, roll = (_value(text, f"gb_{a}") for a in ("yaw", "pitch", "roll"))
    return SideRow(
        name="",
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=relative if relative is not None else absolute,
        datum="takeoff" if relative is not None else "sea_level",
        angles_deg=None if yaw is None else (yaw, -90.0 if pitch is None else pitch, roll or 0.0),
    )


def _value(text: str, *names: str) -> float | None:
    for name in names:
        found = re.search(rf"{name}\s*[: ]\s*{_NUMBER}", text)
        if found:
            return float(found[1])
    return None


def _by_time(samples: list[_Sample], photos: Sequence[Photo]) -> tuple[SideRow, ...]:
    timed = sorted((s.time.replace(tzinfo=None), i) for i, s in enumerate(samples) if s.time)
    rows = []
    for photo in photos:
        if photo.time is None or not timed:
            continue
        moment = photo.time.replace(tzinfo=None)
        at = bisect_left(timed, (moment, 0))
        near = min(timed[max(at - 1, 0) : at + 1], key=lambda t: abs(t[0] - moment))
        if abs((near[0] - moment).total_seconds()) <= _NEAR_S:
            rows.append(replace(samples[near[1]].row, name=photo.name))
    return tuple(rows)


def _by_frame(samples: list[_Sample], photos: Sequence[Photo]) -> tuple[SideRow, ...]:
    by_index = {s.index: s.row for s in samples}
    numbers = [_FRAME.search(Path(p.name).stem) for p in photos]
    rows = [by_index.get(int(n[1])) if n else None for n in numbers]
    if any(row is None for row in rows):
        return ()
    return tuple(replace(row, name=p.name) for row, p in zip(rows, photos, strict=True) if row)
