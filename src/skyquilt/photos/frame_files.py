"""A frame of a clip as a JPEG file with the metadata of a photo, from which `read_photo` reads the
same position, time and yaw.
"""

import math
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from skyquilt.model.photo import GeoPosition, Photo

QUALITY = 95
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_DIAGONAL_35MM = math.hypot(36.0, 24.0)


def frame_jpeg(photo: Photo, pixels: NDArray[Any]) -> bytes:
    """The bytes of the file; `pixels` (height, width, 3) RGB of the frame."""
    buffer = BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(
        buffer, "JPEG", quality=QUALITY, subsampling=0, exif=_exif(photo), xmp=_xmp(photo)
    )
    return buffer.getvalue()


def _exif(photo: Photo) -> bytes:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "video", photo.camera_key.removeprefix("video ")
    inside = exif.get_ifd(_EXIF_IFD)
    if photo.time is not None:
        inside[0x9003] = photo.time.strftime("%Y:%m:%d %H:%M:%S")
        inside[0x9291] = f"{photo.time.microsecond // 1000:03d}"
    if photo.focal.source != "guess":
        diagonal = math.hypot(photo.width, photo.height)
        inside[0xA405] = round(photo.focal.px / diagonal * _DIAGONAL_35MM)
    if photo.position is not None:
        gps, place = exif.get_ifd(_GPS_IFD), photo.position
        gps[1], gps[2] = "N" if place.latitude_deg >= 0 else "S", _degrees(place.latitude_deg)
        gps[3], gps[4] = "E" if place.longitude_deg >= 0 else "W", _degrees(place.longitude_deg)
    return exif.tobytes()


def _degrees(value: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    seconds = abs(value) * 3600
    whole, minutes = int(seconds // 3600), int(seconds // 60 % 60)
    return (
        IFDRational(whole, 1),
        IFDRational(minutes, 1),
        IFDRational(round((seconds - 3600 * whole - 60 * minutes) * 1_000_000), 1_000_000),
    )


def _xmp(photo: Photo) -> bytes:
    values = _heights(photo.position) if photo.position else {}
    if photo.attitude is not None:
        values["drone-dji:GimbalYawDegree"] = f"{photo.attitude.yaw_deg:+.2f}"
        values["drone-dji:GimbalPitchDegree"] = f"{photo.attitude.pitch_deg - 90:+.2f}"
        values["drone-dji:GimbalRollDegree"] = "+0.00"
    if photo.flight_yaw_deg is not None:
        values["drone-dji:FlightYawDegree"] = f"{photo.flight_yaw_deg:+.2f}"
    said = "".join(f' {k}="{v}"' for k, v in values.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"'
        ' xmlns:Camera="http://pix4d.com/camera/1.0/"'
        f"{said}/></rdf:RDF></x:xmpmeta>"
    ).encode()


def _heights(place: GeoPosition) -> dict[str, str]:
    out = {
        "Camera:GPSXYAccuracy": f"{place.sigma_xy_m:.2f}",
        "Camera:GPSZAccuracy": f"{place.sigma_z_m:.2f}",
    }
    if place.takeoff_m is not None:
        out["drone-dji:RelativeAltitude"] = f"{place.takeoff_m:+.3f}"
    if place.sea_level_m is not None:
        out["drone-dji:AbsoluteAltitude"] = f"{place.sea_level_m:+.3f}"
    return out
