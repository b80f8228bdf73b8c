"""DJI's `.SRT`, telemetry of a video as subtitles, for photos that are frames taken from it.

`skyquilt.video.srt` reads its layouts.
"""

import re
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from skyquilt.errors import SideFileError
from skyquilt.geometry.frames import belly_from_gimbal
from skyquilt.model.photo import Photo
from skyquilt.photos.side_rows import SideRow, of_one_flight
from skyquilt.video.srt import Sample, read_samples

_FRAME = re.compile(r"(?:^|frame|[_-])([0-9]{1,18})$", re.IGNORECASE)
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
    samples = [_placed(s) for s in read_samples(path) if s.latitude_deg is not None]
    if not samples:
        raise SideFileError(
            f"{path.name} contains no latitude and longitude; expected a DJI telemetry subtitle"
            " file."
        )
    rows = _by_time(samples, photos) or _by_frame(samples, photos, path.name)
    if not rows:
        raise SideFileError(
            f"{path.name} has {len(samples)} positions, but neither capture times nor numbers at"
            " the end of "
            "the photos' names identify them. Name the frames by their number"
            " (frame_000123.jpg)."
        )
    return rows


def _placed(sample: Sample) -> _Sample:
    relative = sample.takeoff_m
    row = SideRow(
        name="",
        latitude_deg=sample.latitude_deg,
        longitude_deg=sample.longitude_deg,
        altitude_m=relative if relative is not None else sample.sea_level_m,
        datum="takeoff" if relative is not None else "sea_level",
        angles_deg=None if sample.gimbal_deg is None else belly_from_gimbal(*sample.gimbal_deg),
    )
    return _Sample(index=sample.index, time=sample.moment, row=row)


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


def _by_frame(samples: list[_Sample], photos: Sequence[Photo], file: str) -> tuple[SideRow, ...]:
    by_index = {s.index: s.row for s in samples}
    found = [_FRAME.search(Path(p.name).stem) for p in photos]
    numbers = [None if n is None else int(n[1]) for n in found]
    rows = [by_index.get(n) if n is not None else None for n in numbers]
    if any(row is None for row in rows):
        return ()
    of_one_flight([p.name for p in photos], numbers, file=file)
    return tuple(replace(row, name=p.name) for row, p in zip(rows, photos, strict=True) if row)
