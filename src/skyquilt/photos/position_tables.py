"""Tables of positions, one row per photo, as programs and people write them: with a header, also in
a comment or in other languages, or without one; in degrees, degrees and minutes, or metres.
"""

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from skyquilt.errors import SideFileError
from skyquilt.model.photo import Datum
from skyquilt.outside import plain
from skyquilt.photos.side_rows import (
    SideRow,
    accuracy,
    datum_of,
    finite,
    metres_of_height,
    number,
    read_crs,
    read_lines,
    read_table,
    sentence_of,
    to_degrees,
    unit_notes,
    with_decimal_commas,
    with_points,
)

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

_COLUMNS = {
    "name": (
        *("name", "filename", "file", "image", "imagename", "photo", "label", "photoname"),
        *("imagefile", "imagefilename", "sourcefile", "picture", "picturename", "imageid"),
        *("bild", "bildname", "datei", "dateiname", "foto", "nom", "fichier", "nomfichier"),
        *("nombre", "archivo", "imagen", "nome", "arquivo", "imagem", "immagine", "bestand"),
    ),
    "latitude": (
        *("latitude", "lat", "latitudedeg", "gpslatitude", "latitudedecimaldegrees"),
        *("breite", "breitengrad", "geographischebreite", "latitud", "latitudine"),
        "breedtegraad",
    ),
    "longitude": (
        *("longitude", "lon", "lng", "long", "longitudedeg", "gpslongitude"),
        *("longitudedecimaldegrees", "lange", "laenge", "langengrad", "laengengrad"),
        *("geographischelange", "longitud", "longitudine", "lengtegraad"),
    ),
    "x": (
        *("easting", "east", "x", "xeasting", "eastingx", "rechtswert", "ostwert", "utmx"),
        "este",
    ),
    "y": (
        *("northing", "north", "y", "ynorthing", "northingy", "hochwert", "nordwert", "utmy"),
        "norte",
    ),
    "sea_level": (
        *("altitude", "alt", "z", "elevation", "height", "altitudem", "gpsaltitude"),
        *("altitudeamsl", "altitudemsl", "altamsl", "altmsl", "amsl", "heightmsl"),
        *("hohe", "hoehe", "altitud", "altura", "elevacion", "hauteur", "quota", "hoogte"),
    ),
    "takeoff": ("relativealtitude", "relalt", "takeoff", "takeoffm", "heightabovetakeoff"),
    "ellipsoid": (
        *("ellipsoid", "ellipsoidm", "ellipsoidalheight", "ellh", "heightellipsoid"),
        *("ellipsoidheight", "ellipsoidalaltitude", "altitudeellipsoid", "heightellipsoidal"),
        *("altitudeellipsoidal", "ellipsoidischehohe", "ellipsoidischehoehe"),
    ),
    "yaw": ("yaw", "heading", "yawdeg", "gimbalyaw", "gimbalyawdegree"),
    "pitch": ("pitch", "pitchdeg", "gimbalpitch", "gimbalpitchdegree"),
    "roll": ("roll", "rolldeg", "gimbalroll", "gimbalrolldegree"),
    "sigma_xy": (
        *("accuracy", "horizontalaccuracy", "hacc", "accuracyhorz", "sigmaxym", "xyaccuracy"),
        *("accuracyhorizontal", "horizontalstddev", "stddevhorizontal", "lateralrms"),
        *("gpsxyaccuracy", "genauigkeit"),
    ),
    "sigma_z": (
        *("verticalaccuracy", "vacc", "accuracyvert", "sigmazm", "zaccuracy"),
        *("accuracyvertical", "verticalstddev", "stddevvertical", "elevationrms"),
        "gpszaccuracy",
    ),
}
"""Letters of columns' names by what they hold, also in German, French, Spanish, Portuguese, Italian
and Dutch.
"""
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
_SYSTEM = re.compile(r"#?\s*CoordinateSystem:\s*(\S.*)", re.IGNORECASE)
"""The line in which Metashape names the coordinate system of its tables."""
_STATED_CRS = re.compile(
    r"(?:EPSG:\d|\+proj=|\+init=|WGS ?84 UTM|(?:PROJ|GEOG|GEOD|COMPD|BOUND)\w{0,8}\[).*",
    re.IGNORECASE,
)
_NONE = frozenset({"", "-", "--", "n/a", "na", "none", "null", "nan", "?"})
"""Cells that hold no value, in lower case."""
_PART = r"(\d{1,3}(?:\.\d{1,15})?)"
_DEGREES = re.compile(
    rf"([NSEWO])?\s*([-+])?{_PART}\s*(?:°|º|deg|d)?\s*(?:{_PART}\s*(?:'|′|’|m)\s*)?"
    rf"(?:{_PART}\s*(?:\"|″|”|''|s)\s*)?([NSEWO])?",
    re.IGNORECASE | re.ASCII,
)
_HEIGHT = re.compile(
    r"([-+]?\d{1,6}(?:[.,]\d{1,15})?)\s*m(?:etres?|eters?)?(\s+(?:above|below) sea level)?",
    re.IGNORECASE | re.ASCII,
)


def system_of(crs: "CRS") -> str:
    """A coordinate system as text; empty where it counts degrees."""
    return "" if crs.is_geographic else crs.to_wkt()


def states_crs(line: str) -> bool:
    """Whether a line names a coordinate system, as the first one of a `geo.txt` does."""
    return _STATED_CRS.fullmatch(line.strip()) is not None


@dataclass(frozen=True, kw_only=True)
class _Table:
    """The cells of a file."""

    header: list[str]
    rows: list[list[str]]
    columns: dict[str, int]
    """Number of the column of each thing that is read."""
    crs: str
    """Coordinate system that the file names; empty where it names none."""
    bare: bool
    """Whether there is no header."""


def has_header(path: Path) -> bool:
    """Whether a file has a header that is understood, in a comment or its first line."""
    try:
        return not _read(path).bare
    except SideFileError:
        return False


def read_positions(path: Path) -> tuple[tuple[SideRow, ...], tuple[str, ...]]:
    """One row per photo, and notes; raises `SideFileError` where the header or a number is wrong.

    Columns (case, blanks and underscores do not matter): name or filename; lat, lon in degrees, or
    easting, northing where a line names the coordinate system; alt (above sea level), rel_alt
    (above take-off) or ellipsoid in m; yaw, pitch, roll in degrees (pitch 0 = nadir; below -45 it
    is read as a gimbal's); accuracy, vertical_accuracy in m. Only the name is required. A table
    without a header has name, latitude, longitude and height. Decimal commas are read where
    semicolons, tabs or blanks separate the columns.
    """
    table = _read(path)
    columns = table.columns
    if not table.rows:
        raise SideFileError(f"{path.name} has a header only; expected one line per photo below it.")
    width = len(table.header)
    for i, cells in enumerate(table.rows, 1):
        if any(c.strip() for c in cells[width:]):
            raise SideFileError(
                f"{path.name}, row {i} has {len(cells)} cells, and the header {width}."
                " Quote cells with a comma in them, or separate the columns by semicolons."
            )
    named = [(i, cells) for i, cells in enumerate(table.rows, 1) if _name_of(cells, columns)]
    rows: list[SideRow] = []
    notes: list[str] = []
    projected = "x" in columns and "latitude" not in columns
    system = read_crs(table.crs, file=path.name) if table.crs and projected else None
    if projected and system is None and "yaw" not in columns:
        raise SideFileError(
            f"{path.name} gives no photo a position or angles: nothing tells what its columns"
            f" '{plain(table.header[columns['x']], 40)}' and"
            f" '{plain(table.header[columns['y']], 40)}' count. Name their coordinate system in a"
            " line before all others, such as 'EPSG:32633', or give lat and lon in degrees."
        )
    for i, cells in named:
        rows.append(_row(cells, columns, f"{path.name}, row {i}"))
    if system is not None:
        degrees, datum, unit_m = to_degrees(system), datum_of(system), metres_of_height(system)
        named_system = system_of(system)
        rows = [
            replace(_placed(row, cells, columns, degrees, datum, unit_m), system=named_system)
            for row, (_, cells) in zip(rows, named, strict=True)
        ]
        notes += unit_notes(path, system, [row.altitude_m for row in rows])
    told = [d for d in _DATUMS if d in columns]
    used = set(columns.values()) - {columns[d] for d in told if d != _most(rows, told)}
    if system is None:
        used -= {columns[k] for k in ("x", "y") if k in columns}
    unread = [c.strip() for k, c in enumerate(table.header) if k not in used and c.strip()]
    if table.bare:
        notes.append(
            f"{path.name} has no header: its columns are taken for name, latitude, longitude"
            + (" and height above sea level" if "sea_level" in columns else "")
            + (f", and {len(unread)} more are not read" if unread else "")
            + "."
        )
    elif unread:
        notes.append(f"{path.name} has columns that are not read: {sentence_of(unread)}.")
    return tuple(rows), tuple(notes)


def _most(rows: Sequence[SideRow], told: Sequence[Datum]) -> Datum | None:
    """From where heights of the rows count, of the zeros that have a column."""
    given = {row.datum for row in rows if row.altitude_m is not None}
    return next((d for d in told if d in given), told[0] if told else None)


def _read(path: Path) -> _Table:
    """Finds the header and splits the lines."""
    lines = [line for _, line in read_lines(path, comments=True)]
    crs = next((m[1] for line in lines if (m := _SYSTEM.fullmatch(line))), "")
    data = [line for line in lines if not line.startswith("#")]
    if data and _SEPARATOR.fullmatch(data[0]):  # written by spreadsheets for themselves
        del data[0]
    if data and states_crs(data[0]):
        crs = data.pop(0)
    if not data:
        raise SideFileError(f"{path.name} is empty; expected a header and one line per photo.")
    first = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    comments = [line.lstrip("# ") for line in lines[:first]]
    mark = max(",;\t", key=data[0].count)
    table = _cells(data, mark, path)
    blanks = mark not in data[0]
    if (blanks or mark != ",") and with_decimal_commas(cell for row in table for cell in row):
        table = [with_points(row) for row in table]
    columns = _columns(table[0], path)
    if _complete(columns):
        if blanks and columns["name"] == 0:
            table = [_with_blanks(row, len(table[0])) for row in table]
        return _Table(header=table[0], rows=table[1:], columns=columns, crs=crs, bare=False)
    for comment in reversed(comments):
        header = comment.split(mark) if mark in comment else comment.split()
        header = [cell.strip(' "') for cell in header]
        columns = _columns(header, path)
        if _complete(columns) and len(columns) > 2:
            if blanks and columns["name"] == 0:
                table = [_with_blanks(row, len(header)) for row in table]
            return _Table(header=header, rows=table, columns=columns, crs=crs, bare=False)
    if path.suffix.lower() == ".csv" and _is_place(table[0]):
        names = ["name", "latitude", "longitude", "altitude"][: len(table[0])]
        header = names + [f"column {k}" for k in range(len(names) + 1, len(table[0]) + 1)]
        columns = {"name": 0, "latitude": 1, "longitude": 2}
        if len(names) == 4 and table[0][3].strip():
            columns["sea_level"] = 3
        return _Table(header=header, rows=table, columns=columns, crs=crs, bare=True)
    raise SideFileError(
        f"{path.name}: its header is '{plain(', '.join(table[0]), 200)}'; expected at least"
        " 'name' with 'lat' and 'lon', or 'name' with 'yaw'. Add a header line."
    )


def _cells(lines: Sequence[str], mark: str, path: Path) -> list[list[str]]:
    """Lines as cells; where no mark separates them, blanks do."""
    if mark in lines[0]:
        return read_table(lines, file=path.name, delimiter=mark)
    return [line.split() for line in lines]


def _with_blanks(cells: list[str], width: int) -> list[str]:
    """A row of which blanks separate the cells, and the name, its first cell, contains some."""
    more = max(len(cells) - width, 0)
    return [" ".join(cells[: more + 1]), *cells[more + 1 :]]


def _complete(columns: dict[str, int]) -> bool:
    """Whether the columns tell a position or angles of photos."""
    pairs = (("latitude", "longitude"), ("x", "y"))
    whole = all((a in columns) == (b in columns) for a, b in pairs)
    return "name" in columns and whole and len(columns) > 1


def _is_place(cells: Sequence[str]) -> bool:
    """Whether a row begins with a name, a latitude and a longitude."""
    if len(cells) < 3 or not cells[0].strip() or number(cells[0]) is not None:
        return False
    lat, lon = (finite(number(c)) for c in cells[1:3])
    return lat is not None and lon is not None and abs(lat) <= 90 and abs(lon) <= 180


def _columns(header: Sequence[str], path: Path) -> dict[str, int]:
    words = [_words(cell, path) for cell in header]
    found: dict[str, int] = {}
    for field, aliases in _COLUMNS.items():
        at = [k for alias in aliases for k, w in enumerate(words) if alias in w]
        if at:
            found[field] = at[0]
    if "latitude" in found and "longitude" in found:
        found = {k: v for k, v in found.items() if k not in ("x", "y")}
    return found


def _words(cell: str, path: Path) -> list[str]:
    """What a column's name may mean: its letters, and those of its parts (`X/Longitude`)."""
    parts = [p for p in cell.split("/") if p.strip()]
    words = [_word(part, path) for part in parts] if len(parts) == 2 else []
    known = [w for w in words if w in _ALIASES]
    # the name that says more goes first: X/Longitude, Z/Altitude
    return [_word(cell, path), *sorted(known, key=len, reverse=True)[:1]]


def _letters(text: str) -> str:
    """Its Latin letters in lower case, without accents."""
    return re.sub(r"[^a-z]", "", unicodedata.normalize("NFKD", text.lower()))


def _word(cell: str, path: Path) -> str:
    """The letters of a column's name, without its unit.

    Raises:
        SideFileError: the column is one that is read, and in another unit.
    """
    bare = _letters(re.sub(r"[\[(].*", "", cell))
    word = bare if bare in _ALIASES else ""
    unit = _OTHER_UNIT.search(cell.lower()) if word else None
    if found := _WITH_UNIT.fullmatch(_letters(cell)):
        word, unit = found[1], found if found[2] not in _UNITS else None
    if unit:
        raise SideFileError(
            f"{path.name}: the column '{plain(cell, 60)}' is in {unit.groups()[-1]}; expected"
            " degrees, and heights and accuracies in m. Convert that column."
        )
    return word or bare


def _name_of(cells: Sequence[str], columns: dict[str, int]) -> str:
    return cells[columns["name"]].strip() if len(cells) > columns["name"] else ""


def _row(cells: list[str], columns: dict[str, int], place: str) -> SideRow:
    values = {
        f: _cell(cells, c, f, place) for f, c in columns.items() if f not in ("name", "x", "y")
    }
    datum: Datum = next((d for d in _DATUMS if values.get(d) is not None), "sea_level")
    yaw = values.get("yaw")
    return SideRow(
        name=_name_of(cells, columns),
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
    if text.lower() in _NONE:
        return None
    value = number(text)
    if value is None and field in ("latitude", "longitude"):
        value = degrees_of(text, field)
    elif value is None and (found := _HEIGHT.fullmatch(text)):
        value = float(found[1].replace(",", ".")) * (
            -1 if "below" in (found[2] or "").lower() else 1
        )
    if value is None:
        raise SideFileError(
            f"{place}: expected a number for {field}, found '{plain(text, 60)}'. Correct that cell."
        )
    return finite(value)


def _placed(
    row: SideRow,
    cells: Sequence[str],
    columns: dict[str, int],
    degrees: "Transformer",
    datum: Datum,
    unit_m: float,
) -> SideRow:
    """The row at its x and y; heights above sea level are those of the coordinate system."""
    x, y = (
        finite(number(cells[columns[a]])) if columns[a] < len(cells) else None for a in ("x", "y")
    )
    if x is None or y is None:
        return row
    longitude, latitude = degrees.transform(x, y)
    row = replace(row, latitude_deg=finite(latitude), longitude_deg=finite(longitude))
    if row.altitude_m is None or row.datum != "sea_level":
        return row
    return replace(row, altitude_m=row.altitude_m * unit_m, datum=datum)


def degrees_of(text: str, axis: str) -> float | None:
    """Degrees from `46°35'59.1"N`, `46 deg 35' 59.1" N`, `46°35.98'N`, `N 46.5`; None for anything
    else. `axis`: `latitude` or `longitude`.
    """
    found = _DEGREES.fullmatch(text.strip().replace(",", "."))
    if found is None or (found[1] and found[6]):
        return None
    side = (found[1] or found[6] or "").upper()
    # O is east in German (Ost) and west in Spanish and French (oeste, ouest)
    if side and side not in ("NS" if axis == "latitude" else "EW"):
        return None
    degrees, minutes, seconds = (float(found[k] or 0) for k in (3, 4, 5))
    if minutes >= 60 or seconds >= 60 or (found[2] == "-" and side in ("S", "W")):
        return None
    value = degrees + minutes / 60 + seconds / 3600
    return -value if found[2] == "-" or side in ("S", "W") else value
