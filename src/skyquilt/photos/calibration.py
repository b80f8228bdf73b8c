"""Intrinsics that the manufacturer wrote into the metadata, as a `Camera` of this file's size."""

from dataclasses import replace

from skyquilt.model.camera import Camera
from skyquilt.photos import tags as tag
from skyquilt.photos.lens import Sensor
from skyquilt.photos.tags import Exif, Xmp

_SIGMA_SHARE = {"focal": 0.01, "centre": 0.003}
_SIGMA_RADIAL, _SIGMA_TANGENTIAL = 0.01, 0.001
"""Standard deviations assumed for a manufacturer's distortion coefficients."""


def read_calibration(
    *, exif: Exif, xmp: Xmp, sensor: Sensor | None, width: int, height: int, scale: float
) -> Camera | None:
    """The first of DJI's `DewarpData`, Pix4D's `Camera:Perspective*` and DJI's
    `CalibratedFocalLength`.

    `scale` is this file's px per px as captured (`lens.native_scale`): the calibration refers to
    the latter.
    """
    native = (round(width / scale), round(height / scale))
    found = (
        _dewarp(xmp, native)
        or _perspective(exif, xmp, sensor, native)
        or _calibrated_focal(xmp, native)
    )
    return found and rescaled(found, width=width, height=height)


def rescaled(camera: Camera, *, width: int, height: int) -> Camera:
    """The same lens on an image of another size with the same field of view."""
    s = max(width, height) / max(camera.width, camera.height)
    if s == 1.0:
        return camera
    sigmas = camera.sigmas and (*(v * s for v in camera.sigmas[:3]), *camera.sigmas[3:])
    return replace(
        camera,
        width=width,
        height=height,
        focal=camera.focal * s,
        cx=(camera.cx + 0.5) * s - 0.5,
        cy=(camera.cy + 0.5) * s - 0.5,
        sigmas=sigmas,
    )


def _dewarp(xmp: Xmp, size: tuple[int, int]) -> Camera | None:
    """`date;fx,fy,cx,cy,k1,k2,p1,p2,k3`, cx and cy from the image centre; flag 1: already
    undistorted.
    """
    _, _, numbers = xmp.text("DewarpData").partition(";")
    try:
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = (float(n) for n in numbers.split(","))
    except ValueError:
        return None
    if xmp.number("DewarpFlag") == 1:
        k1 = k2 = k3 = p1 = p2 = 0.0
    return _camera(size, (fx + fy) / 2, (cx + size[0] / 2, cy + size[1] / 2), (k1, k2, k3, p1, p2))


def _perspective(
    exif: Exif, xmp: Xmp, sensor: Sensor | None, size: tuple[int, int]
) -> Camera | None:
    """Lengths in mm on the sensor, from its corner; distortion as OpenCV's k1, k2, k3, p1, p2."""
    mm = xmp.number("Camera:PerspectiveFocalLength")
    if not mm or xmp.text("Camera:ModelType").lower() == "fisheye":
        return None
    px_per_mm = _px_per_mm(exif, sensor, size)
    if xmp.text("Camera:PerspectiveFocalLengthUnits").lower().startswith("pix"):
        px_per_mm = 1.0
    if px_per_mm is None:
        return None
    point = xmp.numbers("Camera:PrincipalPoint")
    centre = (
        (point[0] * px_per_mm, point[1] * px_per_mm)
        if len(point) == 2
        else (size[0] / 2, size[1] / 2)
    )
    distortion = xmp.numbers("Camera:PerspectiveDistortion")
    return _camera(size, mm * px_per_mm, centre, distortion if len(distortion) == 5 else None)


def _px_per_mm(exif: Exif, sensor: Sensor | None, size: tuple[int, int]) -> float | None:
    resolution = exif.number(tag.PLANE_X)
    mm = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}.get(int(exif.number(tag.PLANE_UNIT) or 2))
    if resolution and mm:
        return resolution / mm
    return max(size) / sensor.width_mm if sensor else None


def _calibrated_focal(xmp: Xmp, size: tuple[int, int]) -> Camera | None:
    """DJI's value in px; its optical centre is counted from the image's corner."""
    focal = xmp.number("CalibratedFocalLength")
    x, y = xmp.number("CalibratedOpticalCenterX"), xmp.number("CalibratedOpticalCenterY")
    centre = (x, y) if x and y else (size[0] / 2, size[1] / 2)
    return _camera(size, focal, centre, None) if focal else None


def _camera(
    size: tuple[int, int],
    focal: float,
    centre: tuple[float, float],
    distortion: tuple[float, ...] | None,
) -> Camera | None:
    """A camera from px counted from the corner; None where the numbers are not plausible for a
    lens.
    """
    long = max(size)
    inside = all(0.25 * s < c < 0.75 * s for c, s in zip(centre, size, strict=True))
    if not (
        0.2 * long < focal < 60 * long and inside and all(abs(k) < 10 for k in distortion or ())
    ):
        return None
    k1, k2, k3, p1, p2 = distortion or (0.0,) * 5
    sigmas = (
        _SIGMA_SHARE["focal"] * focal,
        *(_SIGMA_SHARE["centre"] * long,) * 2,
        *(_SIGMA_RADIAL,) * 3,
        *(_SIGMA_TANGENTIAL,) * 2,
    )
    w, h = size
    cx, cy = centre[0] - 0.5, centre[1] - 0.5
    return Camera(
        width=w,
        height=h,
        focal=focal,
        cx=cx,
        cy=cy,
        k1=k1,
        k2=k2,
        k3=k3,
        p1=p1,
        p2=p2,
        sigmas=sigmas,
    )
