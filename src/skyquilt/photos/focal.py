"""The focal length in px of this file, by the most trustworthy way its metadata allow."""

import math

from skyquilt.model.camera import Camera
from skyquilt.model.photo import Focal
from skyquilt.photos import exif as tag
from skyquilt.photos.exif import Exif
from skyquilt.photos.sensors import Sensor

_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_PLAUSIBLE = (0.2, 60.0)
"""A focal length outside these multiples of the long side is a slip of the pen, not a lens."""
_MOST_ZOOM = 16.0
_APART = 1.2
"""Focal lengths that differ by more than this factor contradict each other; 35 mm values are
rounded.
"""


def native_scale(exif: Exif, width: int, height: int) -> tuple[float, str]:
    """How many px of the file stand for one px as taken, and a note where the sizes disagree in
    shape.

    EXIF keeps the size the camera wrote; a reduced copy still carries it. 1.0 where EXIF says
    nothing.
    """
    x, y = exif.number(tag.PIXELS_X), exif.number(tag.PIXELS_Y)
    if not x or not y or x < 1 or y < 1:
        return 1.0, ""
    long, short = max(x, y), min(x, y)
    scale = max(width, height) / long
    if abs(min(width, height) / short / scale - 1) > 0.02:
        return scale, (
            f"EXIF says {x:.0f}x{y:.0f} px, the file has {width}x{height}: cropped or padded, so"
            " the focal "
            "length and any calibration in the metadata are uncertain."
        )
    return scale, ""


def find_focal(
    *,
    exif: Exif,
    sensor: Sensor | None,
    calibration: Camera | None,
    width: int,
    height: int,
    thermal: bool = False,
) -> Focal:
    """The first of: calibrated, mm on the sensor, focal-plane resolution, 35 mm equivalent, a
    guess.
    """
    candidates = (
        _calibrated(calibration),
        _on_sensor(exif, sensor, width, height),
        _on_plane(exif, width, height),
        _from_35mm(exif, width, height),
    )
    long = max(width, height)
    for found in candidates:
        if found and _PLAUSIBLE[0] * long <= found.px <= _PLAUSIBLE[1] * long:
            return found
    px, share = (1.15 * width, 0.30) if thermal else (0.85 * long, 0.25)
    return Focal(px=px, sigma_px=share * px, source="guess")


def digital_zoom(exif: Exif) -> float:
    """By how much the camera enlarged the middle of its image; 1.0 where EXIF says nothing."""
    zoom = exif.number(tag.ZOOM) or 1.0
    return zoom if 1.0 < zoom <= _MOST_ZOOM else 1.0


def focal_notes(exif: Exif, sensor: Sensor | None, width: int, height: int) -> tuple[str, ...]:
    """Where EXIF's ways to the focal length disagree, and a digital zoom."""
    zoom = digital_zoom(exif)
    zoomed = (
        f"It was taken with a digital zoom of {zoom:g}; the focal length counts it in."
        if zoom > 1
        else ""
    )
    direct = _on_sensor(exif, sensor, width, height) or _on_plane(exif, width, height)
    rounded = _from_35mm(exif, width, height)
    if direct and rounded and not 1 / _APART < direct.px / rounded.px < _APART:
        return zoomed, (
            f"Its focal length in mm means {direct.px:.0f} px, its 35 mm equivalent"
            f" {rounded.px:.0f} px; "
            "one of them is wrong."
        )
    return (zoomed,)


def _calibrated(camera: Camera | None) -> Focal | None:
    if camera is None:
        return None
    sigma = camera.sigmas[0] if camera.sigmas else 0.01 * camera.focal
    return Focal(px=camera.focal, sigma_px=sigma, source="calibrated")


def _on_sensor(exif: Exif, sensor: Sensor | None, width: int, height: int) -> Focal | None:
    if sensor is None:
        return None
    written = exif.number(tag.FOCAL_MM)
    mm = written or sensor.focal_mm
    if not mm or mm < 0:
        return None
    px = mm / sensor.width_mm * max(width, height) * digital_zoom(exif)
    return Focal(px=px, sigma_px=(0.02 if written else 0.05) * px, source="sensor")


def _on_plane(exif: Exif, width: int, height: int) -> Focal | None:
    mm, resolution = exif.number(tag.FOCAL_MM), exif.number(tag.PLANE_X)
    unit = _MM_PER_UNIT.get(int(exif.number(tag.PLANE_UNIT) or 2))
    if not mm or not resolution or unit is None or mm < 0 or resolution < 0:
        return None
    px = mm * resolution / unit * native_scale(exif, width, height)[0] * digital_zoom(exif)
    return Focal(px=px, sigma_px=0.03 * px, source="focal-plane")


def _from_35mm(exif: Exif, width: int, height: int) -> Focal | None:
    mm = exif.number(tag.FOCAL_35MM)
    if not mm or mm < 0:
        return None
    px = mm / _DIAGONAL_35MM * math.hypot(width, height)
    return Focal(px=px, sigma_px=0.05 * px, source="35mm")
