"""EXIF and XMP of simulated photos, and the files themselves."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from io import BytesIO
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

from skyquilt.simulate.reported import Report

MAKE = "Skyquilt"
_PITCH_MM = 0.004  # size of a sensor pixel
_EXIF_IFD, _GPS_IFD, _XMP_TAG = 0x8769, 0x8825, 700


@dataclass(frozen=True, kw_only=True)
class Body:
    """Metadata that a camera writes into every file."""

    model: str
    """Camera model."""
    serial: str
    """Camera serial number."""
    start: datetime
    """Clock time at which the flight starts."""


def write_jpeg(
    path: Path, pixels: NDArray[np.uint8], report: Report, body: Body, quality: int
) -> None:
    """Writes a photo (h, w, 3) with its metadata."""
    exif = _exif(report, body, max(pixels.shape[:2]))
    buffer = BytesIO()
    Image.fromarray(pixels).save(
        buffer, "JPEG", quality=quality, subsampling=2, exif=exif.tobytes()
    )
    data = buffer.getvalue()
    xmp = _xmp(report)
    if xmp is not None:
        segment = b"http://ns.adobe.com/xap/1.0/\x00" + xmp
        at = 4 + int.from_bytes(data[4:6], "big")  # after the EXIF segment
        data = data[:at] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + data[at:]
    path.write_bytes(data)


def write_tiff(
    path: Path,
    counts: NDArray[np.uint16],
    report: Report,
    body: Body,
    what: str = "unit: centikelvin (temperature in K times 100)",
    more: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Writes counts (h, w), thermal ones in hundredths of a kelvin, with their metadata; `what`
    they are, and `more` XMP.
    """
    exif = _exif(report, body, max(counts.shape))
    exif[0x010E] = what
    tags = ImageFileDirectory_v2()
    for tag, value in exif.items():
        tags[tag] = value
    for ifd in (_EXIF_IFD, _GPS_IFD):
        tags[ifd] = dict(exif.get_ifd(ifd))
    xmp = _xmp(report, more)
    if xmp is not None:
        tags[_XMP_TAG] = xmp
        tags.tagtype[_XMP_TAG] = 1
    Image.fromarray(counts).save(path, "TIFF", tiffinfo=tags)  # uncompressed: libtiff drops EXIF


def _exif(report: Report, body: Body, longer: int) -> Image.Exif:
    """Tags of a picture whose longer side has this many px."""
    exif = Image.Exif()
    moment = body.start + timedelta(seconds=report.clock)
    exif[0x010F], exif[0x0110] = MAKE, body.model
    exif[0x0112] = 1
    exif[0x0132] = moment.strftime("%Y:%m:%d %H:%M:%S")
    if report.turned:
        exif[0x0131] = "Photo viewer 1.0"
    ifd = exif.get_ifd(_EXIF_IFD)
    ifd[0x9003] = moment.strftime("%Y:%m:%d %H:%M:%S")
    ifd[0x9291] = f"{moment.microsecond // 1000:03d}"
    ifd[0xA431] = body.serial
    ifd[0x829A] = IFDRational(1, 1000)
    if report.focal is not None:
        millimetres = report.focal * _PITCH_MM
        ifd[0x920A] = _rational(millimetres, 10_000)
        ifd[0xA20E] = ifd[0xA20F] = _rational(10 / _PITCH_MM, 100)
        ifd[0xA210] = 3
        ifd[0xA405] = round(millimetres * 36 / (longer * _PITCH_MM))
    if report.latitude is not None and report.longitude is not None:
        _gps(exif.get_ifd(_GPS_IFD), report.latitude, report.longitude, report.sea_level)
    return exif


def _gps(
    gps: dict[int, object], latitude: float, longitude: float, sea_level: float | None
) -> None:
    gps[0] = b"\x02\x03\x00\x00"
    gps[1], gps[2] = "N" if latitude >= 0 else "S", _degrees(abs(latitude))
    gps[3], gps[4] = "E" if longitude >= 0 else "W", _degrees(abs(longitude))
    if sea_level is not None:
        gps[5], gps[6] = b"\x00" if sea_level >= 0 else b"\x01", _rational(abs(sea_level), 1000)
    gps[18] = "WGS-84"


def _rational(value: float, denominator: int) -> IFDRational:
    return IFDRational(round(value * denominator), denominator)


def _degrees(value: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    whole = int(value)
    minutes = int((value - whole) * 60)
    seconds = ((value - whole) * 60 - minutes) * 60
    return IFDRational(whole, 1), IFDRational(minutes, 1), _rational(seconds, 1_000_000)


def _xmp(report: Report, more: Mapping[str, str] = MappingProxyType({})) -> bytes | None:
    """The XMP packet as DJI drones write it; None where it would be empty."""
    if report.gimbal is None or report.takeoff is None or report.flight_yaw is None:
        return None
    values = {
        "RelativeAltitude": f"{report.takeoff:+.3f}",
        "GimbalYawDegree": f"{report.gimbal[0]:+.2f}",
        "GimbalPitchDegree": f"{report.gimbal[1]:+.2f}",
        "GimbalRollDegree": f"{report.gimbal[2]:+.2f}",
        "FlightYawDegree": f"{report.flight_yaw:+.2f}",
        "FlightPitchDegree": "+0.00",
        "FlightRollDegree": "+0.00",
    }
    if report.latitude is not None and report.sea_level is not None:
        values["GpsLatitude"] = f"{report.latitude:+.9f}"
        values["GpsLongitude"] = f"{report.longitude:+.9f}"
        values["AbsoluteAltitude"] = f"{report.sea_level:+.3f}"
    if report.velocity is not None:
        for axis, speed in zip("XYZ", report.velocity, strict=True):
            values[f"Flight{axis}Speed"] = f"{speed:+.1f}"
    if report.dewarp is not None:
        numbers = ",".join(f"{v:.9f}" for v in report.dewarp)
        values["DewarpData"] = f"2026-01-01;{numbers}"
        values["DewarpFlag"] = "0"
    if report.rtk is not None:
        flat, up = report.rtk
        values |= {"RtkFlag": "50", "RtkStdLon": f"{flat:.5f}", "RtkStdLat": f"{flat:.5f}"}
        values["RtkStdHgt"] = f"{up:.5f}"
    values |= more
    attributes = "".join(f'\n   drone-dji:{key}="{value}"' for key, value in values.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        '  <rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"'
        f"{attributes}/>\n"
        ' </rdf:RDF>\n</x:xmpmeta>\n<?xpacket end="w"?>'
    ).encode()
