"""What the boxes of an MP4 or MOV file say, which OpenCV does not tell: ISO/IEC 14496-12."""

import io
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import BinaryIO

from skyquilt.outside import open_regular
from skyquilt.video.codec_size import codec_sizes

_INSIDE = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"udta", b"meta", b"ilst")
_MP4 = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
_SYNC = 0x47
"""First byte of every packet of an MPEG transport stream, of 188 bytes or 192 with times."""
_MEDIA = ("vide", "soun", "text", "meta", "sbtl", "tmcd")
_MOST_BOXES, _MOST_DESCRIPTION = 4000, 1 << 16
_MODEL = re.compile(rb"(?:DJI|FC|Hasselblad|Autel|Parrot|GoPro|HERO)[ -~]{0,30}")
_SURE = re.compile(r"^(FC\d{3,4}\w?|DJI ?[A-Za-z0-9 ]{3,25}|L[12]D-20c|HERO\d+ .{3,10})$")


@dataclass(frozen=True, kw_only=True)
class Container:
    """The header of an MP4 or MOV file."""

    whole: bool
    """Whether it has an index (`moov`); a recording that was cut off has none."""
    kinds: tuple[str, ...]
    """Handlers of its tracks: `vide`, `soun`, `text`, `meta` ..."""
    created: datetime | None
    """When it was made, UTC."""
    model: str
    """Camera model as some makers write it; empty where there is none."""
    size: tuple[int, int] | None
    """Width and height in px that its first video track declares."""
    coded: tuple[tuple[int, int], ...] = ()
    """The same by the headers of its codecs, by which frames are allocated."""


def is_video(head: bytes) -> bool:
    """Whether the first 400 bytes of a file are those of a container of ours: MP4, MOV, AVI,
    Matroska or an MPEG transport stream.

    FFmpeg would also read text that names other files and addresses.
    """
    return (
        head[4:8] in _MP4
        or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")
        or head[:4] == b"\x1aE\xdf\xa3"
        or (len(head) > 188 and head[0] == head[188] == _SYNC)
        or (len(head) > 196 and head[4] == head[196] == _SYNC)
    )


def read_container(path: Path) -> Container | None:
    """The header of a clip; None where the file is no MP4 or MOV. Raises `OSError`."""
    with open_regular(path) as file:
        if not is_mp4(file):
            return None
        size = file.seek(0, io.SEEK_END)
        kinds: list[str] = []
        created, whole, model, declared = None, False, "", None
        coded: list[tuple[int, int]] = []
        for name, body, length in boxes(file, 0, size):
            whole |= name == b"moov"
            file.seek(body)
            if name == b"hdlr":
                kind = file.read(min(length, 12))[8:12].decode("latin-1")
                if kind in _MEDIA:  # of a track: QuickTime has others for its data
                    kinds.append(kind)
            elif name == b"mvhd":
                created = _created(file.read(min(length, 20)))
            elif name == b"udta" and not model:
                model = _model(file.read(min(length, 1 << 16)))
            elif name == b"stsd" and kinds[-1:] == ["vide"]:
                entry = file.read(min(length, _MOST_DESCRIPTION))
                coded += codec_sizes(entry)
                if declared is None and len(entry) >= 44:
                    declared = struct.unpack(">HH", entry[40:44])
    return Container(
        whole=whole,
        kinds=tuple(kinds),
        created=created,
        model=model,
        size=declared,
        coded=tuple(coded),
    )


def is_mp4(file: BinaryIO) -> bool:
    """Whether a file, read from its beginning, is an MP4 or MOV."""
    return file.read(12)[4:8] in _MP4


def boxes(file: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Names, starts of bodies and their lengths, depth first."""
    open_, count = [(start, end)], 0
    while open_ and count < _MOST_BOXES:
        at, stop = open_.pop()
        if at + 8 > stop:
            continue
        file.seek(at)
        length, name = struct.unpack(">I4s", file.read(8))
        body = at + 8
        if length == 1:
            length, body = struct.unpack(">Q", file.read(8).ljust(8, b"\0"))[0], at + 16
        after = stop if length == 0 else at + length
        if after <= at:
            continue
        count += 1
        open_.append((after, stop))
        yield name, body, min(after, stop) - body
        if name in _INSIDE:
            open_.append((body + (4 if name == b"meta" else 0), min(after, stop)))


def _created(data: bytes) -> datetime | None:
    if len(data) < 12:
        return None
    long_ = data[0] == 1 and len(data) >= 20
    seconds = struct.unpack(">Q", data[4:12])[0] if long_ else struct.unpack(">I", data[4:8])[0]
    # cameras whose clock is not set write 0 or dates of the eighties
    moment = datetime(1904, 1, 1, tzinfo=UTC) + timedelta(seconds=min(seconds, 2**33))
    return moment if moment.year >= 2000 else None


def _model(data: bytes) -> str:
    words = (m[0].decode("latin-1").strip() for m in _MODEL.finditer(data))
    return next((w for w in words if _SURE.match(w)), "")
