"""Where the photo says it was taken: XMP before EXIF, every height with its datum."""

import math

from skyquilt.model.photo import Datum, GeoPosition
from skyquilt.photos import exif as tag
from skyquilt.photos.exif import Exif, as_number, as_text
from skyquilt.photos.xmp import Xmp

_HEIGHTS = (-500.0, 9500.0)
_RTK_FLOAT, _RTK_FIXED = 34, 50
_DRONE_SIGMA = (1.5, 3.0)
_CAMERA_SIGMA = (5.0, 15.0)
"""Horizontal and vertical deviation in m where nothing says more; a camera's receiver is no
autopilot's.
"""


def read_position(exif: Exif, xmp: Xmp) -> tuple[GeoPosition | None, tuple[str, ...]]:
    """The measured position, or None, with sentences on what was void or insane."""
    notes: list[str] = []
    found = _place(_xmp_degrees(xmp), "XMP", notes)
    source = "xmp"
    if found is None:
        found, source = _place(_exif_degrees(exif), "EXIF", notes), "exif"
    if found is None:
        return None, tuple(notes or ["It carries no GPS position."])
    takeoff, sea, ellipsoid = _heights(exif, xmp, notes)
    sigma_xy, sigma_z = _sigmas(exif, xmp, drone=_flown(xmp))
    altitude, datum = _best_height(takeoff, sea, ellipsoid)
    position = GeoPosition(
        latitude_deg=found[0],
        longitude_deg=found[1],
        altitude_m=altitude,
        datum=datum,
        sigma_xy_m=sigma_xy,
        sigma_z_m=sigma_z,
        source=source,
        takeoff_m=takeoff,
        sea_level_m=sea,
        ellipsoid_m=ellipsoid,
    )
    return position, tuple(notes)


def why_void(latitude: float | None, longitude: float | None) -> str:
    """Why a pair of degrees is no position; empty when it is one."""
    if latitude is None or longitude is None:
        return "one of latitude and longitude is missing or no number"
    if latitude == 0 and longitude == 0:
        return "it is (0, 0), which receivers write without a fix"
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        return f"({latitude:g}, {longitude:g}) lies outside the globe"
    return ""


def _place(
    pair: tuple[float | None, float | None] | None, origin: str, notes: list[str]
) -> tuple[float, float] | None:
    if pair is None:
        return None
    reason = why_void(*pair)
    if reason:
        notes.append(f"The GPS position in {origin} is void: {reason}.")
        return None
    return pair[0] or 0.0, pair[1] or 0.0


def _xmp_degrees(xmp: Xmp) -> tuple[float | None, float | None] | None:
    """DJI's `GpsLongtitude` is its own spelling; other makers use the same names."""
    names = ("GpsLatitude",), ("GpsLongitude", "GpsLongtitude")
    if not any(xmp.text(*n) for n in names):
        return None
    return xmp.number(*names[0]), xmp.number(*names[1])


def _exif_degrees(exif: Exif) -> tuple[float | None, float | None] | None:
    if tag.GPS_LAT not in exif.gps and tag.GPS_LON not in exif.gps:
        return None
    latitude = _sexagesimal(exif.gps.get(tag.GPS_LAT), as_text(exif.gps.get(tag.GPS_LAT_REF)))
    longitude = _sexagesimal(exif.gps.get(tag.GPS_LON), as_text(exif.gps.get(tag.GPS_LON_REF)))
    return latitude, longitude


def _sexagesimal(value: object, reference: str) -> float | None:
    parts = list(value) if isinstance(value, (tuple, list)) else [value]
    numbers = [as_number(part) for part in parts[:3]]
    if not numbers or numbers[0] is None:
        return None
    degrees = sum((n or 0.0) / 60**i for i, n in enumerate(numbers))
    if any(n is None for n in numbers) or not math.isfinite(degrees):
        return None
    return float(-degrees if reference.upper()[:1] in ("S", "W") else degrees)


def _heights(
    exif: Exif, xmp: Xmp, notes: list[str]
) -> tuple[float | None, float | None, float | None]:
    """Heights above take-off, sea level and the ellipsoid in m."""
    written = as_number(exif.gps.get(tag.GPS_ALT))
    if written is not None and as_number(exif.gps.get(tag.GPS_ALT_REF)) == 1:
        written = -written
    absolute = xmp.number("AbsoluteAltitude")
    absolute = _sane(absolute if absolute is not None else written, "altitude", notes)
    takeoff = _sane(xmp.number("RelativeAltitude"), "height above take-off", notes)
    if _is_rtk(xmp):
        return takeoff, None, absolute
    return takeoff, absolute, None


def _sane(height: float | None, what: str, notes: list[str]) -> float | None:
    if height is None or _HEIGHTS[0] <= height <= _HEIGHTS[1]:
        return height
    notes.append(f"The {what} of {height:g} m is no flying height on this planet and was ignored.")
    return None


def _flown(xmp: Xmp) -> bool:
    """Whether an autopilot wrote the metadata."""
    return any(key.startswith(("drone-", "Camera:")) for key in xmp.values)


def _is_rtk(xmp: Xmp) -> bool:
    flag = xmp.number("RtkFlag")
    return flag in (_RTK_FLOAT, _RTK_FIXED) or xmp.text("AltitudeType") == "RtkAlt"


def _best_height(
    takeoff: float | None, sea: float | None, ellipsoid: float | None
) -> tuple[float | None, Datum]:
    """RTK's ellipsoid height, else take-off (a barometer, steady over a flight), else sea level."""
    if ellipsoid is not None:
        return ellipsoid, "ellipsoid"
    if takeoff is not None:
        return takeoff, "takeoff"
    return sea, "sea_level" if sea is not None else "unknown"


def _sigmas(exif: Exif, xmp: Xmp, *, drone: bool) -> tuple[float, float]:
    """Horizontal and vertical standard deviation in m: RTK's own, an accuracy tag, or what is
    usual.
    """
    xy, z = _DRONE_SIGMA if drone else _CAMERA_SIGMA
    error = as_number(exif.gps.get(tag.GPS_ERROR))
    xy = xmp.number("Camera:GPSXYAccuracy", "GPSXYAccuracy") or error or xy
    z = xmp.number("Camera:GPSZAccuracy", "GPSZAccuracy") or z
    if xmp.number("RtkFlag") in (_RTK_FLOAT, _RTK_FIXED):
        east, north, up = (xmp.number(f"RtkStd{axis}") for axis in ("Lon", "Lat", "Hgt"))
        xy = max(east or 0.0, north or 0.0) or xy
        z = up or z
    return max(xy, 0.01), max(z, 0.01)
