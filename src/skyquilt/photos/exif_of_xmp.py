"""EXIF tags that a file has in its XMP packet only, as PNG and TIFF files of picture editors do."""

import re
from dataclasses import replace
from typing import Any

from skyquilt.photos import tags as tag
from skyquilt.photos.tags import Exif, Xmp, parse_number

_TEXTS = {
    tag.MAKE: "tiff:Make",
    tag.MODEL: "tiff:Model",
    tag.SERIAL: "aux:SerialNumber",
    tag.LENS: "aux:Lens",
}
_NUMBERS = {
    tag.FOCAL_MM: "exif:FocalLength",
    tag.FOCAL_35MM: "exif:FocalLengthIn35mmFilm",
    tag.ZOOM: "exif:DigitalZoomRatio",
    tag.PLANE_X: "exif:FocalPlaneXResolution",
    tag.PLANE_UNIT: "exif:FocalPlaneResolutionUnit",
    tag.PIXELS_X: "exif:PixelXDimension",
    tag.PIXELS_Y: "exif:PixelYDimension",
}
_PART = r"(\d{1,3}(?:\.\d{1,15})?)"
_ANGLE = re.compile(rf"{_PART}(?:,{_PART})?(?:,{_PART})?\s?([NSEWnsew])", re.ASCII)
"""Degrees as XMP writes them: `46,35.985N` or `46,35,59.1N`."""


def with_xmp(exif: Exif, xmp: Xmp) -> Exif:
    """The tags, and those of XMP's `tiff` and `exif` for what is absent; a position as a whole."""
    told: dict[int, Any] = {t: text for t, name in _TEXTS.items() if (text := xmp.text(name))}
    numbers = {t: parse_number(xmp.text(name)) for t, name in _NUMBERS.items()}
    told |= {t: number for t, number in numbers.items() if number is not None}
    if (turned := parse_number(xmp.text("tiff:Orientation"))) is not None:
        told[tag.ORIENTATION] = int(turned)
    missing = {t: value for t, value in told.items() if t not in exif.tags}
    places = {} if tag.GPS_LAT in exif.gps or tag.GPS_LON in exif.gps else _places(xmp)
    if not missing and not places:
        return exif
    return replace(exif, tags={**exif.tags, **missing}, gps={**exif.gps, **places})


def _places(xmp: Xmp) -> dict[int, Any]:
    """The position in XMP as a GPS directory; empty where it is not whole."""
    found: dict[int, Any] = {}
    axes = (
        ("exif:GPSLatitude", tag.GPS_LAT, tag.GPS_LAT_REF),
        ("exif:GPSLongitude", tag.GPS_LON, tag.GPS_LON_REF),
    )
    for name, value, reference in axes:
        parts = _ANGLE.fullmatch(xmp.text(name))
        if parts is None:
            return {}
        found[value] = tuple(float(p) for p in parts.groups()[:3] if p is not None)
        found[reference] = parts[4]
    height = parse_number(xmp.text("exif:GPSAltitude"))
    if height is not None:
        found[tag.GPS_ALT] = height
        found[tag.GPS_ALT_REF] = int(parse_number(xmp.text("exif:GPSAltitudeRef")) or 0)
    return found
