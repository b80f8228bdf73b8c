"""When the photo was taken."""

import re
from datetime import UTC, datetime, timedelta, timezone

from skyquilt.photos import exif as tag
from skyquilt.photos.exif import Exif, as_number, as_text
from skyquilt.photos.xmp import Xmp

_MOMENT = re.compile(
    r"(\d{4})[:\-/.](\d\d)[:\-/.](\d\d)[ T](\d\d):(\d\d):(\d\d)(\.\d+)?\s*(Z|[+-]\d\d:?\d\d)?"
)


def read_time(exif: Exif, xmp: Xmp) -> datetime | None:
    """EXIF DateTimeOriginal with sub-seconds and offset, else the GPS clock (UTC), else XMP; None
    if none.
    """
    moment = parse_moment(exif.text(tag.TAKEN), exif.text(tag.SUBSEC), exif.text(tag.OFFSET))
    if moment is None:
        moment = _gps_time(exif)
    if moment is None:
        moment = parse_moment(
            xmp.text("exif:DateTimeOriginal", "xmp:CreateDate", "photoshop:DateCreated")
        )
    return moment or parse_moment(exif.text(tag.MODIFIED))


def modified_time(exif: Exif) -> datetime | None:
    """EXIF DateTime: when the file was last written by something that says so."""
    return parse_moment(exif.text(tag.MODIFIED))


def parse_moment(text: str, subseconds: str = "", offset: str = "") -> datetime | None:
    """`2016:06:23 16:31:59` (also ISO 8601) with sub-seconds and `+02:00` inside or apart; else
    None.
    """
    found = _MOMENT.match(text.strip())
    if not found:
        return None
    fraction = found[7] or (f".{subseconds}" if subseconds.isdigit() else "")
    try:
        moment = datetime(*(int(found[i]) for i in range(1, 7)))  # type: ignore[arg-type]
        moment += timedelta(seconds=float(fraction or 0))
        return moment.replace(tzinfo=_zone(found[8] or offset))
    except (ValueError, OverflowError):
        return None


def _zone(text: str) -> timezone | None:
    found = re.fullmatch(r"([+-])(\d\d):?(\d\d)", text.strip())
    if not found:
        return UTC if text.strip() == "Z" else None
    away = timedelta(hours=int(found[2]), minutes=int(found[3]))
    return timezone(-away if found[1] == "-" else away)


def _gps_time(exif: Exif) -> datetime | None:
    clock = exif.gps.get(tag.GPS_TIME)
    parts = [as_number(p) for p in clock] if isinstance(clock, (tuple, list)) else []
    day = parse_moment(as_text(exif.gps.get(tag.GPS_DATE)) + " 00:00:00")
    if day is None or len(parts) != 3 or None in parts:
        return None
    hours, minutes, seconds = (p or 0.0 for p in parts)
    try:
        return (day + timedelta(hours=hours, minutes=minutes, seconds=seconds)).replace(tzinfo=UTC)
    except OverflowError:
        return None
