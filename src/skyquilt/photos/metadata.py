"""The metadata of a photo: position, angles, capture time, the program that wrote it.

XMP is preferred to EXIF, because manufacturers put the better value there; every height has its
datum.
"""

import math
import re
from datetime import UTC, datetime, timedelta, timezone

from skyquilt.geometry.frames import belly_from_gimbal
from skyquilt.model.photo import Attitude, Datum, GeoPosition
from skyquilt.photos import tags as tag
from skyquilt.photos.tags import Exif, Xmp, as_number, as_text

_HEIGHTS = (-500.0, 9500.0)
_ABOVE_TAKEOFF = (-1500.0, 3000.0)
"""Plausible heights in m above sea level or the ellipsoid, and above take-off: no drone climbs
higher than 3 km in a flight."""
_FAR_NORTH_DEG = 85.0
"""Latitude beyond which a position is implausible: no UTM zone reaches there."""
_SIGMA = (0.001, 1000.0)
"""Plausible standard deviations of positions in m."""
NO_HEMISPHERE = (
    "It does not say whether its latitude is north or south, or its longitude east or west; north"
    " and east are assumed."
)
"""A note of a photo whose GPS position lacks a reference."""
INVALID = "The GPS position in "
"""How a note of a photo begins whose GPS position is none."""
_YEARS = (1980, 2100)
_RTK_FLOAT, _RTK_FIXED = 34, 50
_DRONE_SIGMA = (1.5, 3.0)
_CAMERA_SIGMA = (5.0, 15.0)
"""Horizontal and vertical standard deviation in m where none is stated; a camera's receiver is
worse than an autopilot's.
"""


def read_position(exif: Exif, xmp: Xmp) -> tuple[GeoPosition | None, tuple[str, ...]]:
    """The measured position, or None, with sentences on what was invalid or implausible."""
    notes: list[str] = []
    found = _place(_xmp_degrees(xmp), "XMP", notes)
    source = "xmp"
    if found is None:
        found, source = _place(_exif_degrees(exif), "EXIF", notes), "exif"
        if found is not None and not _hemispheres_told(exif):
            notes.append(NO_HEMISPHERE)
        notes += tag.unmeasured(exif) if found is not None else []
    if found is None:
        return None, tuple(notes or ["It has no GPS position."])
    takeoff, sea, ellipsoid = _heights(exif, xmp, notes)
    sigma_xy, sigma_z = _sigmas(exif, xmp, notes, drone=_flown(xmp))
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


def read_height(exif: Exif, xmp: Xmp) -> float | None:
    """Height above take-off in m, which files may tell without a position; None where not."""
    return _heights(exif, xmp, [])[0]


def why_void(latitude: float | None, longitude: float | None) -> str:
    """Why a pair of degrees is not a position; empty when it is one."""
    if latitude is None or longitude is None:
        return "one of latitude and longitude is missing, not a number, or has parts beyond 60"
    if latitude == 0 and longitude == 0:
        return "it is (0, 0), which receivers write without a satellite fix"
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        return f"({latitude:g}, {longitude:g}) is outside the valid range"
    if abs(latitude) > _FAR_NORTH_DEG:
        return f"({latitude:g}, {longitude:g}) is at a pole, where no map projection fits"
    return ""


def _place(
    pair: tuple[float | None, float | None] | None, origin: str, notes: list[str]
) -> tuple[float, float] | None:
    if pair is None:
        return None
    reason = why_void(*pair)
    if reason:
        notes.append(f"{INVALID}{origin} is invalid: {reason}.")
        return None
    return pair[0] or 0.0, pair[1] or 0.0


def _xmp_degrees(xmp: Xmp) -> tuple[float | None, float | None] | None:
    """Degrees from XMP. `GpsLongtitude` is DJI's own spelling; other manufacturers use the same
    names.
    """
    for names in _XMP_PLACES:
        if any(xmp.text(*n) for n in names):
            return xmp.number(*names[0]), xmp.number(*names[1])
    return None


_XMP_PLACES = (
    (("GpsLatitude",), ("GpsLongitude", "GpsLongtitude")),
    (("drone-skydio:Latitude",), ("drone-skydio:Longitude",)),
    (("drone-dji:Latitude",), ("drone-dji:Longitude",)),
)
"""Names of latitude and longitude."""


def _exif_degrees(exif: Exif) -> tuple[float | None, float | None] | None:
    if tag.GPS_LAT not in exif.gps and tag.GPS_LON not in exif.gps:
        return None
    latitude = _sexagesimal(exif.gps.get(tag.GPS_LAT), as_text(exif.gps.get(tag.GPS_LAT_REF)))
    longitude = _sexagesimal(exif.gps.get(tag.GPS_LON), as_text(exif.gps.get(tag.GPS_LON_REF)))
    return latitude, longitude


def _hemispheres_told(exif: Exif) -> bool:
    """Whether EXIF says on which side of the equator and of Greenwich its position lies."""
    north, east = (as_text(exif.gps.get(t)).upper()[:1] for t in (tag.GPS_LAT_REF, tag.GPS_LON_REF))
    return north in ("N", "S") and east in ("E", "W")


def _sexagesimal(value: object, reference: str) -> float | None:
    parts = list(value) if isinstance(value, (tuple, list)) else [value]
    numbers = [n for part in parts[:3] if (n := as_number(part)) is not None]
    if not numbers or len(numbers) < len(parts[:3]) or any(abs(n) > 60 for n in numbers[1:]):
        return None
    size = [abs(n) for n in numbers]
    # some programs write decimals in each part, which tell the smaller parts again
    whole = [math.floor(n + 1e-6) if any(size[k + 1 :]) else n for k, n in enumerate(size)]
    degrees = sum(n / 60**i for i, n in enumerate(whole))
    # some programs write both a sign and a reference
    negative = any(n < 0 for n in numbers) or reference.upper()[:1] in ("S", "W")
    return float(-degrees if negative else degrees)


def _heights(
    exif: Exif, xmp: Xmp, notes: list[str]
) -> tuple[float | None, float | None, float | None]:
    """Heights above take-off, sea level and the ellipsoid in m."""
    written = as_number(exif.gps.get(tag.GPS_ALT))
    if written is not None and as_number(exif.gps.get(tag.GPS_ALT_REF)) == 1:
        written = -written
    absolute = xmp.number("AbsoluteAltitude")
    absolute = _sane(absolute if absolute is not None else written, "altitude", notes)
    above = xmp.number("RelativeAltitude", "drone-yuneec:AboveHomeAltitude")
    takeoff = _sane(above, "height above take-off", notes, _ABOVE_TAKEOFF)
    if _is_rtk(xmp):
        return takeoff, None, absolute
    return takeoff, absolute, None


def _sane(
    height: float | None, what: str, notes: list[str], limits: tuple[float, float] = _HEIGHTS
) -> float | None:
    if height is None or limits[0] <= height <= limits[1]:
        return height
    notes.append(f"The {what} of {height:g} m is not a possible flying height and was ignored.")
    return None


def _flown(xmp: Xmp) -> bool:
    """Whether the metadata were written by an autopilot."""
    return any(key.startswith(("drone-", "drone:", "Camera:")) for key in xmp.values)


def _is_rtk(xmp: Xmp) -> bool:
    flag = xmp.number("RtkFlag")
    return flag in (_RTK_FLOAT, _RTK_FIXED) or xmp.text("AltitudeType") == "RtkAlt"


def _best_height(
    takeoff: float | None, sea: float | None, ellipsoid: float | None
) -> tuple[float | None, Datum]:
    """RTK's ellipsoid height, else height above take-off (from a barometer, stable during a
    flight), else above sea level.
    """
    if ellipsoid is not None:
        return ellipsoid, "ellipsoid"
    if takeoff is not None:
        return takeoff, "takeoff"
    return sea, "sea_level" if sea is not None else "unknown"


def _sigmas(exif: Exif, xmp: Xmp, notes: list[str], *, drone: bool) -> tuple[float, float]:
    """Horizontal and vertical standard deviation in m: RTK's own, an accuracy tag, or a typical
    value.
    """
    xy, z = (s * tag.dilution(exif) for s in (_DRONE_SIGMA if drone else _CAMERA_SIGMA))

    def said(value: float | None) -> float | None:
        """A stated accuracy; zero means that it is not known."""
        if not value or _SIGMA[0] <= value <= _SIGMA[1]:
            return value
        if 0 < value < _SIGMA[0]:
            return _SIGMA[0]
        notes.append(f"The accuracy of {value:g} m of its position is not possible; it is ignored.")
        return None

    error = said(as_number(exif.gps.get(tag.GPS_ERROR)))
    xy = said(xmp.number(*_ACCURACIES[0])) or error or xy
    z = said(xmp.number(*_ACCURACIES[1])) or z
    if xmp.number("RtkFlag") in (_RTK_FLOAT, _RTK_FIXED):
        east, north, up = (said(xmp.number(f"RtkStd{axis}")) for axis in ("Lon", "Lat", "Hgt"))
        xy = max(east or 0.0, north or 0.0) or xy
        z = up or z
    return max(xy, 0.01), max(z, 0.01)


_ACCURACIES = (
    ("Camera:GPSXYAccuracy", "GPSXYAccuracy", "drone-skydio:GpsHorizontalAccuracy"),
    ("Camera:GPSZAccuracy", "GPSZAccuracy", "drone-skydio:GpsVerticalAccuracy"),
)
"""Names of deviations in m, horizontal and vertical."""
_GIMBAL = (
    ("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"),
    ("CameraYawDegree", "CameraPitchDegree", "CameraRollDegree"),
    tuple(f"CameraOrientationNED.{angle}" for angle in ("Yaw", "Pitch", "Roll")),
    tuple(f"drone-yuneec:Gimbal{angle}" for angle in ("Yaw", "Pitch", "Roll")),
)
_LOOKS_DOWN_AT_MINUS_90 = -45.0
_MOST_DEG = 720.0
_LOOKS_UP_DEG = 80.0
"""No survey camera looks to the zenith: such a pitch has the other sign than the usual one."""


def read_attitude(xmp: Xmp) -> tuple[Attitude | None, tuple[str, ...]]:
    """Belly angles, or None, with sentences on what is missing.

    `Gimbal*Degree` (DJI, Autel), `drone-parrot:Camera*Degree`, Skydio's `CameraOrientationNED` and
    `drone-yuneec:Gimbal*` are gimbal angles (pitch -90 = nadir). Pix4D's `Camera:Yaw/Pitch/Roll`
    (senseFly, Parrot Sequoia, MicaSense, older Autels) are belly angles: pitch 0 = nadir. Some
    files contain -90 there for nadir and are read as gimbal angles, because no survey camera looks
    backwards to the horizon. Angles that are all zero were not measured; a pitch of +90 is taken
    for -90.
    """
    for names in _GIMBAL:
        yaw, pitch, roll = (xmp.number(name) for name in names)
        if yaw == pitch == roll == 0:
            return None, _UNMEASURED
        if yaw is not None:
            return _impossible(yaw, pitch, roll) or _from_gimbal(yaw, pitch, roll, "xmp-gimbal")
    yaw, pitch, roll = (xmp.number(f"Camera:{a}") for a in ("Yaw", "Pitch", "Roll"))
    if yaw is not None and (refused := _impossible(yaw, pitch, roll)):
        return refused
    if yaw == pitch == roll == 0:  # FLIR's cameras write it where no autopilot is connected
        return None, _UNMEASURED
    if yaw is None:
        return None, ("It has no camera angles.",)
    if pitch is not None and pitch < _LOOKS_DOWN_AT_MINUS_90:
        return _from_gimbal(yaw, pitch, roll, "xmp-camera")
    attitude = Attitude(
        yaw_deg=yaw, pitch_deg=pitch or 0.0, roll_deg=roll or 0.0, source="xmp-camera"
    )
    return attitude, ()


_UNMEASURED = ("Its camera angles are all zero: they were not measured.",)


def _impossible(*angles: float | None) -> tuple[None, tuple[str, ...]] | None:
    """What is reported of angles of which one is more than two turns; None where all are
    possible.
    """
    bad = [a for a in angles if a is not None and abs(a) > _MOST_DEG]
    return (
        (None, (f"Camera angles of {bad[0]:g} degrees are not possible; they are ignored.",))
        if (bad)
        else None
    )


def read_flight_yaw(xmp: Xmp) -> tuple[float | None, tuple[str, ...]]:
    """Heading of the aircraft in degrees clockwise from north, or None, with a sentence where it is
    implausible.
    """
    yaw = xmp.number("FlightYawDegree", "DroneYawDegree", "drone-yuneec:DroneYaw")
    if yaw is None or abs(yaw) <= _MOST_DEG:
        return yaw, ()
    return None, (f"A flight yaw of {yaw:g} degrees is not possible; it is ignored.",)


def read_image_direction(exif: Exif) -> float | None:
    """Heading of the image top in degrees clockwise from north by EXIF's `GPSImgDirection`, which
    counts for the picture as it is to be shown (`Orientation`); None where it is absent, or zero,
    which programs write that know none.
    """
    shown = as_number(exif.gps.get(tag.GPS_DIRECTION))
    if not shown or abs(shown) > _MOST_DEG:
        return None
    return (shown + _TURNED_DEG.get(exif.number(tag.ORIENTATION) or 1.0, 0.0)) % 360


_TURNED_DEG = {3.0: 180.0, 6.0: 90.0, 8.0: -90.0}
"""Degrees clockwise by which a picture is turned to be shown, by its `Orientation`."""


def read_velocity(xmp: Xmp) -> tuple[float, float, float] | None:
    """Velocity of the aircraft north, east and down in m/s, as DJI writes it; None where it is
    absent or impossible.
    """
    said = [xmp.number(f"Flight{axis}Speed") for axis in "XYZ"]
    north, east, down = said
    if north is None or east is None or abs(north) > _FASTEST or abs(east) > _FASTEST:
        return None
    return north, east, down if down is not None and abs(down) < _FASTEST else 0.0


_FASTEST = 100.0
"""Greater speeds in m/s are no measurements."""


def read_flight_tilt(xmp: Xmp) -> tuple[float, float]:
    """Pitch and roll of the aircraft in degrees; 0 where they are absent or impossible."""
    pitch, roll = (
        xmp.number(f"Flight{axis}Degree", f"Drone{axis}Degree", f"drone-yuneec:Drone{axis}") or 0.0
        for axis in ("Pitch", "Roll")
    )
    return (pitch, roll) if max(abs(pitch), abs(roll)) <= _MOST_DEG else (0.0, 0.0)


def _from_gimbal(
    yaw: float, pitch: float | None, roll: float | None, source: str
) -> tuple[Attitude, tuple[str, ...]]:
    notes: tuple[str, ...] = ()
    if pitch is None:
        notes = ("It has a gimbal yaw but no pitch; straight down is assumed.",)
    elif pitch > _LOOKS_UP_DEG:
        notes = (f"Its gimbal pitch of {pitch:+g} degrees is taken for {-pitch:+g}, downwards.",)
        pitch = -pitch
    belly = belly_from_gimbal(yaw, -90.0 if pitch is None else pitch, roll or 0.0)
    attitude = Attitude(yaw_deg=belly[0], pitch_deg=belly[1], roll_deg=belly[2], source=source)
    return attitude, notes


_MOMENT = re.compile(
    r"(\d{4})[:\-/.](\d\d)[:\-/.](\d\d)[ T](\d\d):(\d\d):(\d\d)(\.\d+)?\s*(Z|[+-]\d\d:?\d\d)?",
    re.ASCII,
)


def read_time(exif: Exif, xmp: Xmp) -> datetime | None:
    """EXIF DateTimeOriginal with sub-seconds and offset, else the GPS time (UTC), else XMP; None if
    there is none.
    """
    moment = parse_moment(exif.text(tag.TAKEN), exif.text(tag.SUBSEC), exif.text(tag.OFFSET))
    if moment is None:
        moment = _gps_time(exif)
    if moment is None:
        moment = parse_moment(
            xmp.text("exif:DateTimeOriginal", "xmp:CreateDate", "photoshop:DateCreated")
        )
    return moment or parse_moment(exif.text(tag.MODIFIED))


def modified_time(exif: Exif) -> datetime | None:
    """EXIF DateTime: when a program that updates this tag last wrote the file."""
    return parse_moment(exif.text(tag.MODIFIED))


def parse_moment(text: str, subseconds: str = "", offset: str = "") -> datetime | None:
    """Time from `2016:06:23 16:31:59` (also ISO 8601) with sub-seconds and an offset such as
    `+02:00`, in the text or passed separately; else None.
    """
    found = _MOMENT.match(text.strip())
    if not found:
        return None
    digits = re.fullmatch(r"[0-9]{1,9}", subseconds)
    fraction = (found[7] or "")[:10] or (f".{subseconds}" if digits else "")
    try:
        moment = datetime(*(int(found[i]) for i in range(1, 7)))  # type: ignore[arg-type]
        if not _YEARS[0] <= moment.year < _YEARS[1]:
            return None
        moment += timedelta(seconds=float(fraction or 0))
        return moment.replace(tzinfo=_zone(found[8] or offset))
    except (ValueError, OverflowError):
        return None


def _zone(text: str) -> timezone | None:
    found = re.fullmatch(r"([+-])(\d\d):?(\d\d)", text.strip())
    if not found:
        return UTC if text.strip() == "Z" else None
    away = timedelta(hours=int(found[2]), minutes=int(found[3]))
    return timezone(-away if found[1] == "-" else away)


def _gps_time(exif: Exif) -> datetime | None:
    clock = exif.gps.get(tag.GPS_TIME)
    parts = [as_number(p) for p in clock] if isinstance(clock, (tuple, list)) else []
    # some cameras write the time behind the date, too
    day = parse_moment(as_text(exif.gps.get(tag.GPS_DATE))[:10] + " 00:00:00")
    if day is None or len(parts) != 3 or None in parts:
        return None
    hours, minutes, seconds = (p or 0.0 for p in parts)
    if not 0 <= hours * 3600 + minutes * 60 + seconds <= 2 * 86400:
        return None
    try:
        return (day + timedelta(hours=hours, minutes=minutes, seconds=seconds)).replace(tzinfo=UTC)
    except OverflowError:
        return None


_PROGRAMS = re.compile(
    r"photo ?viewer|photoshop|lightroom|camera"
    r" raw|adobe|gimp|paint|microsoft|windows|picasa|snapseed|acdsee|"
    r"xnview|irfanview|faststone|imagemagick|graphicsmagick|darktable|rawtherapee|capture"
    r" one|affinity|"
    r"pixelmator|digikam|gthumb|shotwell|photos \d|preview|mac"
    r" os|macos|luminar|dxo|corel|photoscape|"
    r"google|instagram|pix4d|agisoft|metashape|opencv|matlab|ffmpeg|dji photo|silkypix|topaz",
    re.IGNORECASE,
)


def find_editor(exif: Exif, xmp: Xmp) -> str | None:
    """The program that EXIF or XMP names, unless it is a camera's firmware; else None."""
    named = (exif.text(tag.SOFTWARE), xmp.text("xmp:CreatorTool"), xmp.text("softwareAgent"))
    return next((name for name in named if _PROGRAMS.search(name)), None)
