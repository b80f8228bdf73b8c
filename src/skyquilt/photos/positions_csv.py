"""A table of positions and angles: CSV with a header, separated by commas, semicolons or tabs."""

import csv
import re
from pathlib import Path

from skyquilt.errors import SideFileError
from skyquilt.model.photo import Datum
from skyquilt.photos.side_rows import SideRow
from skyquilt.photos.side_text import finite, number, read_lines

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
_DATUMS: tuple[Datum, ...] = ("ellipsoid", "takeoff", "sea_level")


def read_positions_csv(path: Path) -> tuple[SideRow, ...]:
    """One row per photo; raises `SideFileError` where the header or a number is wrong.

    Columns (case, blanks and underscores do not matter): name or filename; lat, lon in degrees; alt
    (above sea level), rel_alt (above take-off) or ellipsoid in m; yaw, pitch, roll in degrees
    (pitch 0 = nadir; below -45 it is read as a gimbal's); accuracy, vertical_accuracy in m. Only
    the name is obligatory.
    """
    lines = [line for _, line in read_lines(path)]
    if not lines:
        raise SideFileError(f"{path.name} is empty; expected a header and one line per photo.")
    delimiter = max(",;\t", key=lines[0].count)
    table = list(csv.reader(lines, delimiter=delimiter))
    columns = _columns(table[0], path)
    return tuple(
        _row(cells, columns, f"{path.name}, row {i}") for i, cells in enumerate(table[1:], 1)
    )


def _columns(header: list[str], path: Path) -> dict[str, int]:
    plain = [re.sub(r"[^a-z]", "", re.sub(r"[\[(].*", "", cell.lower())) for cell in header]
    found = {
        field: next(plain.index(alias) for alias in aliases if alias in plain)
        for field, aliases in _COLUMNS.items()
        if set(aliases) & set(plain)
    }
    if "name" not in found or ("latitude" in found) != ("longitude" in found) or len(found) < 2:
        raise SideFileError(
            f"{path.name}: its header is '{', '.join(header)}'; expected at least 'name' with 'lat'"
            " and "
            "'lon', or 'name' with 'yaw'. Add a header line."
        )
    return found


def _row(cells: list[str], columns: dict[str, int], place: str) -> SideRow:
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
        sigma_xy_m=values.get("sigma_xy"),
        sigma_z_m=values.get("sigma_z") or values.get("sigma_xy"),
    )


def _cell(cells: list[str], column: int, field: str, place: str) -> float | None:
    text = cells[column].strip() if column < len(cells) else ""
    value = number(text)
    if text and value is None:
        raise SideFileError(
            f"{place}: expected a number for {field}, found '{text}'. Correct that cell."
        )
    return finite(value)
