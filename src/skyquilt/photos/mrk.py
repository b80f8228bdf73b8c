"""DJI's `.MRK`: one line per shot of an RTK flight.

`index, GPS seconds, [week], N,E,V offsets in mm from antenna to camera, Lat, Lon, Ellh, deviations,
quality`. V counts downwards. The index is the last four digits in the photo's name
(`100_0001_0023.JPG`).
"""

import math
import re
from collections.abc import Sequence
from pathlib import Path

from skyquilt.errors import SideFileError
from skyquilt.photos.side_rows import SideRow
from skyquilt.photos.side_text import read_lines

_NUMBER = r"\s*([-+]?\d+(?:\.\d+)?)\s*"
_LINE = re.compile(
    rf"^(\d+)\s+\S+\s+\[\d+\]{_NUMBER},\s*N{_NUMBER},\s*E{_NUMBER},\s*V"
    rf"{_NUMBER},\s*Lat{_NUMBER},\s*Lon{_NUMBER},\s*Ellh(?:{_NUMBER},{_NUMBER},{_NUMBER})?"
)
_SHOT = re.compile(r"_(\d{4,})(?:_[A-Za-z]+)?$")
_METRES_PER_DEGREE = 111_320.0


def read_mrk(path: Path, photo_names: Sequence[str]) -> tuple[SideRow, ...]:
    """Camera positions for the photos whose index the file has; raises `SideFileError`."""
    shots = {}
    for i, line in read_lines(path):
        found = _LINE.match(line)
        if not found:
            raise SideFileError(
                f"{path.name}, line {i}: expected a DJI shot record (index, time, [week], N, E, V,"
                " Lat, Lon, "
                f"Ellh ...), found '{line[:60]}'. Give the file as the drone wrote it."
            )
        shots[int(found[1])] = [float(v) if v else None for v in found.groups()[1:]]
    pairs = ((name, shots.get(_index(name))) for name in photo_names)
    rows = tuple(_row(name, shot) for name, shot in pairs if shot)
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


def _row(name: str, shot: list[float | None]) -> SideRow:
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
