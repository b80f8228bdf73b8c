"""What the text side files have in common: lines, numbers, and coordinate systems as people write
them.
"""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

from skyquilt.errors import SideFileError

if TYPE_CHECKING:
    from pyproj import CRS

_UTM = re.compile(r"WGS\s*84\s+UTM\s+(?:zone\s+)?(\d{1,2})\s*([NS])?", re.IGNORECASE)


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Line numbers (from 1) and lines that are neither empty nor comments (`#`).

    Raises `SideFileError` where the file cannot be read as text.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig", "replace")
    except OSError as error:
        raise SideFileError(
            f"{path} cannot be read ({error.strerror or error}); check the path and its"
            " permissions."
        ) from error
    if "\x00" in text:
        raise SideFileError(f"{path.name} is no text file; expected lines of words and numbers.")
    lines = ((i, line.strip()) for i, line in enumerate(text.splitlines(), 1))
    return [(i, line) for i, line in lines if line and not line.startswith("#")]


def number(text: str) -> float | None:
    """A number, NaN included; None for a word."""
    try:
        return float(text)
    except ValueError:
        return None


def finite(value: float | None) -> float | None:
    """The number, or None for NaN and infinities too."""
    return value if value is not None and math.isfinite(value) else None


def read_crs(text: str, *, file: str) -> "CRS":
    """`EPSG:32615`, a PROJ string, WKT, or OpenDroneMap's `WGS84 UTM 15N`; raises
    `SideFileError`.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    found = _UTM.fullmatch(text.strip())
    if found:
        zone, south = int(found[1]), (found[2] or "N").upper() == "S"
        text = f"EPSG:{(32700 if south else 32600) + zone}"
    try:
        return CRS.from_user_input(text)
    except CRSError as error:
        raise SideFileError(
            f"{file}: the first line must name a coordinate system such as 'EPSG:4326' or 'WGS84"
            " UTM 15N', "
            f"but it is '{text}'. Put one there."
        ) from error
