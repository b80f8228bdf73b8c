"""OpenDroneMap's `geo.txt`: a coordinate system, then `name x y [z] [yaw pitch roll [hacc vacc]]`.

x is easting or longitude, y northing or latitude, whatever the axis order of the system. Angles in
degrees: yaw clockwise from north, pitch 0 = nadir, roll. z counts from sea level unless the system
is ellipsoidal (3D).
"""

from pathlib import Path
from typing import TYPE_CHECKING

from skyquilt.errors import SideFileError
from skyquilt.model.photo import Datum
from skyquilt.photos.side_rows import SideRow
from skyquilt.photos.side_text import finite, number, read_crs, read_lines

if TYPE_CHECKING:
    from pyproj import CRS, Transformer


def read_geo_txt(path: Path) -> tuple[SideRow, ...]:
    """All rows, in degrees; raises `SideFileError` with the line that is wrong."""
    lines = read_lines(path)
    if len(lines) < 2:
        raise SideFileError(
            f"{path.name} has {len(lines)} lines; expected a coordinate system and one line per"
            " photo."
        )
    crs = read_crs(lines[0][1], file=path.name)
    to_degrees = _to_degrees(crs)
    datum: Datum = "ellipsoid" if crs.is_geographic and len(crs.axis_info) == 3 else "sea_level"
    return tuple(_row(text, f"{path.name}, line {i}", to_degrees, datum) for i, text in lines[1:])


def _to_degrees(crs: "CRS") -> "Transformer":
    from pyproj import Transformer

    return Transformer.from_crs(crs, "EPSG:4326", always_xy=True)


def _row(line: str, place: str, to_degrees: "Transformer", datum: Datum) -> SideRow:
    name, numbers = _split(line)
    if not name or len(numbers) not in (2, 3, 6, 7, 8):
        raise SideFileError(
            f"{place}: expected 'name x y [z] [yaw pitch roll [hacc vacc]]', found '{line}'. "
            "Correct that line."
        )
    longitude, latitude = to_degrees.transform(numbers[0], numbers[1])
    values = [finite(v) for v in numbers[2:]] + [None] * 6
    angles = values[1:4]
    return SideRow(
        name=name,
        latitude_deg=finite(latitude),
        longitude_deg=finite(longitude),
        altitude_m=values[0],
        datum=datum,
        angles_deg=(angles[0], angles[1], angles[2])
        if angles[0] is not None and angles[1] is not None and angles[2] is not None
        else None,
        sigma_xy_m=values[4],
        sigma_z_m=values[5] or values[4],
    )


def _split(line: str) -> tuple[str, list[float]]:
    """The name (it may hold spaces) and the numbers behind it."""
    words = line.replace(",", " ").split()
    numbers: list[float] = []
    while words and (value := number(words[-1])) is not None:
        numbers.insert(0, value)
        words.pop()
    return " ".join(words), numbers
