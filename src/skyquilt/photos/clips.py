"""The clips of a survey, and the frames chosen from them as `Photo`s."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from skyquilt.errors import SideFileError
from skyquilt.model.clip import ChosenFrames, Clip, Track
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.outside import PHOTO_ENDINGS, hidden, walk
from skyquilt.photos.kept_frames import KEPT_QUALITY
from skyquilt.photos.position_tables import has_header
from skyquilt.photos.read import read_photo
from skyquilt.photos.video_modes import with_mode
from skyquilt.video.fixes import Fix, track_of
from skyquilt.video.positions import attitude_at, clip_zero, flight_yaw_at, places_at, position_at
from skyquilt.video.read import read_clip
from skyquilt.video.tracks import TRACK_ENDINGS, is_timed_csv, merged, read_track

_SAME_START_S = 2.0


def is_timed(side: Path) -> bool:
    """Whether a side file holds positions by time, as clips need, not by the names of photos."""
    ending = side.suffix.lower()
    timed = ending == ".csv" and is_timed_csv(side) and not has_header(side)
    return timed or side.is_dir() or ending in (".srt", ".gpx")


def read_clips(
    found: Sequence[tuple[str, Path]], side: Path | None
) -> tuple[tuple[Clip, ...], list[RejectedPhoto]]:
    """Clips by name and path, each file once, with the positions in `side` where it is given.

    Raises `SideFileError` where `side` holds none.
    """
    timed = side if side is not None and is_timed(side) else None
    common = read_track(timed) if timed is not None and timed.is_file() else None
    read = []
    for name, path in found:
        track = common
        if timed is not None and timed.is_dir():
            track = track_in_folder(timed, path)
        clip = read_clip(path, name=name, track=track)
        read.append(with_mode(clip) if isinstance(clip, Clip) else clip)
    bad = [c for c in read if isinstance(c, RejectedPhoto)]
    good: dict[str, Clip] = {}
    for clip in (c for c in read if isinstance(c, Clip)):
        first = good.setdefault(clip.digest, clip)
        if first is not clip:
            bad.append(RejectedPhoto(name=clip.name, reason=f"same file content as {first.name}"))
    return tuple(good.values()), bad


def track_in_folder(folder: Path, clip: Path) -> Track:
    """The positions in a folder that belong to a clip: those of the file with its name, otherwise
    of all files with absolute times, photos included.

    Raises `SideFileError` where there are none.
    """
    files = sorted(
        p
        for here, _, names in walk(folder)
        for name in names
        if not hidden(name) and (p := here / name).is_file()
    )
    timed = [
        p
        for p in files
        if p.suffix.lower() in TRACK_ENDINGS and (p.suffix.lower() != ".csv" or is_timed_csv(p))
    ]
    for file in timed:
        if file.stem.lower() == clip.stem.lower():
            return read_track(file)
    tracks = [t for t in (_absolute(p) for p in timed) if t is not None]
    tracks += _of_photos(folder, [p for p in files if p.suffix.lower() in PHOTO_ENDINGS])
    if not tracks:
        raise SideFileError(
            f"{folder} contains no timed positions; expected .srt, .gpx or .csv files, or photos"
            " with positions and times."
        )
    return merged(tracks, file=folder.name)


def _absolute(file: Path) -> Track | None:
    """A track in seconds since 1970; None where it counts from the start of another clip."""
    try:
        track = read_track(file)
    except SideFileError:
        return None
    if not track.on_clip:
        return track
    if track.start is None:
        return None
    zero = track.start.replace(tzinfo=UTC).timestamp()
    return replace(
        track, on_clip=False, time_s=track.time_s + zero, height_time_s=track.height_time_s + zero
    )


def _of_photos(folder: Path, files: Sequence[Path]) -> list[Track]:
    photos = [p for p in (read_photo(f) for f in files) if isinstance(p, Photo)]
    fixes = [
        Fix(
            time_s=p.time.replace(tzinfo=UTC).timestamp(),
            latitude_deg=p.position.latitude_deg,
            longitude_deg=p.position.longitude_deg,
            takeoff_m=_number(p.position.takeoff_m),
            sea_level_m=_number(p.position.sea_level_m),
        )
        for p in photos
        if p.time is not None and p.position is not None
    ]
    if not fixes:
        return []
    return [track_of(fixes, file=folder.name, source="photos", on_clip=False, step_deg=1e-7)]


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def after_others(clips: Sequence[Clip]) -> list[float]:
    """Seconds by which each clip begins after the start that it states: of a recording that the
    camera divided into files, each may state the time at which the first began.
    """
    late: list[float] = []
    for k, clip in enumerate(clips):
        same = [
            late[j] + c.duration_s
            for j, c in enumerate(clips[:k])
            if c.camera_key == clip.camera_key
            and c.start is not None
            and clip.start is not None
            and abs((c.start - clip.start).total_seconds()) <= _SAME_START_S
        ]
        late.append(max(same, default=0.0))
    return late


def frames_of(
    clip: Clip, chosen: ChosenFrames, *, number: int, use_track: bool, late_s: float = 0.0
) -> list[Photo]:
    """The chosen frames of a clip as photos, with positions and angles of its track at their times.

    `number`: of the clip in the survey. A clip that does not tell when it was filmed is filed under
    a day of its own, so that its frames keep their order and distances in time. `late_s`: how much
    later than its start it begins.
    """
    times = np.array([f.time_s for f in chosen.chosen])
    track = clip.track if use_track else None
    there = times
    places = None
    if track is not None:
        there = times + clip_zero(track, clip) + chosen.offset_s
        places = places_at(track, there)
    unknown = datetime(1970, 1, 1) + timedelta(days=number)
    start = clip.start.replace(tzinfo=None) if clip.start else unknown
    photos = []
    for i, frame in enumerate(chosen.chosen):
        when = float(there[i])
        key = f"{clip.digest}|{frame.time_s:.6f}|{KEPT_QUALITY}"
        photos.append(
            Photo(
                name=chosen.name(frame),
                path=clip.path,
                frame_s=frame.time_s,
                digest=hashlib.blake2b(key.encode(), digest_size=16).hexdigest(),
                width=clip.width,
                height=clip.height,
                channels=3,
                dtype="uint8",
                band="visible",
                camera_key=clip.camera_key,
                focal=clip.focal,
                position=position_at(track, places, i, when) if track and places else None,
                attitude=attitude_at(track, when) if track else None,
                flight_yaw_deg=flight_yaw_at(track, when) if track else None,
                time=start + timedelta(seconds=frame.time_s + late_s),
                rolling_shutter=True,
                shutter=clip.shutter,
            )
        )
    return photos
