"""DJI's telemetry of a video as subtitles, in all its layouts.

Old: `GPS(lon,lat,satellites) BAROMETER:12.3` (Mavic Pro), with `Hb:` for `BAROMETER:`, or
`F/2.8, ..., GPS (lon, lat, satellites), D .., H 6.00m, G.PRY (pitch, roll, yaw)` (Phantom 4, Mavic
Mini). Where the third number is a height (`0.0M`, decimals), the first is the latitude (Matrice
300). New: `[latitude: ..] [longitude: ..] [rel_alt: .. abs_alt: ..] [gb_yaw: ..]`, also spelt
`longtitude`, also without the line of times.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from skyquilt.errors import SideFileError
from skyquilt.outside import read_bounded, text_of

MOST_TELEMETRY_BYTES = 300_000_000
"""Largest file of positions: an hour at 60 frames per second has 100 MB."""
_END = r"(?=\s*[°a-zA-Z%,;\])<\s])"
"""What must follow a number: at the very end of a torn file it may lack digits."""
_BARE = r"([-+]?[0-9]{1,15}(?:\.[0-9]{1,20})?)"
_NUMBER = _BARE + _END
_FIELD = re.compile(r"([A-Za-z_][\w.]{0,40})\s*[:(\s]\s*" + _NUMBER)
_GPS = re.compile(rf"(?<![\w.])GPS\s*\(\s*{_BARE}\s*,\s*{_BARE}(?:\s*,\s*{_BARE}\s*([mM]?))?\s*\)")
_ANGLE = _BARE + r"[^\d,]{0,4}"
_ANGLES = {
    which: re.compile(rf"{which}\.PRY\s*\(\s*{_ANGLE},\s*{_ANGLE},\s*{_ANGLE}\)") for which in "GF"
}
_CLOCK = re.compile(
    r"(\d{4})[-./](\d{1,2})[-./](\d{1,2})[ T](\d{1,2}):(\d\d):(\d\d)(?:[.,](\d{1,6}))?(?![\d:])",
    re.ASCII,
)
_SPAN = re.compile(r"(\d{1,3}):(\d\d):(\d\d)[,.](\d{1,3})\s*-->", re.ASCII)
_COMMAS = (
    # `: 46,5001]`, `: 5,4 abs_alt`, `BAROMETER:20,5`; times keep their meaning
    (re.compile(r"(:\s*[-+]?[0-9]{1,15}),([0-9]{1,20})(?=[\]\smM°%<]|$)"), r"\1.\2"),
    # `H 85,80m`, `(-24,4°, 1,5°`
    (re.compile(r"(?<![0-9.,])([0-9]{1,6}),([0-9]{1,3})(?=\s?(?:m\b|m/s|°))"), r"\1.\2"),
    # `GPS(14,3004,46,5001,16)`
    (
        re.compile(
            r"(GPS\s*\(\s*[-+]?[0-9]{1,3}),([0-9]{3,15})(,\s*[-+]?[0-9]{1,3}),([0-9]{3,15})(?=[,)])"
        ),
        r"\1.\2\3.\4",
    ),
)
"""Decimal commas, as programs in other languages write them, and what they are replaced with."""
_FOCAL_MM = (5.0, 2000.0)
_INDEX = re.compile(r"[0-9]{1,18}")
_MOST_BLOCK = 4000
"""Characters of one subtitle that are searched."""


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One subtitle; None = it does not say so."""

    index: int
    """Its number."""
    start_s: float | None
    """When it is shown first, s from the start of the clip."""
    moment: datetime | None
    """The drone's clock, local time."""
    latitude_deg: float | None
    """WGS 84; None for none and for (0, 0)."""
    longitude_deg: float | None
    """WGS 84."""
    decimals: int
    """Decimals of latitude and longitude."""
    takeoff_m: float | None
    """Height above take-off."""
    sea_level_m: float | None
    """Height above sea level."""
    gimbal_deg: tuple[float, float, float] | None
    """Yaw, pitch (-90 = nadir), roll."""
    flight_yaw_deg: float | None
    """Heading of the aircraft."""
    focal_35mm: float | None
    """35 mm equivalent focal length in mm."""
    zoom: float | None
    """Digital zoom."""


def read_samples(path: Path) -> tuple[Sample, ...]:
    """All subtitles of a file, in its order; one that is torn lacks what is torn.

    Raises `SideFileError` where the file cannot be read or holds no subtitles.
    """
    text = side_text(path)
    if "\x00" in text:
        raise SideFileError(f"{path.name} is not a text file; expected DJI's telemetry subtitles.")
    samples = tuple(sample_of(index, block) for index, block in _blocks(text))
    if not samples:
        raise SideFileError(
            f"{path.name} contains no subtitles; expected DJI's telemetry, with blocks that start"
            " with a number and a line of times."
        )
    return samples


def side_text(path: Path) -> str:
    """A side file as text; raises `SideFileError` where it cannot be read, or is too large."""
    try:
        return text_of(read_bounded(path, MOST_TELEMETRY_BYTES))
    except OSError as error:
        raise SideFileError(
            f"{path} cannot be read ({error.strerror or error}); check the path and its"
            " permissions."
        ) from error


def _blocks(text: str) -> Iterator[tuple[int, str]]:
    """Numbers and texts of the subtitles.

    A block starts with a line that is only a number, followed by a line of times or a date.
    """
    lines = text.splitlines(keepends=True)
    starts = [
        i
        for i in range(len(lines) - 1)
        if _INDEX.fullmatch(lines[i].strip())
        and ("-->" in lines[i + 1] or _CLOCK.match(lines[i + 1].strip() + " "))
    ]
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=False):
        block = "".join(lines[start + 1 : min(end, start + 40)])
        yield int(lines[start].strip()), block


def sample_of(index: int, text: str) -> Sample:
    """What the text of one subtitle says; a number at its very end may be torn."""
    text = text[:_MOST_BLOCK]
    for commas, points in _COMMAS:
        text = commas.sub(points, text)
    said: dict[str, tuple[str, float]] = {}
    for name, number in _FIELD.findall(text):
        said.setdefault(name.lower(), (number, float(number)))

    def value(*names: str) -> float | None:
        return next((said[n][1] for n in names if n in said), None)

    latitude, longitude, decimals = _place(text, said)
    if latitude is None or longitude is None or (latitude == 0 and longitude == 0):
        latitude = longitude = None
    return Sample(
        index=index,
        start_s=_start(text),
        moment=_moment(text),
        latitude_deg=latitude,
        longitude_deg=longitude,
        decimals=decimals,
        takeoff_m=value("rel_alt", "barometer", "hb", "h"),
        sea_level_m=value("abs_alt", "altitude"),
        gimbal_deg=_gimbal(text, said),
        flight_yaw_deg=_third(_ANGLES["F"].search(text)),
        focal_35mm=_focal(said),
        zoom=value("dzoom_ratio"),
    )


def _place(text: str, said: dict[str, tuple[str, float]]) -> tuple[float | None, float | None, int]:
    """Latitude, longitude and the number of decimals."""
    far = next((said[n] for n in ("longitude", "longtitude", "longitute") if n in said), None)
    if far and "latitude" in said:
        return _sensible(said["latitude"][0], far[0])
    old = _GPS.search(text)
    if not old:
        return None, None, 0
    first, second, third, unit = old[1], old[2], old[3] or "", old[4]
    latitude_first = bool(unit) or "." in third
    if abs(float(first)) > 90:
        latitude_first = False
    elif abs(float(second)) > 90:
        latitude_first = True
    if latitude_first:
        return _sensible(first, second)
    return _sensible(second, first)


def _sensible(latitude: str, longitude: str) -> tuple[float | None, float | None, int]:
    """Both as numbers, and the greater number of decimals: zeros at the end may be left out."""
    if abs(float(latitude)) > 90 or abs(float(longitude)) > 180:
        return None, None, 0
    decimals = max(len(text.partition(".")[2]) for text in (latitude, longitude))
    return float(latitude), float(longitude), decimals


def _gimbal(text: str, said: dict[str, tuple[str, float]]) -> tuple[float, float, float] | None:
    if "gb_yaw" in said:
        pitch = said.get("gb_pitch", ("", -90.0))[1]
        return said["gb_yaw"][1], pitch, said.get("gb_roll", ("", 0.0))[1]
    found = _ANGLES["G"].search(text)
    if not found:
        return None
    pitch, roll, yaw = (float(v) for v in found.groups())
    return yaw, pitch, roll


def _third(found: re.Match[str] | None) -> float | None:
    return float(found[3]) if found else None


def _focal(said: dict[str, tuple[str, float]]) -> float | None:
    """`focal_len: 24.00`, or in tenths `focal_len : 240`."""
    if "focal_len" not in said:
        return None
    text, value = said["focal_len"]
    value = value if "." in text else value / 10
    return value if _FOCAL_MM[0] <= value <= _FOCAL_MM[1] else None


def _start(text: str) -> float | None:
    found = _SPAN.search(text)
    if not found:
        return None
    hours, minutes, seconds = (int(found[i]) for i in (1, 2, 3))
    return hours * 3600 + minutes * 60 + seconds + int(found[4].ljust(3, "0")) / 1000


def _moment(text: str) -> datetime | None:
    """The clock; Mavics write milli- and microseconds as `,745,078`, which are read as `.745`."""
    found = _CLOCK.search(re.sub(r"(:\d\d[.,]\d{1,3}),\d.*", r"\1 ", text) + " ")
    if not found:
        return None
    try:
        year, month, day, hour, minute, second = (int(found[i]) for i in range(1, 7))
        micro = int((found[7] or "0").ljust(6, "0"))
        return datetime(year, month, day, hour, minute, second, micro)
    except ValueError:
        return None
