"""Telemetry that a clip holds itself: DJI's and GoPro's tracks of data, and DJI's subtitles."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from skyquilt.errors import SideFileError
from skyquilt.model.clip import Track
from skyquilt.outside import text_of
from skyquilt.video.dji_frames import dji_fix
from skyquilt.video.fixes import track_of
from skyquilt.video.gopro import gopro_fixes
from skyquilt.video.srt import MOST_TELEMETRY_BYTES, sample_of
from skyquilt.video.timed_data import DataTrack, data_tracks, read_data
from skyquilt.video.tracks import track_of_subtitles

_STEP_DEG = 1e-7
_LEAST_APART_S = 0.1
"""Messages of frames are read ten times a second: no receiver of a drone measures more often."""


def track_inside(path: Path) -> Track | None:
    """The positions in a clip; None where there are none. Raises `OSError`."""
    tracks = data_tracks(path)
    for form, read in _READERS.items():
        for track in tracks:
            if track.form != form:
                continue
            try:
                return read(path, track)
            except SideFileError:  # it holds no position
                continue
    return None


def _named(path: Path) -> str:
    return f"{path.name} (telemetry)"


def _of_dji(path: Path, track: DataTrack) -> Track:
    found, last = [], -_LEAST_APART_S
    for i, message in read_data(path, track, MOST_TELEMETRY_BYTES):
        time = float(track.start_s[i])
        if time - last < _LEAST_APART_S - 1e-6:
            continue
        last = time
        if (fix := dji_fix(message, time)) is not None:
            found.append(fix)
    return track_of(found, file=_named(path), source="clip", on_clip=True, step_deg=_STEP_DEG)


def _of_gopro(path: Path, track: DataTrack) -> Track:
    found = gopro_fixes(
        (float(track.start_s[i]), float(track.length_s[i]), data)
        for i, data in read_data(path, track, MOST_TELEMETRY_BYTES)
    )
    return track_of(
        found.fixes,
        file=_named(path),
        source="clip",
        on_clip=True,
        step_deg=_STEP_DEG,
        start=found.start,
    )


def _of_subtitles(path: Path, track: DataTrack) -> Track:
    samples = []
    for i, data in read_data(path, track, MOST_TELEMETRY_BYTES):
        length = int.from_bytes(data[:2], "big")
        if length:
            sample = sample_of(i, text_of(data[2 : 2 + length]) + "\n")
            samples.append(replace(sample, start_s=float(track.start_s[i])))
    return track_of_subtitles(samples, file=_named(path))


_READERS: dict[str, Callable[[Path, DataTrack], Track]] = {
    "djmd": _of_dji,
    "gpmd": _of_gopro,
    "tx3g": _of_subtitles,
    "text": _of_subtitles,
}
"""Forms of tracks and their readers, the one that tells most first."""
