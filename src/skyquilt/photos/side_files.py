"""Positions from side files: CSV, OpenDroneMap's geo.txt, DJI's MRK; SRT has its own module."""

import math
import os
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from skyquilt.errors import SideFileError
from skyquilt.model.photo import Datum, Photo
from skyquilt.outside import plain
from skyquilt.photos.side_rows import (
    SideRow,
    accuracy,
    apply_rows,
    finite,
    metres_of_height,
    number,
    of_one_flight,
    read_crs,
    read_lines,
    read_table,
    sentence_of,
    unit_notes,
    with_decimal_commas,
    with_points,
)
from skyquilt.photos.srt import read_srt


def apply_positions(
    photos: Sequence[Photo], file: Path
) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos with the positions from a `.csv`, `.mrk`, `.srt` or (any other ending) `geo.txt`
    file, and notes.

    Raises `SideFileError` where the file is malformed or contains none of the photos.
    """
    ending = file.suffix.lower()
    if ending == ".csv":
        rows, notes = _read_csv(file)
        placed, said = apply_rows(photos, rows, file=file, source="csv")
        return placed, (*said, *notes)
    if ending == ".mrk":
        here = os.path.realpath(file.parent)
        beside = {p.name for p in photos if os.path.realpath(p.path.parent) == here}
        rows = read_mrk(file, [p.name for p in photos], beside)
        return apply_rows(photos, rows, file=file, source="mrk")
    if ending == ".srt":
        return apply_rows(photos, read_srt(file, photos), file=file, source="srt")
    placed, said = apply_rows(photos, read_geo_txt(file), file=file, source="geo.txt")
    crs = read_crs(read_lines(file)[0][1], file=file.name)
    heights = [row.altitude_m for row in read_geo_txt(file)]
    return placed, (*said, *unit_notes(file, crs, heights))


_COLUMNS = {
    "name": ("name", "filename", "file", "image", "imagename", "photo", "label"),
    "latitude": ("latitude", "lat", "latitudedeg", "gpslatitude"),
    "longitude": ("longitude", "lon", "lng", "long", "longitudedeg", "gpslongitude"),
    "sea_level": ("altitude", "alt", "z", "elevation", "height", "altitudem", "gpsaltitude"),
    "takeoff": ("relativealtitude", "relalt", "takeoff", "takeoffm", "heightabovetakeoff"),
    "ellipsoid": ("ellipsoid", "ellipsoidm", "ellipsoidalheight", "ellh", "heightellipsoid"),
    "yaw": ("yaw", "heading", "yawdeg", "gimbalyaw", "gimbalyawdegree"),
    "pitch": ("pitch", "pitchdeg", "gimbalpitch", "gimbalpitchdegree"),
    "roll": ("roll", "rolldeg", "gimbalroll", "gimbalrolldegree"),
    "sigma_xy": (
        "accuracy",
        "horizontalaccuracy",
        "hacc",
        "accuracyhorz",
        "sigmaxym",
        "xyaccuracy",
    ),
    "sigma_z": ("verticalaccuracy", "vacc", "accuracyvert", "sigmazm", "zaccuracy"),
}
_SEPARATOR = re.compile(r"\"?sep=.?\"?", re.IGNORECASE)
_OTHER_UNIT = re.compile(
    r"[\[(][^\])]*?\b((?:u\.?s\.? ?)?(?:ft|feet|foot)|rad|radians?|gon|km|cm|mm)\b"
)
"""Units in brackets in a header that are not those which are read."""
_ALIASES = frozenset(alias for aliases in _COLUMNS.values() for alias in aliases)
_UNITS = ("m", "metre", "metres", "meter", "meters", "deg", "degree", "degrees")
_WITH_UNIT = re.compile(
    rf"({'|'.join(sorted(_ALIASES))})"
    rf"({'|'.join(_UNITS)}|(?:ussurvey|us|intl|international)?(?:ft|feet|foot)|rad|radians?|gon|km|cm|mm)"
)
"""Letters of a column's name that ends in its unit."""
_DATUMS: tuple[Datum, ...] = ("ellipsoid", "takeoff", "sea_level")


def read_positions_csv(path: Path) -> tuple[SideRow, ...]:
    """One row per photo; raises `SideFileError` where the header or a number is wrong.

    Columns (case, blanks and underscores do not matter): name or filename; lat, lon in degrees; alt
    (above sea level), rel_alt (above take-off) or ellipsoid in m; yaw, pitch, roll in degrees
    (pitch 0 = nadir; below -45 it is read as a gimbal's); accuracy, vertical_accuracy in m. Only
    the name is required. Decimal commas are read where semicolons or tabs separate the columns.
    """
    return _read_csv(path)[0]


def _read_csv(path: Path) -> tuple[tuple[SideRow, ...], tuple[str, ...]]:
    """The rows, and a note on columns that are not read."""
    lines = [line for _, line in read_lines(path)]
    if lines and _SEPARATOR.fullmatch(lines[0]):  # written by spreadsheets for themselves
        del lines[0]
    if not lines:
        raise SideFileError(f"{path.name} is empty; expected a header and one line per photo.")
    delimiter = max(",;\t", key=lines[0].count)
    table = read_table(lines, file=path.name, delimiter=delimiter)
    columns = _columns(table[0], path)
    if len(table) < 2:
        raise SideFileError(f"{path.name} has a header only; expected one line per photo below it.")
    if delimiter != "," and with_decimal_commas(cell for row in table for cell in row):
        table = [with_points(row) for row in table]
    for i, cells in enumerate(table[1:], 1):
        if any(c.strip() for c in cells[len(table[0]) :]):
            raise SideFileError(
                f"{path.name}, row {i} has {len(cells)} cells, and the header {len(table[0])}."
                " Quote cells with a comma in them, or separate the columns by semicolons."
            )
    unread = [c.strip() for k, c in enumerate(table[0]) if k not in columns.values() and c.strip()]
    rows = tuple(
        _csv_row(cells, columns, f"{path.name}, row {i}") for i, cells in enumerate(table[1:], 1)
    )
    return rows, (
        (f"{path.name} has columns that are not read: {sentence_of(unread)}.",) if unread else ()
    )


def _columns(header: list[str], path: Path) -> dict[str, int]:
    words = [_word(cell, path) for cell in header]
    found = {
        field: next(words.index(alias) for alias in aliases if alias in words)
        for field, aliases in _COLUMNS.items()
        if set(aliases) & set(words)
    }
    if "name" not in found or ("latitude" in found) != ("longitude" in found) or len(found) < 2:
        raise SideFileError(
            f"{path.name}: its header is '{plain(', '.join(header), 200)}'; expected at least"
            " 'name' with 'lat' and 'lon', or 'name' with 'yaw'. Add a header line."
        )
    return found


def _word(cell: str, path: Path) -> str:
    """The letters of a column's name, without its unit.

    Raises:
        SideFileError: the column is one that is read, and in another unit.
    """
    bare = re.sub(r"[^a-z]", "", re.sub(r"[\[(].*", "", cell.lower()))
    word = bare if bare in _ALIASES else ""
    unit = _OTHER_UNIT.search(cell.lower()) if word else None
    if found := _WITH_UNIT.fullmatch(re.sub(r"[^a-z]", "", cell.lower())):
        word, unit = found[1], found if found[2] not in _UNITS else None
    if unit:
        raise SideFileError(
            f"{path.name}: the column '{plain(cell, 60)}' is in {unit.groups()[-1]}; expected"
            " degrees, and heights and accuracies in m. Convert that column."
        )
    return word or bare


def _csv_row(cells: list[str], columns: dict[str, int], place: str) -> SideRow:
    values = {f: _cell(cells, c, f, place) for f, c in columns.items() if f != "name"}
    datum: Datum = next((d for d in _DATUMS if values.get(d) is not None), "sea_level")
    yaw = values.get("yaw")
    return SideRow(
        name=cells[columns["name"]].strip() if len(cells) > columns["name"] else "",
        latitude_deg=values.get("latitude"),
        longitude_deg=values.get("longitude"),
        altitude_m=values.get(datum),
        datum=datum,
        angles_deg=None
        if yaw is None
        else (yaw, values.get("pitch") or 0.0, values.get("roll") or 0.0),
        sigma_xy_m=accuracy(values.get("sigma_xy"), place),
        sigma_z_m=accuracy(values.get("sigma_z"), place) or accuracy(values.get("sigma_xy"), place),
    )


def _cell(cells: list[str], column: int, field: str, place: str) -> float | None:
    text = cells[column].strip() if column < len(cells) else ""
    value = number(text)
    if text and value is None:
        raise SideFileError(
            f"{place}: expected a number for {field}, found '{plain(text, 60)}'. Correct that cell."
        )
    return finite(value)


if TYPE_CHECKING:
    from pyproj import CRS, Transformer


def read_geo_txt(path: Path) -> tuple[SideRow, ...]:
    """All rows, in degrees; raises `SideFileError` that names the wrong line."""
    lines = read_lines(path)
    if len(lines) < 2:
        raise SideFileError(
            f"{path.name} has {len(lines)} lines; expected a coordinate system and one line per"
            " photo."
        )
    crs = read_crs(lines[0][1], file=path.name)
    to_degrees = _to_degrees(crs)
    datum: Datum = "ellipsoid" if crs.is_geographic and len(crs.axis_info) == 3 else "sea_level"
    unit_m = metres_of_height(crs)
    return tuple(
        _geo_txt_row(text, f"{path.name}, line {i}", to_degrees, datum, unit_m)
        for i, text in lines[1:]
    )


def _to_degrees(crs: "CRS") -> "Transformer":
    from pyproj import Transformer

    return Transformer.from_crs(crs, "EPSG:4326", always_xy=True)


def _geo_txt_row(
    line: str, place: str, to_degrees: "Transformer", datum: Datum, unit_m: float
) -> SideRow:
    name, numbers = _split(line)
    if not name or len(numbers) not in (2, 3, 6, 7, 8):
        raise SideFileError(
            f"{place}: expected 'name x y [z] [yaw pitch roll [hacc vacc]]', found"
            f" '{plain(line, 200)}'. Correct that line."
        )
    longitude, latitude = to_degrees.transform(numbers[0], numbers[1])
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
_SHOT = re.compile(r"_([0-9]{4,18})(?:_[A-Za-z]+)?$")
_METRES_PER_DEGREE = 111_320.0


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
    return int(found[1]) if found else -1


def _mrk_row(name: str, shot: list[float | None]) -> SideRow:
    north, east, down, lat, lon, height, *sigmas = shot
    latitude, longitude = lat or 0.0, lon or 0.0
    shrink = math.cos(math.radians(latitude))
    plane = [s for s in sigmas[:2] if s]
    return SideRow(
        name=name,
        latitude_deg=latitude + (north or 0.0) / 1000 / _METRES_PER_DEGREE,
        longitude_deg=longitude + (east or 0.0) / 1000 / (_METRES_PER_DEGREE * max(shrink, 1e-6)),
        altitude_m=(height or 0.0) - (down or 0.0) / 1000,
        datum="ellipsoid",
        sigma_xy_m=max(plane) if plane else None,
        sigma_z_m=sigmas[2],
    )
