"""Rows of side files: how their text is read, and how they override the photos' metadata."""

import csv
import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from string import ascii_lowercase
from typing import TYPE_CHECKING

from skyquilt.errors import SideFileError
from skyquilt.geometry.frames import belly_from_gimbal
from skyquilt.model.photo import Attitude, Datum, GeoPosition, Photo
from skyquilt.outside import plain, read_bounded, real, text_of
from skyquilt.photos.elsewhere import check_heights, check_positions
from skyquilt.photos.metadata import why_void

_LOOKS_DOWN_AT_MINUS_90 = -45.0
_SHOWN = 8
_ACCURACY = (0.0001, 10_000.0)
"""Standard deviations in m that are taken; 0 means that it is not known."""
_ALTITUDE = (-12_000.0, 100_000.0)
"""Heights in m that are taken."""
_MOST_ANGLE = 100_000.0
_MOST_CRS = 20_000
_MOST_PARTS = 30
"""Number of folders in a path that are looked at."""
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]{1,15},[0-9]{1,20}")


@dataclass(frozen=True, kw_only=True)
class SideRow:
    """One row for one photo; None = the row has no such value."""

    name: str
    """File name as written, with or without folder and ending."""
    latitude_deg: float | None = None
    """WGS 84."""
    longitude_deg: float | None = None
    """WGS 84."""
    altitude_m: float | None = None
    """Height above `datum` in m."""
    datum: Datum = "sea_level"
    """Zero of the height."""
    angles_deg: tuple[float, float, float] | None = None
    """Yaw, pitch, roll of a belly camera; a pitch below -45 is read as a gimbal's (-90 = nadir)."""
    sigma_xy_m: float | None = None
    """Horizontal standard deviation in m."""
    sigma_z_m: float | None = None
    """Vertical standard deviation in m."""
    system: str = ""
    """The coordinate system in which the file has x and y; empty where it has degrees."""


class PhotoNames:
    """Finds the photo that a side file refers to: by its path or the end of one, by file name, or
    by name without ending, ignoring case.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._by_key: dict[str, list[str]] = {}
        for name in names:
            path = PurePosixPath(name.lower())
            for key in {name.lower(), path.name, path.stem}:
                self._by_key.setdefault(key, []).append(name)

    def find(self, written: str) -> str | None:
        """The one photo that matches; None where there is none or several match."""
        found = self.all_of(written)
        return found[0] if len(found) == 1 else None

    def all_of(self, written: str) -> list[str]:
        """The one photo that matches, else all of that name."""
        path = PurePosixPath(written.strip().replace("\\", "/").lower())
        # a path may begin above the folder of the photos: D:/flights/card 2/DJI_0001.JPG
        ends = ["/".join(path.parts[k:]) for k in range(min(len(path.parts), _MOST_PARTS))]
        matches = [self._by_key.get(key, []) for key in (*ends, path.name, path.stem)]
        return next((m for m in matches if len(m) == 1), next((m for m in matches if m), []))


def of_one_flight(
    names: Sequence[str], shots: Sequence[int | None], *, file: str, beside: Collection[str] = ()
) -> list[int | None]:
    """The number of each photo's shot in a file of one flight, None for photos of others: numbers
    begin anew with each flight. Where several photos have one, those that lie `beside` the file
    are meant; `names`: of all photos.

    Raises:
        SideFileError: that does not tell which are meant.
    """
    if (twice := _claimed_twice(names, shots)) is None:
        return list(shots)
    near = [s if n in beside else None for n, s in zip(names, shots, strict=True)]
    if any(s is not None for s in near) and _claimed_twice(names, near) is None:
        return near
    shot, a, b = twice
    raise SideFileError(
        f"{file} is of one flight, and both {plain(a, 80)} and {plain(b, 80)} have its number"
        f" {shot}. Map the flights one by one, or give the positions of all photos in a CSV."
    )


def _claimed_twice(
    names: Sequence[str], shots: Sequence[int | None]
) -> tuple[int, str, str] | None:
    """A shot that two photos of one kind have, and these; None where there is none."""
    first: dict[tuple[int, str], str] = {}
    for name, shot in zip(names, shots, strict=True):
        if shot is None:
            continue
        before = first.setdefault((shot, _kind(name)), name)
        if before != name:
            return shot, before, name
    return None


def _kind(name: str) -> str:
    """What tells photos of one shot apart: letters behind its number, and the ending."""
    path = PurePosixPath(name.lower())
    return path.stem[len(path.stem.rstrip(ascii_lowercase)) :] + path.suffix


def sentence_of(names: Sequence[str]) -> str:
    """`a, b, c and 7 more`."""
    head = ", ".join(plain(name, 80) for name in names[:_SHOWN])
    return f"{head} and {len(names) - _SHOWN} more" if len(names) > _SHOWN else head


def apply_rows(
    photos: Sequence[Photo], rows: Sequence[SideRow], *, file: Path, source: str
) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos with the rows' positions and angles in place of their own, and notes.

    Raises `SideFileError` where not one row names a photo of the survey, or a row's position is
    invalid.
    """
    names = PhotoNames(p.name for p in photos)
    found: dict[str | None, SideRow] = {}
    for row in rows:
        photo = names.find(row.name)
        former = found.setdefault(photo, row)
        if photo is not None and replace(former, name=row.name) != row:
            raise SideFileError(
                f"{file.name} has two rows for {plain(photo, 80)} that differ. Remove one of them."
            )
    twins = [row.name for row in rows if len(names.all_of(row.name)) > 1]
    alike = (
        f"{file.name} names {sentence_of(twins)}, and several photos are called that"
        f" ({sentence_of(names.all_of(twins[0]))}): write names with their folders and endings."
        if twins
        else ""
    )
    strangers = [row.name for row in rows if not names.all_of(row.name)]
    if rows and len(twins) + len(strangers) == len(rows):
        if alike:
            raise SideFileError(alike)
        raise SideFileError(
            f"{file.name} names {sentence_of(strangers)}; none of the {len(photos)} photos is"
            " called that "
            f"(they are {sentence_of([p.name for p in photos])}). Correct the names or omit the"
            " file."
        )
    _check(rows, file)
    changed = tuple(_override(p, found, source) for p in photos)
    without = [p.name for p in photos if p.name not in found]
    rows_of = [found[p.name] for p in photos if p.name in found]
    placed = sum(r.latitude_deg is not None for r in rows_of)
    turned = sum(r.angles_deg is not None for r in rows_of)
    if rows and not placed and not turned:
        raise SideFileError(
            f"{file.name} gives no photo a position or angles; expected latitude and longitude, or"
            " yaw. Fill in its cells, or omit the file."
        )
    notes = (
        f"{file.name} placed {placed} of {len(photos)} photos." if placed else "",
        f"{file.name} gave {turned} of {len(photos)} photos their angles, and placed none."
        if not placed
        else "",
        alike,
        f"{file.name} names photos that are not in the survey: {sentence_of(strangers)}."
        if strangers
        else "",
        f"{file.name} has no row for {sentence_of(without)}; their own metadata are used."
        if without
        else "",
    )
    return changed, (*(n for n in notes if n), *_compared(photos, found, file.name))


def _compared(
    photos: Sequence[Photo], found: Mapping[str | None, SideRow], file: str
) -> Iterator[str]:
    """Notes on rows that lie elsewhere than their photos say, or higher."""
    both = [(p.position, found[p.name]) for p in photos if p.position and p.name in found]
    pairs = [
        ((p.latitude_deg, p.longitude_deg), (r.latitude_deg, r.longitude_deg))
        for p, r in both
        if r.latitude_deg is not None and r.longitude_deg is not None
    ]
    system = next((r.system for _, r in both), "")
    yield from check_positions(file, [p for p, _ in pairs], [there for _, there in pairs], system)
    heights = [(_height(p, r.datum), r.altitude_m) for p, r in both]
    known = [(own, there) for own, there in heights if own is not None and there is not None]
    yield from check_heights(file, [own for own, _ in known], [there for _, there in known])


def _height(position: GeoPosition, datum: Datum) -> float | None:
    """A photo's own height in m from a zero; of sea level and ellipsoid, which differ by less than
    a hundred metres, also the other one.
    """
    if datum == "takeoff":
        return position.takeoff_m
    absolute = (position.sea_level_m, position.ellipsoid_m)
    return next((h for h in absolute if h is not None), None)


def _check(rows: Sequence[SideRow], file: Path) -> None:
    for row in rows:
        name = plain(row.name, 80)
        placed = row.latitude_deg is not None or row.longitude_deg is not None
        if placed and (reason := why_void(row.latitude_deg, row.longitude_deg)):
            raise SideFileError(
                f"{file.name}: the position of {name} is invalid: {reason}. Correct that row."
            )
        height = row.altitude_m
        if height is not None and not _ALTITUDE[0] <= height <= _ALTITUDE[1]:
            raise SideFileError(
                f"{file.name}: the height {height:g} m of {name} is not possible. Correct that row."
            )
        if any(abs(a) > _MOST_ANGLE for a in row.angles_deg or ()):
            raise SideFileError(
                f"{file.name}: the angles {row.angles_deg} of {name} are not possible. Correct"
                " that row."
            )
        for sigma in (row.sigma_xy_m, row.sigma_z_m):
            accuracy(sigma, f"{file.name}, {name}")


def _override(photo: Photo, rows: Mapping[str | None, SideRow], source: str) -> Photo:
    row = rows.get(photo.name)
    if row is None:
        return photo
    position = _position(photo.position, row, source)
    attitude = _attitude(row, source) or photo.attitude
    mended = ("GPS position", "no GPS") if position else ()
    notes = tuple(n for n in photo.notes if not any(m in n for m in mended))
    return replace(photo, position=position, attitude=attitude, notes=notes)


def _position(old: GeoPosition | None, row: SideRow, source: str) -> GeoPosition | None:
    if row.latitude_deg is None or row.longitude_deg is None:
        return old
    base = old or GeoPosition(latitude_deg=0, longitude_deg=0, altitude_m=None, datum="unknown")
    placed = replace(
        base,
        latitude_deg=row.latitude_deg,
        longitude_deg=row.longitude_deg,
        sigma_xy_m=row.sigma_xy_m or base.sigma_xy_m,
        source=source,
    )
    if row.altitude_m is None:
        return placed
    field = {"takeoff": "takeoff_m", "sea_level": "sea_level_m", "ellipsoid": "ellipsoid_m"}.get(
        row.datum
    )
    placed = replace(placed, altitude_m=row.altitude_m, datum=row.datum)
    placed = replace(placed, sigma_z_m=row.sigma_z_m or base.sigma_z_m)
    return replace(placed, **{field: row.altitude_m}) if field else placed  # type: ignore[arg-type]


def _attitude(row: SideRow, source: str) -> Attitude | None:
    if row.angles_deg is None:
        return None
    yaw, pitch, roll = row.angles_deg
    if pitch < _LOOKS_DOWN_AT_MINUS_90:
        yaw, pitch, roll = belly_from_gimbal(yaw, pitch, roll)
    return Attitude(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll, source=source)


if TYPE_CHECKING:
    from pyproj import CRS, Transformer

_UTM = re.compile(r"WGS\s*84\s+UTM\s+(?:zone\s+)?(\d{1,2})\s*([NS])?", re.IGNORECASE)


def read_lines(path: Path, *, comments: bool = False) -> list[tuple[int, str]]:
    """Line numbers (from 1) and lines that are neither empty nor, unless asked for, comments (`#`).

    Raises `SideFileError` where the file cannot be read as text.
    """
    text = read_text(path)
    if "\x00" in text:
        raise SideFileError(f"{path.name} is not a text file; expected lines of words and numbers.")
    lines = ((i, _clean(line.strip())) for i, line in enumerate(text.splitlines(), 1))
    return [(i, line) for i, line in lines if line and (comments or not line.startswith("#"))]


def _clean(line: str) -> str:
    """A line without control characters other than tabs: parts of it are shown in messages."""
    return line if line.isprintable() else "\t".join(map(plain, line.split("\t")))


def read_text(path: Path) -> str:
    """A side file as text; raises `SideFileError` where it cannot be read, or is too large."""
    try:
        return text_of(read_bounded(path))
    except OSError as error:
        raise SideFileError(
            f"{path} cannot be read ({error.strerror or error}); check the path and its"
            " permissions."
        ) from error


def read_table(lines: Sequence[str], *, file: str, delimiter: str = ",") -> list[list[str]]:
    """The cells of lines of a CSV file; raises `SideFileError` where a quote stays open, or a cell
    is too long.
    """
    try:
        table = list(csv.reader(lines, delimiter=delimiter, skipinitialspace=True, strict=True))
    except csv.Error as error:
        raise SideFileError(f"{file} is not a table ({error}). Correct the file.") from error
    if len(table) != len(lines):
        raise SideFileError(f"{file}: a quote is opened and not closed in its line. Correct it.")
    return table


def with_points(cells: Sequence[str]) -> list[str]:
    """Cells with decimal points in place of decimal commas, where these separate no columns."""
    return [c.replace(",", ".") if _DECIMAL_COMMA.fullmatch(c.strip()) else c for c in cells]


def with_decimal_commas(cells: Iterable[str]) -> bool:
    """Whether numbers are written with decimal commas: two or more are, and none with a point."""
    words = [c.strip() for c in cells]
    commas = sum(_DECIMAL_COMMA.fullmatch(w) is not None for w in words)
    return commas > 1 and not any("." in w and real(w) is not None for w in words)


def number(text: str) -> float | None:
    """A number, including NaN; None for other text."""
    return math.nan if text.strip().lower() == "nan" else real(text)


def accuracy(value: float | None, place: str) -> float | None:
    """A standard deviation in m, or None; 0 means that it is not known.

    Raises:
        SideFileError: it is negative or absurd.
    """
    if value is None or value == 0 or _ACCURACY[0] <= value <= _ACCURACY[1]:
        return value or None
    raise SideFileError(
        f"{place}: an accuracy of {value:g} m is not possible; expected {_ACCURACY[0]:g} to"
        f" {_ACCURACY[1]:g}. Correct that line."
    )


def finite(value: float | None) -> float | None:
    """The number; None for NaN and infinities."""
    return value if value is not None and math.isfinite(value) else None


def read_crs(text: str, *, file: str) -> "CRS":
    """`EPSG:32615`, a PROJ string, WKT, or OpenDroneMap's `WGS84 UTM 15N`; raises
    `SideFileError`.
    """
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError, ProjError

    found = _UTM.fullmatch(text.strip())
    if found:
        zone, south = int(found[1]), (found[2] or "N").upper() == "S"
        if not 1 <= zone <= 60:  # the codes beside are those of the poles
            raise SideFileError(f"{file}: there is no UTM zone {zone}, only 1 to 60. Correct it.")
        text = f"EPSG:{(32700 if south else 32600) + zone}"
    try:
        if len(text) > _MOST_CRS:
            raise CRSError(f"it has {len(text)} characters")
        crs = CRS.from_user_input(text)
        # one that cannot be placed on the Earth (LOCAL_CS) is none
        Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        return crs
    except (ProjError, RecursionError, ValueError) as error:
        raise SideFileError(
            f"{file}: the first line must name a coordinate system such as 'EPSG:4326' or 'WGS84"
            " UTM 15N', "
            f"but it is '{plain(text, 100)}'. Add one."
        ) from error


def to_degrees(crs: "CRS") -> "Transformer":
    """From x and y of a coordinate system to longitude and latitude."""
    from pyproj import Transformer

    return Transformer.from_crs(crs, "EPSG:4326", always_xy=True)


def datum_of(crs: "CRS") -> Datum:
    """What heights in a coordinate system count from."""
    return "ellipsoid" if crs.is_geographic and len(crs.axis_info) == 3 else "sea_level"


def metres_of_height(crs: "CRS") -> float:
    """What one of a coordinate system's heights is in m, negative where they are depths; 1 where it
    has none.
    """
    axes = crs.sub_crs_list[-1].axis_info if crs.is_compound else crs.axis_info[2:]
    if not axes:
        return 1.0
    unit = float(axes[0].unit_conversion_factor) or 1.0
    return -unit if axes[0].direction.lower() == "down" else unit


def unit_notes(path: Path, crs: "CRS", heights: Iterable[float | None]) -> tuple[str, ...]:
    """A note where a coordinate system counts in another unit than m and tells nothing of
    heights.
    """
    flat = not crs.is_compound and len(crs.axis_info) == 2 and not crs.is_geographic
    unit = crs.axis_info[0] if crs.axis_info else None
    if not flat or unit is None or abs(unit.unit_conversion_factor - 1) < 1e-9:
        return ()
    if all(h is None for h in heights):
        return ()
    return (
        f"The coordinate system of {path.name} counts in {unit.unit_name} and has no heights: those"
        " in the file are taken as metres. If they are not, name a vertical system, too (such as"
        " EPSG:2264+6360, with heights in US survey feet), or convert them.",
    )
