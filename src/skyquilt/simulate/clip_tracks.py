"""Telemetry within a clip, as some cameras write it: tracks of an MP4 file (ISO/IEC 14496-12).

DJI's Mini 2 writes subtitles, newer drones a message of Protocol Buffers a frame, GoPro's cameras
GPMF. Numbers of fields: see `skyquilt.video.dji_frames` and `skyquilt.video.gopro`, which share no
code with this.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from skyquilt.errors import OutputError
from skyquilt.simulate.grid import Doubles
from skyquilt.simulate.reported import Report
from skyquilt.simulate.settings import Video
from skyquilt.simulate.video import fixed_in

_SCALE = 1000
"""Ticks per second."""
_MATRIX = struct.pack(">9I", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)


@dataclass(frozen=True, kw_only=True)
class DataTrack:
    """A track to be written."""

    form: bytes
    """Four letters that tell what the samples are."""
    handler: bytes
    """Kind of track."""
    samples: Sequence[tuple[float, bytes]]
    """How long each lasts in s, and its bytes."""


def track_in_clip(
    reports: Sequence[Report], times: Doubles, video: Video, start: datetime
) -> DataTrack | None:
    """The telemetry of frames taken at `times` (n,) s; None for a layout that lies beside clips."""
    make = _LAYOUTS.get(video.layout)
    if make is None:
        return None
    track = make(reports, times, video, start)
    if not video.shift:
        return track
    # the receiver's clock is late: what it says now was so before
    empty = (video.shift, _EMPTY[track.form])
    return DataTrack(form=track.form, handler=track.handler, samples=[empty, *track.samples])


def add_track(path: Path, track: DataTrack) -> None:
    """Adds a track to a clip whose index is its last box, as OpenCV writes them."""
    whole = path.read_bytes()
    at, boxes = 0, list[bytes]()
    while at < len(whole):
        (length,) = struct.unpack_from(">I", whole, at)
        boxes.append(whole[at : at + length])
        at += max(length, 8)
    if not boxes or boxes[-1][4:8] != b"moov":
        raise OutputError(f"{path} is no clip with its index at the end")
    front, index = b"".join(boxes[:-1]), boxes[-1][8:]
    data = _box(b"mdat", b"".join(body for _, body in track.samples))
    (header,) = struct.unpack_from(">I", index)
    (number,) = struct.unpack_from(">I", index, header - 4)  # the movie header ends with the next
    movie = index[: header - 4] + struct.pack(">I", number + 1)
    added = _trak(track, number, len(front) + 8)
    path.write_bytes(front + data + _box(b"moov", movie, index[header:], added))


def _box(name: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">I4s", 8 + len(body), name) + body


def _full(name: bytes, *parts: bytes, flags: int = 0) -> bytes:
    return _box(name, struct.pack(">I", flags), *parts)


def _trak(track: DataTrack, number: int, offset: int) -> bytes:
    """The index of a track whose samples lie one after the other from `offset` on."""
    ticks = np.diff(np.round(np.cumsum([0.0, *(s for s, _ in track.samples)]) * _SCALE))
    lasts, count = int(ticks.sum()), len(track.samples)
    entry = bytes(7) + b"\1" + (_TEXT_STYLE if track.form == b"tx3g" else bytes(4))
    table = _box(
        b"stbl",
        _full(b"stsd", struct.pack(">I", 1), _box(track.form, entry)),
        _full(b"stts", struct.pack(">I", count), *(struct.pack(">II", 1, int(t)) for t in ticks)),
        _full(b"stsc", struct.pack(">IIII", 1, 1, count, 1)),
        _full(
            b"stsz",
            struct.pack(">II", 0, count),
            *(struct.pack(">I", len(body)) for _, body in track.samples),
        ),
        _full(b"stco", struct.pack(">II", 1, offset)),
    )
    source = _box(b"dinf", _full(b"dref", struct.pack(">I", 1), _full(b"url ", flags=1)))
    media = _box(
        b"mdia",
        _full(b"mdhd", struct.pack(">IIIIHH", 0, 0, _SCALE, lasts, 0x55C4, 0)),
        _full(b"hdlr", bytes(4), track.handler, bytes(12), b"telemetry\0"),
        _box(b"minf", _full(b"nmhd"), source, table),
    )
    head = struct.pack(">IIIII", 0, 0, number, 0, lasts) + bytes(16) + _MATRIX + bytes(8)
    return _box(b"trak", _full(b"tkhd", head, flags=3), media)


_TEXT_STYLE = (
    bytes(4) + b"\1\xff" + bytes(4 + 8 + 8) + b"\0\0\0\0" + _box(b"ftab", b"\0\1\0\1\5Serif")
)
_EMPTY = {b"tx3g": bytes(2), b"gpmd": bytes(0), b"djmd": bytes(0)}
"""A sample that says nothing."""


def _subtitles(
    reports: Sequence[Report], times: Doubles, video: Video, start: datetime
) -> DataTrack:
    """DJI Mini 2: a line a second, with positions of four decimals, without a clock."""
    samples = []
    for second in np.arange(0.0, times[-1] + 1e-9):
        frame = min(round(second * video.fps), len(reports) - 1)
        place, here = reports[fixed_in(times[frame], video, len(reports))], reports[frame]
        text = (
            f"F/2.8, SS 400.0, ISO 100, EV 0, GPS ({place.longitude or 0:.4f},"
            f" {place.latitude or 0:.4f}, 15), D 50.00m, H {here.takeoff or 0:.2f}m,"
            " H.S 5.00m/s, V.S 0.00m/s "
        ).encode()
        samples.append((1.0, struct.pack(">H", len(text)) + text))
    return DataTrack(form=b"tx3g", handler=b"sbtl", samples=samples)


def _messages(
    reports: Sequence[Report], times: Doubles, video: Video, start: datetime
) -> DataTrack:
    """DJI Mini 4 Pro: a message a frame, with places in radians and the gimbal's angles."""
    samples = []
    for number, (here, time) in enumerate(zip(reports, times, strict=True), 1):
        at = reports[fixed_in(time, video, len(reports))]
        yaw, pitch, roll = here.gimbal or (0.0, -90.0, 0.0)
        place = _double(2, np.radians(at.latitude or 0)) + _double(3, np.radians(at.longitude or 0))
        drone = _message(
            3,
            _message(3, _integer(3, round(10 * (here.flight_yaw or 0)))),
            _message(4, _message(1, place), _integer(2, round(1000 * (here.sea_level or 0)))),
            _message(5, b"\x0d" + struct.pack("<f", 1000 * (here.takeoff or 0))),
        )
        gimbal = _message(
            3, *(_integer(k, round(10 * v)) for k, v in ((1, pitch), (2, roll), (3, yaw)))
        )
        frame = _message(3, _message(1, _integer(1, number)), drone, _message(4, gimbal))
        samples.append((1 / video.fps, frame))
    return DataTrack(form=b"djmd", handler=b"meta", samples=samples)


def _varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _integer(number: int, value: int) -> bytes:
    """A field with an integer; 0 is left out, as the format does."""
    return _varint(number << 3) + _varint(value) if value else b""


def _double(number: int, value: float) -> bytes:
    return _varint(number << 3 | 1) + struct.pack("<d", value)


def _message(number: int, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return _varint(number << 3 | 2) + _varint(len(body)) + body


def _gopro(reports: Sequence[Report], times: Doubles, video: Video, start: datetime) -> DataTrack:
    """GoPro HERO5 to HERO10: the fixes of a second together, heights above sea level."""
    samples = []
    each = 1 / video.fixes_per_second
    for second in np.arange(0.0, times[-1] + 1e-9):
        length = min(1.0, float(times[-1]) + 1 / video.fps - float(second))
        moments = np.arange(second, second + length - 1e-6, each)
        rows = b""
        for moment in moments:
            r = reports[fixed_in(moment, video, len(reports))]
            place = (1e7 * (r.latitude or 0), 1e7 * (r.longitude or 0), 1e3 * (r.sea_level or 0))
            rows += struct.pack(">5i", *(round(v) for v in place), 5000, 500)
        clock = start + timedelta(seconds=float(second))
        told = clock.astimezone(UTC) if clock.tzinfo else clock
        stream = (
            _klv(b"STNM", "c", 1, b"GPS (Lat., Long., Alt., 2D speed, 3D speed)")
            + _klv(b"GPSF", "L", 4, struct.pack(">I", 3))
            + _klv(b"GPSU", "c", 16, f"{told:%y%m%d%H%M%S}.{told.microsecond // 1000:03d}".encode())
            + _klv(b"GPSP", "S", 2, struct.pack(">H", 180))
            + _klv(b"GPSA", "F", 4, b"MSLV")
            + _klv(b"UNIT", "c", 3, b"degdegm\0\0m/sm/s")
            + _klv(b"SCAL", "l", 4, struct.pack(">5i", 10**7, 10**7, 1000, 1000, 100))
            + _klv(b"GPS5", "l", 20, rows)
        )
        shaken = _klv(b"SCAL", "s", 2, b"\x01\xa2") + _klv(b"ACCL", "s", 6, bytes(600))
        streams = _klv(b"STRM", "\0", 1, shaken) + _klv(b"STRM", "\0", 1, stream)
        name = _klv(b"DVNM", "c", 1, b"HERO9 Black")
        samples.append((length, _klv(b"DEVC", "\0", 1, name + streams)))
    return DataTrack(form=b"gpmd", handler=b"meta", samples=samples)


def _klv(key: bytes, kind: str, size: int, body: bytes) -> bytes:
    """A key, its type, and elements of `size` bytes."""
    head = struct.pack(">4sBBH", key, ord(kind), size, len(body) // size)
    return head + body + bytes(-len(body) % 4)


_LAYOUTS: dict[str, Callable[[Sequence[Report], Doubles, Video, datetime], DataTrack]] = {
    "mini2": _subtitles,
    "mini4": _messages,
    "gopro": _gopro,
}
