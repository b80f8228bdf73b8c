"""OpenDroneMap's `gcp_list.txt`: a coordinate system, then `x y z px py image [name] [check]`.

Rows with the same name, or without names the same x, y and z, are observations of one point. z may
be NaN; a compound or three-dimensional coordinate system states its zero and its unit. Pixels have
their centres at integers. A check point, which is not used in the adjustment, has a name that
starts with `check` or the word `check` in the eighth column: OpenDroneMap ignores both extensions.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from skyquilt.errors import SideFileError
from skyquilt.model.photo import ControlPoint, Datum, Photo, PointObservation
from skyquilt.outside import plain
from skyquilt.photos.elsewhere import FAR_KM, apart_km
from skyquilt.photos.side_rows import (
    PhotoNames,
    finite,
    metres_of_height,
    number,
    read_crs,
    read_lines,
    sentence_of,
    unit_notes,
    with_decimal_commas,
    with_points,
)

if TYPE_CHECKING:
    from pyproj import CRS


@dataclass(frozen=True, kw_only=True)
class _Observation:
    x: float
    y: float
    z: float | None
    column: float
    row: float
    image: str
    name: str
    check: bool

    @property
    def key(self) -> str:
        return self.name or f"{self.x!r} {self.y!r} {self.z!r}"


def read_gcp_list(
    path: Path, photo_names: Iterable[str], other_bands: Iterable[str] = ()
) -> tuple[tuple[ControlPoint, ...], tuple[str, ...]]:
    """Control points observed in the photos of a survey, and notes on rows of photos that are not
    in it.

    `photo_names` are `Photo.name`s, `other_bands` those of files that show other bands than the
    map. Raises `SideFileError` where a line is malformed, one point has two positions, or no row
    names a photo of the survey.
    """
    lines = read_lines(path)
    if len(lines) < 2:
        raise SideFileError(
            f"{path.name} has {len(lines)} lines; expected a coordinate system and one line per"
            " observation."
        )
    crs = read_crs(lines[0][1], file=path.name)
    epsg = crs.to_epsg()
    unit_m = metres_of_height(crs)
    rows = lines[2:] if len(lines) > 2 and _is_header(lines[1][1]) else lines[1:]
    observations = [_observation(text, f"{path.name}, line {i}", unit_m) for i, text in rows]
    names = PhotoNames(photo_names)
    strangers = sorted({s.image for s in observations if names.find(s.image) is None})
    if all(names.find(s.image) is None for s in observations):
        others = PhotoNames(other_bands)
        if any(others.find(s.image) is not None for s in observations):
            raise SideFileError(
                f"{path.name} names files of other bands than the map's; observe the points in"
                " files of the map's band, or make theirs the map (--band)."
            )
        raise SideFileError(
            f"{path.name} names {sentence_of(strangers)}; no photo of the survey is called that. "
            "Correct the image names in its sixth column."
        )
    groups: dict[str, list[_Observation]] = {}
    for observation in observations:
        groups.setdefault(observation.key, []).append(observation)
    system = f"EPSG:{epsg}" if epsg else crs.to_string()
    zero = datum_of(crs)
    points = [
        _point(i, group, system, zero, names, path) for i, group in enumerate(groups.values(), 1)
    ]
    notes = (*_notes(path, strangers, points), *unit_notes(path, crs, [p.z for p in points]))
    return tuple(p for p in points if p.observations), notes


def datum_of(crs: "CRS") -> Datum:
    """The zero of heights that a coordinate system states: `egm96`, `ellipsoid`, else `control`."""
    if crs.is_compound:
        vertical = crs.sub_crs_list[-1]
        return "egm96" if "egm96" in vertical.name.lower() else "control"
    return "ellipsoid" if len(crs.axis_info) == 3 else "control"


def _notes(path: Path, strangers: list[str], points: list[ControlPoint]) -> tuple[str, ...]:
    unseen = [p.name for p in points if not p.observations]
    missing = (
        f"{path.name} names photos that are not in the survey: {sentence_of(strangers)}."
        if strangers
        else ""
    )
    lost = (
        f"Control points without an observation in the survey: {sentence_of(unseen)}."
        if unseen
        else ""
    )
    return tuple(n for n in (missing, lost) if n)


def _words(line: str) -> list[str]:
    """The columns of a line, separated by tabs, blanks, semicolons or commas, without quotes,
    numbers with decimal points.
    """
    for mark in ("\t", None, ";", ","):
        words = [bare for w in line.split(mark) if (bare := w.strip(' "'))]
        if mark != "," and with_decimal_commas(words):
            words = with_points(words)
        if len(words) >= 6 and all(number(w) is not None for w in words[:2]):
            return words
    return line.replace(",", " ").replace(";", " ").split()


def _is_header(line: str) -> bool:
    """Whether a line names the columns (`geo_x geo_y geo_z im_x im_y image_name ...`)."""
    words = _words(line)
    return len(words) >= 6 and all(w[0].isalpha() and number(w) is None for w in words[:6])


def _observation(line: str, place: str, unit_m: float) -> _Observation:
    words = _words(line)
    numbers = [number(w) for w in words[:5]]
    x, y, z, column, row = (*numbers, *[None] * 5)[:5]
    wanted = (finite(v) for v in (x, y, column, row))
    if len(words) < 6 or z is None or any(v is None for v in wanted):
        raise SideFileError(
            f"{place}: expected 'x y z px py image [name] [check]', found '{plain(line, 200)}'."
            " Correct that line."
        )
    name = words[6] if len(words) > 6 else ""
    check = name.lower().startswith("check") or (len(words) > 7 and words[7].lower() == "check")
    return _Observation(
        x=x or 0.0,
        y=y or 0.0,
        z=None if finite(z) is None else z * unit_m,
        column=column or 0.0,
        row=row or 0.0,
        image=words[5],
        name=name,
        check=check,
    )


def _point(
    i: int, group: list[_Observation], crs: str, zero: Datum, names: PhotoNames, path: Path
) -> ControlPoint:
    first = group[0]
    label = first.name or f"point {i}"
    if len({(s.x, s.y, s.z) for s in group}) > 1:
        raise SideFileError(
            f"{path.name}: point {label} has two different places. Correct one of the rows."
        )
    # a row that stands there twice was measured once
    seen = ((names.find(s.image), s) for s in dict.fromkeys(group))
    return ControlPoint(
        name=label,
        x=first.x,
        y=first.y,
        z=first.z,
        crs=crs,
        datum=zero,
        observations=tuple(PointObservation(photo=n, x=s.column, y=s.row) for n, s in seen if n),
        check=any(s.check for s in group),
    )


def check_control(path: Path, control: Sequence[ControlPoint], photos: Sequence[Photo]) -> None:
    """Refuses control points that cannot be right, whatever the flight.

    Raises:
        SideFileError: a point is observed outside its photo or at two places of it, or the points
            are far from where the photos were taken.
    """
    sizes = {p.name: (p.width, p.height) for p in photos}
    for point in control:
        seen: dict[str, PointObservation] = {}
        for at in point.observations:
            width, height = sizes[at.photo]
            where = f"{path.name}: {plain(point.name, 80)} is observed"
            if not (-1 <= at.x <= width and -1 <= at.y <= height):
                raise SideFileError(
                    f"{where} at ({at.x:g}, {at.y:g}), outside {plain(at.photo, 80)} of {width} x"
                    f" {height} px. Correct that row: it takes pixels of the photo as stored."
                )
            first = seen.setdefault(at.photo, at)
            if math.hypot(first.x - at.x, first.y - at.y) > 1:
                raise SideFileError(
                    f"{where} at two places of {plain(at.photo, 80)}. Remove one of the rows."
                )
    _check_places(path, control, photos)


def _check_places(path: Path, control: Sequence[ControlPoint], photos: Sequence[Photo]) -> None:
    flown = [(p.position.latitude_deg, p.position.longitude_deg) for p in photos if p.position]
    if not control or not flown:
        return
    from pyproj import Transformer

    to_degrees = Transformer.from_crs(control[0].crs, "EPSG:4326", always_xy=True)
    away = []
    for point in control:
        longitude, latitude = to_degrees.transform(point.x, point.y)
        if not (math.isfinite(longitude) and abs(latitude) <= 90):
            raise SideFileError(
                f"{path.name}: {plain(point.name, 80)} at ({point.x:g}, {point.y:g}) is no place in"
                f" {plain(control[0].crs, 60)}. Correct the point or the coordinate system."
            )
        away.append(min(apart_km((latitude, longitude), there) for there in flown))
    if median(away) > FAR_KM:
        raise SideFileError(
            f"{path.name}: its points are {median(away):.0f} km from the photos. Correct the"
            " coordinate system in its first line, or the order of x (east) and y (north); where"
            " the photos' positions are wrong, give others with --geo."
        )
