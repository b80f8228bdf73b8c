"""Reads a clip's header, and the positions beside it, as a `Clip`."""

import hashlib
import io
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import cv2

from skyquilt.errors import SideFileError, UnreadablePhotoError
from skyquilt.model.clip import Clip, Track
from skyquilt.model.photo import RejectedPhoto
from skyquilt.outside import check_picture, open_regular
from skyquilt.video.container import Container, is_video, read_container
from skyquilt.video.decoder import Decoder
from skyquilt.video.inside import track_inside
from skyquilt.video.lens import video_focal, video_shutter
from skyquilt.video.tracks import TRACK_ENDINGS, is_timed_csv, read_track

CLIP_ENDINGS = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mkv", ".mts", ".m2ts", ".webm"})
_SMALLEST = 64
MOST_FRAME_MP = 50.0
"""Largest area of a frame in megapixels: 8K has 33."""
_PIECES, _PIECE = 64, 1 << 16


def read_clip(path: Path, *, name: str, track: Track | None = None) -> Clip | RejectedPhoto:
    """The header of a clip, without looking through it; a bad one is a `RejectedPhoto`.

    `track` replaces the positions beside it (`.srt`, `.gpx` or timed `.csv` of the same name) and
    in it.
    """
    try:
        return _clip(path, name, track)
    except UnreadablePhotoError as error:
        return RejectedPhoto(name=name, reason=str(error))
    except OSError as error:
        return RejectedPhoto(name=name, reason=f"it cannot be read ({error.strerror or error})")
    except cv2.error as error:
        return RejectedPhoto(name=name, reason=f"OpenCV cannot decode it ({error.code})")


def _clip(path: Path, name: str, track: Track | None) -> Clip:
    with open_regular(path) as file:
        head = file.read(400)
    box = read_container(path)
    _check(path, head, box)
    decoder = Decoder(path)
    try:
        if min(decoder.width, decoder.height) > 0:
            _check_size(decoder.width, decoder.height)
        if decoder.at(0.0) is None:
            raise UnreadablePhotoError("it is a video without a frame that can be decoded")
    finally:
        decoder.close()
    notes: tuple[str, ...] = ()
    if track is None:
        track, notes = _positions(path)
    start = _start(track, box)
    size = (decoder.width, decoder.height)
    focal_35mm, zoom = (track.focal_35mm, track.zoom) if track else (None, 1.0)
    model = box.model if box else ""
    return Clip(
        name=name,
        path=path,
        digest=_digest(path),
        width=size[0],
        height=size[1],
        fps=decoder.fps,
        frames=decoder.frames,
        codec=decoder.codec,
        rotation_deg=decoder.rotation_deg,
        start=start,
        model=model,
        camera_key=_camera_key(model or "camera", size, focal_35mm, zoom),
        focal=video_focal(*size, focal_35mm, zoom),
        shutter=video_shutter(decoder.fps),
        track=track,
        notes=(*notes, *_notes(decoder, track, start)),
    )


def _check(path: Path, head: bytes, box: Container | None) -> None:
    if not head:
        raise UnreadablePhotoError("it is empty (0 bytes)")
    if not is_video(head):
        raise UnreadablePhotoError(
            "no video in it can be decoded: it is no MP4, MOV, AVI, MKV, MTS"
        )
    if box is None:
        return
    if not box.whole:
        raise UnreadablePhotoError(
            "its recording was cut off: it has no index (moov), which cameras write at the end"
        )
    if box.kinds and "vide" not in box.kinds:
        held = "sound only" if "soun" in box.kinds else "no pictures"
        raise UnreadablePhotoError(f"it is a video file with {held}")
    for size in (box.size, *box.coded):
        if size is not None and min(size) > 0:
            _check_size(*size)


def _check_size(width: int, height: int) -> None:
    """Refuses frames by their declared size: decoders keep up to 16 of them."""
    if min(width, height) < _SMALLEST:
        raise UnreadablePhotoError(
            f"its frames have only {width}x{height} px; at least {_SMALLEST} a side are needed"
        )
    check_picture(width, height, 3, most_mp=MOST_FRAME_MP, option=" of a frame")


def _digest(path: Path) -> str:
    """BLAKE2b of the size, the ends and 64 pieces between them: an hour of 4K has 30 GB."""
    digest = hashlib.blake2b(digest_size=16)
    with open_regular(path) as file:
        size = file.seek(0, io.SEEK_END)
        digest.update(str(size).encode())
        last = max(size - _PIECE, 0)
        for at in sorted({last * i // _PIECES for i in range(_PIECES + 1)}):
            file.seek(at)
            digest.update(file.read(_PIECE))
    return digest.hexdigest()


def side_files(path: Path) -> list[Path]:
    """Files of positions beside a clip, of the same name: the telemetry first."""
    try:
        same = [p for p in path.parent.iterdir() if p.stem.lower() == path.stem.lower()]
    except OSError:
        return []
    found = [p for p in same if p.suffix.lower() in TRACK_ENDINGS and p.is_file()]
    found = [p for p in found if p.suffix.lower() != ".csv" or is_timed_csv(p)]
    return sorted(found, key=lambda p: TRACK_ENDINGS.index(p.suffix.lower()))


def _positions(path: Path) -> tuple[Track | None, tuple[str, ...]]:
    """Those of the first file beside a clip that holds some, otherwise those in the clip, and notes
    on files that hold none.
    """
    notes: list[str] = []
    for file in side_files(path):
        try:
            return read_track(file), tuple(notes)
        except SideFileError as error:
            notes.append(f"{str(error).rstrip('.')}; it was not used.")
    return track_inside(path), tuple(notes)


def _start(track: Track | None, box: Container | None) -> datetime | None:
    if track is not None and track.start is not None:
        return track.start
    return box.created if box else None


def _camera_key(model: str, size: Sequence[int], focal_35mm: float | None, zoom: float) -> str:
    parts = ["video", model.lower(), f"{size[0]}x{size[1]}"]
    parts += [f"{focal_35mm:g}mm"] if focal_35mm else []
    parts += [f"zoom {zoom:g}"] if zoom > 1 else []
    return " ".join(parts)


def _notes(decoder: Decoder, track: Track | None, start: datetime | None) -> tuple[str, ...]:
    out = []
    if decoder.rotation_deg % 360:
        out.append(
            f"A player shows it turned by {decoder.rotation_deg} degrees; its frames are read as"
            " the sensor recorded them."
        )
    if track is None:
        out.append("No positions are in it or beside it.")
    elif track.repeats:
        out.append(
            f"{track.file} holds {len(track.time_s)} positions; {track.repeats} more rows only"
            " repeat the one before and do not count as measurements."
        )
    if track is not None and track.zeros:
        out.append(f"{track.zeros} rows of {track.file} have no position.")
    if start is None:
        out.append("It does not tell when it was filmed.")
    return tuple(out)
