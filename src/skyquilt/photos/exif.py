"""EXIF tags as numbers and words; whatever is broken reads as absent."""

import io
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, BinaryIO

from PIL import Image

EXIF_IFD, GPS_IFD = 0x8769, 0x8825

MAKE, MODEL, SOFTWARE, ORIENTATION, MODIFIED = 0x010F, 0x0110, 0x0131, 0x0112, 0x0132
DESCRIPTION, GDAL_METADATA = 0x010E, 42112
TAKEN, SUBSEC, OFFSET = 0x9003, 0x9291, 0x9011
FOCAL_MM, FOCAL_35MM, ZOOM = 0x920A, 0xA405, 0xA404
PLANE_X, PLANE_UNIT = 0xA20E, 0xA210
PIXELS_X, PIXELS_Y = 0xA002, 0xA003
SERIAL, LENS = 0xA431, 0xA434
GPS_LAT_REF, GPS_LAT, GPS_LON_REF, GPS_LON, GPS_ALT_REF, GPS_ALT = 1, 2, 3, 4, 5, 6
GPS_TIME, GPS_ERROR, GPS_DATE = 7, 0x1F, 0x1D


@dataclass(frozen=True, kw_only=True, eq=False)
class Exif:
    """Tags by number: of the image and photo directories in `tags`, of the GPS directory in
    `gps`.
    """

    tags: Mapping[int, Any] = field(default_factory=dict)
    """IFD0 and the Exif directory in one (their numbers do not clash)."""
    gps: Mapping[int, Any] = field(default_factory=dict)
    """The GPS directory."""
    broken: bool = False
    """There was a block, but it could not be read."""

    def text(self, tag: int) -> str:
        """A tag as text without padding; empty where it is absent."""
        return as_text(self.tags.get(tag))

    def number(self, tag: int) -> float | None:
        """A tag as a finite number; None where it is absent or void."""
        return as_number(self.tags.get(tag))


def as_text(value: Any) -> str:
    """Text up to the first NUL, stripped; empty for anything that is no text."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return value.split("\x00")[0].strip() if isinstance(value, str) else ""


def as_number(value: Any) -> float | None:
    """A finite float of a number, rational or one-element tuple; else None."""
    if isinstance(value, (tuple, list)):
        value = value[0] if len(value) == 1 else None
    if isinstance(value, bytes):
        value = value[0] if len(value) == 1 else None
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def parse_exif(block: bytes) -> Exif:
    """Tags of an EXIF block as it stands in a JPEG or PNG (a TIFF header and directories)."""
    return read_tiff_tags(io.BytesIO(block)) if block else Exif()


def read_tiff_tags(file: BinaryIO) -> Exif:
    """Tags of a TIFF file or block, read from its directories alone; never raises."""
    exif = Image.Exif()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            file.seek(0)
            exif.load_from_fp(file)
            tags = {**dict(exif), **_directory(exif, EXIF_IFD)}
            return Exif(tags=tags, gps=_directory(exif, GPS_IFD))
    except (
        Exception
    ):  # Pillow raises a dozen kinds on garbage, and a broken block must not stop a survey
        return Exif(broken=True)


def _directory(exif: Image.Exif, which: int) -> dict[int, Any]:
    try:
        found = exif.get_ifd(which)
    except Exception:  # as above: one broken directory leaves the others readable
        return {}
    return {k: v for k, v in found.items() if isinstance(k, int)}
