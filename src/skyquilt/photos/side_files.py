"""Positions from side files: CSV, OpenDroneMap's geo.txt, DJI's MRK; SRT has its own module."""

import os
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from skyquilt.errors import SideFileError
from skyquilt.geometry.frames import beside_deg
from skyquilt.model.photo import Datum, Photo
from skyquilt.outside import plain
from skyquilt.photos.pos_events import read_pos
from skyquilt.photos.position_tables import has_header, read_positions, states_crs, system_of
from skyquilt.photos.side_rows import (
    SideRow,
    accuracy,
    apply_rows,
    datum_of,
    finite,
    metres_of_height,
    number,
    of_one_flight,
    read_crs,
    read_lines,
    read_text,
    to_degrees,
    unit_notes,
    with_decimal_commas,
    with_points,
)
from skyquilt.photos.srt import read_srt


def apply_positions(
    photos: Sequence[Photo], file: Path, clock_offset_s: float | None = None
) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos with the positions from an `.mrk`, `.srt` or RTKLIB's `.pos` file, a track (GPX or
    a table with times; `clock_offset_s` as in `track_positions`), a table or a `geo.txt`, and
    notes.

    Raises `SideFileError` where the file is malformed or contains none of the photos.
    """
    ending = file.suffix.lower()
    if ending == ".mrk":
        here = os.path.realpath(file.parent)
        beside = {p.name for p in photos if os.path.realpath(p.path.parent) == here}
        rows = read_mrk(file, [p.name for p in photos], beside)
        return apply_rows(photos, rows, file=file, source="mrk")
    if ending == ".srt":
        return apply_rows(photos, read_srt(file, photos), file=file, source="srt")
    if ending == ".pos":
        events, told = read_pos(file, photos)
        placed, said = apply_rows(photos, events, file=file, source="pos")
        return placed, (*said, *told)
    if ending in (".gpx", ".csv"):
        from skyquilt.photos.track_positions import is_track, read_track_rows

        if is_track(file):
            found, told = read_track_rows(file, photos, clock_offset_s)
            placed, said = apply_rows(photos, found, file=file, source="gpx")
            return placed, (*said, *told)
    _check_kind(file)
    if _is_table(file):
        rows, notes = read_positions(file)
        placed, said = apply_rows(photos, rows, file=file, source="csv")
        return placed, (*said, *notes)
    placed, said = apply_rows(photos, read_geo_txt(file), file=file, source="geo.txt")
    crs = read_crs(read_lines(file)[0][1], file=file.name)
    heights = [row.altitude_m for row in read_geo_txt(file)]
    return placed, (*said, *unit_notes(file, crs, heights))


def _is_table(file: Path) -> bool:
    """Whether a file is a table of positions; otherwise it is a `geo.txt`."""
    first = next((line for _, line in read_lines(file)), "")
    if file.suffix.lower() in TABLE_ENDINGS:
        return not states_crs(first) or has_header(file)
    return has_header(file)


TABLE_ENDINGS = (".csv", ".tsv")
"""Endings of files that are tables whatever they begin with; others are where they have a header.
"""
_NO_TABLE = {
    "<": "XML (such as GPX, KML or a project of another program)",
    "{": "JSON",
    "[{": "JSON",
    "PK": "a ZIP archive or a spreadsheet",
}
"""How files begin that hold no lines of positions, and what they are."""


def _check_kind(file: Path) -> None:
    """Refuses files in other formats.

    Raises:
        SideFileError: it is in one.
    """
    begin = read_text(file)[:200].lstrip()
    known = next((said for head, said in _NO_TABLE.items() if begin.startswith(head)), None)
    if "<gpx" in begin:
        raise SideFileError(f"{file.name} is a GPX track; give it the ending .gpx.")
    if known:
        raise SideFileError(
            f"{file.name} is {known}, which is not read for the positions of photos. Export them as"
            " CSV with the columns name, lat, lon, alt, or as a geo.txt."
        )


def read_positions_csv(path: Path) -> tuple[SideRow, ...]:
    """One row per photo, see `position_tables.read_positions`."""
    return read_positions(path)[0]


if TYPE_CHECKING:
    from pyproj import Transformer


def read_geo_txt(path: Path) -> tuple[SideRow, ...]:
    """All rows, in degrees; raises `SideFileError` that names the wrong line."""
    lines = read_lines(path)
    if len(lines) < 2:
        raise SideFileError(
            f"{path.name} has {len(lines)} lines; expected a coordinate system and one line per"
            " photo."
        )
    crs = read_crs(lines[0][1], file=path.name)
    degrees, datum, system = to_degrees(crs), datum_of(crs), system_of(crs)
    unit_m = metres_of_height(crs)
    rows = (
        _geo_txt_row(text, f"{path.name}, line {i}", degrees, datum, unit_m)
        for i, text in lines[1:]
    )
    return tuple(replace(row, system=system) for row in rows)


def _geo_txt_row(
    line: str, place: str, degrees: "Transformer", datum: Datum, unit_m: float
) -> SideRow:
    name, numbers = _split(line)
    if not name or len(numbers) not in (2, 3, 6, 7, 8):
        raise SideFileError(
            f"{place}: expected 'name x y [z] [yaw pitch roll [hacc vacc]]', found"
            f" '{plain(line, 200)}'. Correct that line."
        )
    longitude, latitude = degrees.transform(numbers[0], numbers[1])
    values = [finite(v) for v in numbers[2:]] + [None] * 6
    angles = values[1:4]
    return SideRow(
        name=name,
        latitude_deg=finite(latitude),
        longitude_deg=finite(longitude),
        altitude_m=None if values[0] is None else values[0] * unit_m,
        datum=datum,
        angles_deg=(angles[0], angles[1], angles[2])
        if angles[0] is not None and angles[1] is not None and angles[2] is not None
        else None,
        sigma_xy_m=accuracy(values[4], place),
        sigma_z_m=accuracy(values[5], place) or accuracy(values[4], place),
    )


def _split(line: str) -> tuple[str, list[float]]:
    """The name (which may contain spaces) and the numbers after it."""
    line = line.replace(";", " ")
    words = line.split()
    if any(_GROUPED.fullmatch(w) for w in words):
        return "", []
    words = with_points(words) if with_decimal_commas(words) else line.replace(",", " ").split()
    numbers: list[float] = []
    while len(numbers) < _MOST_NUMBERS and words and (value := number(words[-1])) is not None:
        numbers.append(value)
        words.pop()
    return " ".join(words), numbers[::-1]


_MOST_NUMBERS = 12
_GROUPED = re.compile(r"[-+]?[0-9]{1,3}(?:,[0-9]{3})+\.[0-9]*|[-+]?[0-9]{1,3}(?:,[0-9]{3}){2,}")
"""Numbers whose thousands are separated by commas, which would be read as several numbers."""
_NUMBER = r"\s*+([-+]?[0-9]{1,15}(?:\.[0-9]{1,20}+)?)\s*+"
_LINE = re.compile(
    rf"^([0-9]{{1,9}})\s++\S++\s++\[[0-9]++\]{_NUMBER},\s*N{_NUMBER},\s*E{_NUMBER},\s*V"
    rf"{_NUMBER},\s*Lat{_NUMBER},\s*Lon{_NUMBER},\s*Ellh(?:{_NUMBER},{_NUMBER},{_NUMBER})?"
)
_SHOT = re.compile(r"^DJI_[0-9]{12,14}_([0-9]{4,6})(?=_|$)|_([0-9]{4,18})(?:_[A-Za-z]+)?$")
"""The number of a shot in a photo's name; behind it may stand the lens, and words of a mission."""


def read_mrk(
    path: Path, photo_names: Sequence[str], beside: Collection[str] = ()
) -> tuple[SideRow, ...]:
    """Camera positions of the photos whose index is in the file, of those `beside` it where photos
    of several flights have the same; raises `SideFileError`.
    """
    shots = {}
    for i, line in read_lines(path):
        found = _LINE.match(line)
        if not found:
            raise SideFileError(
                f"{path.name}, line {i}: expected a DJI shot record (index, time, [week], N, E, V,"
                " Lat, Lon, "
                f"Ellh ...), found '{plain(line, 60)}'. Use the file as the drone wrote it."
            )
        values = [float(v) if v else None for v in found.groups()[1:]]
        for value in values[6:]:
            accuracy(value, f"{path.name}, line {i}")
        shots[int(found[1])] = values
    indices = [i if (i := _index(name)) in shots else None for name in photo_names]
    if any(i is not None for i in indices):
        indices = of_one_flight(photo_names, indices, file=path.name, beside=beside)
    pairs = zip(photo_names, indices, strict=True)
    rows = tuple(_mrk_row(name, shots[i]) for name, i in pairs if i is not None)
    if not rows:
        raise SideFileError(
            f"{path.name} has shots {min(shots, default=0)} to {max(shots, default=0)}; no photo's"
            " name ends "
            "in one of these numbers. Photos must keep the drone's names, such as"
            " 100_0001_0023.JPG."
        )
    return rows


def _index(name: str) -> int:
    found = _SHOT.search(Path(name).stem)
    return int(found[1] or found[2]) if found else -1


def _mrk_row(name: str, shot: list[float | None]) -> SideRow:
    north, east, down, lat, lon, height, *sigmas = shot
    latitude, longitude = lat or 0.0, lon or 0.0
    latitude, longitude = beside_deg(
        latitude, longitude, east_m=(east or 0.0) / 1000, north_m=(north or 0.0) / 1000
    )
    plane = [s for s in sigmas[:2] if s]
    return SideRow(
        name=name,
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=(height or 0.0) - (down or 0.0) / 1000,
        datum="ellipsoid",
        sigma_xy_m=max(plane) if plane else None,
        sigma_z_m=sigmas[2],
    )
