"""The lens of a photo: sensor database, focal length, and calibrations in XMP."""

import csv
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Literal

from skyquilt.geometry.camera_formats import angular_of_pix4d, radial_of_rational
from skyquilt.model.camera import ADJUSTABLE, Camera
from skyquilt.model.photo import Focal
from skyquilt.outside import plain
from skyquilt.photos import tags as tag
from skyquilt.photos.capture import Native
from skyquilt.photos.guesses import guessed_focal
from skyquilt.photos.tags import Exif, Xmp


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """One row of `sensors.csv`."""

    make: str
    """As in EXIF."""
    model: str
    """As in EXIF."""
    image_width: int | None
    """Long side in px of the images to which this row applies; None = all images of the model."""
    width_mm: float
    """Length of the sensor's long side in mm."""
    focal_mm: float | None
    """Focal length of a fixed lens in mm; used where EXIF has none."""
    shutter: Literal["rolling", "global", ""]
    """`global` includes mechanical shutters."""
    band: Literal["visible", "thermal"]
    """Spectrum."""


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9+]", "", text.lower())


def _row(row: dict[str, str]) -> Sensor:
    return Sensor(
        make=row["make"],
        model=row["model"],
        image_width=int(row["image_width"]) if row["image_width"] else None,
        width_mm=float(row["sensor_width_mm"]),
        focal_mm=float(row["focal_mm"]) if row["focal_mm"] else None,
        shutter=row["shutter"],  # type: ignore[arg-type]
        band=row["band"],  # type: ignore[arg-type]
    )


@cache
def _table() -> dict[str, tuple[Sensor, ...]]:
    text = files("skyquilt.photos").joinpath("sensors.csv").read_text("utf-8")
    table: dict[str, tuple[Sensor, ...]] = {}
    for row in map(_row, csv.DictReader(text.splitlines())):
        table[_plain(row.model)] = (*table.get(_plain(row.model), ()), row)
    return table


def find_sensor(*, model: str, long_side: int) -> Sensor | None:
    """The row for an EXIF model name and the long side in px of its images as captured; None if
    unknown.

    For a model with rows for several image sizes (a visible and a thermal camera) the size must
    match.
    """
    rows = _table().get(_plain(model), ())
    exact = [r for r in rows if r.image_width == long_side]
    general = [r for r in rows if r.image_width is None]
    return next(iter(exact + general), None)


_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_PLAUSIBLE = (0.2, 60.0)
"""A focal length outside these multiples of the long side is an error, not a lens."""
_MOST_ZOOM = 16.0
_WIDEST_35MM = 11.0
"""A smaller 35 mm equivalent, in mm, is none: some programs write the focal length there, which
small sensors have. Only a circular fisheye is as wide.
"""
_APART = 1.2
"""Focal lengths that differ by more than this factor contradict each other; 35 mm values are
rounded.
"""


def find_focal(
    *,
    exif: Exif,
    sensor: Sensor | None,
    calibration: Camera | None,
    native: Native,
    thermal: bool = False,
) -> Focal:
    """The first available of: calibrated, mm on the sensor, focal-plane resolution, 35 mm
    equivalent, a guess; in px of the file.
    """
    size = native.width, native.height
    candidates = (
        _on_sensor(exif, sensor, *size),
        _believed_plane(exif, *size),
        _from_35mm(exif, *size),
    )
    in_file = (native.focal_of_file(f) for f in candidates if f)
    long = max(native.file)
    for found in (_calibrated(calibration), *in_file):
        if found and _PLAUSIBLE[0] * long <= found.px <= _PLAUSIBLE[1] * long:
            return found
    return native.focal_of_file(guessed_focal(*size, thermal=thermal))


def digital_zoom(exif: Exif) -> float:
    """Factor by which the camera enlarged the middle of its image; 1.0 where EXIF has none."""
    zoom = exif.number(tag.ZOOM) or 1.0
    return zoom if 1.0 < zoom <= _MOST_ZOOM else 1.0


def focal_notes(exif: Exif, sensor: Sensor | None, native: Native) -> tuple[str, ...]:
    """Notes on focal lengths in EXIF that disagree, and on a digital zoom."""
    zoom = digital_zoom(exif)
    zoomed = (
        f"It was taken with a digital zoom of {zoom:g}; the focal length includes it."
        if zoom > 1
        else ""
    )
    size = native.width, native.height
    direct = _on_sensor(exif, sensor, *size) or _on_plane(exif)
    rounded = _from_35mm(exif, *size)
    if direct and rounded and not _agree(direct.px, rounded.px):
        px, other = (native.focal_of_file(f).px for f in (direct, rounded))
        return zoomed, (
            f"Its focal length in mm corresponds to {px:.0f} px, its 35 mm equivalent to"
            f" {other:.0f} px; "
            "one of them is wrong."
        )
    return (zoomed,)


def _calibrated(camera: Camera | None) -> Focal | None:
    if camera is None:
        return None
    sigma = camera.sigmas[0] if camera.sigmas else 0.01 * camera.focal
    return Focal(px=camera.focal, sigma_px=sigma, source="calibrated")


def _on_sensor(exif: Exif, sensor: Sensor | None, width: float, height: float) -> Focal | None:
    if sensor is None:
        return None
    written = exif.number(tag.FOCAL_MM)
    mm = written or sensor.focal_mm
    if not mm or mm < 0:
        return None
    px = mm / sensor.width_mm * max(width, height) * digital_zoom(exif)
    return Focal(px=px, sigma_px=(0.02 if written else 0.05) * px, source="sensor")


def _on_plane(exif: Exif) -> Focal | None:
    mm, resolution = exif.number(tag.FOCAL_MM), exif.number(tag.PLANE_X)
    unit = _MM_PER_UNIT.get(int(exif.number(tag.PLANE_UNIT) or 2))
    if not mm or not resolution or unit is None or mm < 0 or resolution < 0:
        return None
    px = mm * resolution / unit * digital_zoom(exif)
    return Focal(px=px, sigma_px=0.03 * px, source="focal-plane")


def _believed_plane(exif: Exif, width: float, height: float) -> Focal | None:
    """By focal-plane resolution, in the unit with which it agrees with the 35 mm equivalent, since
    cameras confuse inches and centimetres. Where it agrees in none, either of the two may be wrong:
    what is nearer to the usual focal length is taken, and known no better than that.
    """
    found, rounded = _on_plane(exif), _from_35mm(exif, width, height)
    if found is None or rounded is None or _agree(found.px, rounded.px):
        return found
    stated = _MM_PER_UNIT[int(exif.number(tag.PLANE_UNIT) or 2)]
    for mm in _MM_PER_UNIT.values():
        px = found.px * stated / mm
        if _agree(px, rounded.px):
            return Focal(px=px, sigma_px=0.03 * px, source="focal-plane")
    usual = guessed_focal(width, height, thermal=False)
    nearer = min((found, rounded), key=lambda f: abs(math.log(f.px / usual.px)))
    return replace(nearer, sigma_px=nearer.px * usual.sigma_px / usual.px)


def _agree(px: float, other: float) -> bool:
    return 1 / _APART < px / other < _APART


def _from_35mm(exif: Exif, width: float, height: float) -> Focal | None:
    mm = exif.number(tag.FOCAL_35MM)
    if not mm or mm < _WIDEST_35MM:
        return None
    px = mm / _DIAGONAL_35MM * math.hypot(width, height)
    return Focal(px=px, sigma_px=0.05 * px, source="35mm")


_SIGMA_FOCAL, _SIGMA_CENTRE = 0.01, 0.005
"""Deviations of a camera's own calibration: of the focal length, and of the principal point as a
share of the long side. A calibration is a measurement that may be wrong: of another temperature,
another setting of the focus, another camera of the model.
"""
_SIGMA_RADIAL, _SIGMA_TANGENTIAL, _SIGMA_ASPECT = 0.02, 0.004, 0.0015
"""Deviations of its distortion coefficients and of its ratio of focal lengths."""
_UNTOLD = (0.1, 0.1, 0.05, 0.002, 0.002, 0.003)
"""Deviations of k1, k2, k3, p1, p2 and the ratio where a calibration gives only lengths."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundCalibration:
    """The calibration that a photo's metadata give, if any."""

    camera: Camera | None = None
    """None where there is none, or none that a lens can have."""
    nonsense: tuple[str, ...] = ()
    """Phrases on calibrations that are there and cannot be meant."""


def read_calibration(
    *, exif: Exif, xmp: Xmp, sensor: Sensor | None, picture: Native
) -> FoundCalibration:
    """The first of DJI's `DewarpData` or `DewarpDataK6`, Pix4D's `Camera:Perspective*` or
    `Camera:Fisheye*` and DJI's `CalibratedFocalLength` that a lens can have.

    The calibration refers to the picture as captured.
    """
    native = (round(picture.width), round(picture.height))
    readers: tuple[tuple[str, Callable[[], Camera | str | None]], ...] = (
        ("DewarpData", lambda: _dewarp(xmp, native)),
        ("Camera:Perspective...", lambda: _perspective(exif, xmp, sensor, native)),
        ("Camera:Fisheye...", lambda: _fisheye(exif, xmp, sensor, native)),
        ("CalibratedFocalLength", lambda: _calibrated_focal(xmp, native)),
    )
    found_otherwise = (_on_sensor(exif, sensor, *native), _from_35mm(exif, *native))
    others = () if digital_zoom(exif) > 1 else tuple(f for f in found_otherwise if f is not None)
    nonsense: list[str] = []
    for name, read in readers:
        found = read()
        if isinstance(found, Camera):
            found = _of_this_size(found, others)
        if isinstance(found, Camera):
            return FoundCalibration(camera=picture.camera_of_file(found), nonsense=tuple(nonsense))
        if found:
            nonsense.append(f"{name}: {found}")
    return FoundCalibration(nonsense=tuple(nonsense))


_ANOTHER_SIZE = 1.3
"""A calibrated focal length that differs from the camera's own by more than this factor belongs to
a picture of another size.
"""


def _of_this_size(camera: Camera, others: Sequence[Focal]) -> Camera | str:
    """The camera, or why it cannot be that of a photo with these focal lengths by its sensor and
    its 35 mm equivalent. One that agrees is enough: a model's lenses may be confused.
    """
    if not any(f.source == "sensor" for f in others) or any(
        1 / _ANOTHER_SIZE < camera.focal / f.px < _ANOTHER_SIZE for f in others
    ):
        return camera
    return (
        f"its focal length of {camera.focal:.4g} px is that of a picture of another size; the"
        f" camera has {others[0].px:.4g} px"
    )


def _dewarp(xmp: Xmp, size: tuple[int, int]) -> Camera | str | None:
    """`DewarpData`: `date;fx,fy,cx,cy,k1,k2,p1,p2,k3`, cx and cy from the image centre;
    `DewarpDataK6` has k4, k5, k6 besides. Flag 1: already undistorted. Zeros alone tell nothing.
    """
    found: Camera | str | None = None
    for name, count in (("DewarpData", 9), ("DewarpDataK6", 12)):
        _, _, text = xmp.text(name).partition(";")
        if not text.strip():
            continue
        try:
            numbers = tuple(float(n) for n in text.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != count or not all(math.isfinite(n) for n in numbers):
            found = found or f"it is not {count} finite numbers"
        elif any(numbers):
            found = _dewarped(numbers, already_undistorted(xmp), size)
        if isinstance(found, Camera):
            break
    return found


def already_undistorted(xmp: Xmp) -> bool:
    """Whether the camera took the distortion out of the picture (DJI's `DewarpFlag`)."""
    return xmp.number("DewarpFlag") == 1


def _dewarped(numbers: Sequence[float], flat: bool, size: tuple[int, int]) -> Camera | str:
    fx, fy, cx, cy, k1, k2, p1, p2, k3, *rational = numbers
    if not (fx > 0 and fy > 0):
        return f"a focal length of {fx:.4g}, {fy:.4g} px"
    if any(rational):
        k1, k2, k3 = radial_of_rational((k1, k2, k3), rational, math.hypot(*size) / 2 / fx)
    if flat:
        k1 = k2 = k3 = p1 = p2 = 0.0
    centre = (cx + size[0] / 2, cy + size[1] / 2)
    return _camera(size, fx, centre, (k1, k2, k3, p1, p2), aspect=fy / fx)


def _perspective(
    exif: Exif, xmp: Xmp, sensor: Sensor | None, size: tuple[int, int]
) -> Camera | str | None:
    """Lengths in mm on the sensor, from its corner; distortion as OpenCV's k1, k2, k3, p1, p2."""
    mm = xmp.number("Camera:PerspectiveFocalLength")
    if not mm or xmp.text("Camera:ModelType").lower() == "fisheye":
        return None
    px_per_mm = _px_per_mm(exif, sensor, size)
    if xmp.text("Camera:PerspectiveFocalLengthUnits").lower().startswith("pix"):
        px_per_mm = 1.0
    if px_per_mm is None:
        return None
    centre = _principal_point(xmp, px_per_mm, size)
    distortion = xmp.numbers("Camera:PerspectiveDistortion")
    return _camera(size, mm * px_per_mm, centre, distortion if len(distortion) == 5 else None)


def _principal_point(
    xmp: Xmp, px_per_mm: float | None, size: tuple[int, int]
) -> tuple[float, float]:
    """In px from the image's corner; the middle where none is given, or nothing tells its unit."""
    point = xmp.numbers("Camera:PrincipalPoint")
    if px_per_mm is None or len(point) != 2:
        return size[0] / 2, size[1] / 2
    return point[0] * px_per_mm, point[1] * px_per_mm


def _fisheye(
    exif: Exif, xmp: Xmp, sensor: Sensor | None, size: tuple[int, int]
) -> Camera | str | None:
    """Pix4D's fisheye: the affine matrix times a polynomial of third degree in the angle from the
    axis over a right angle.
    """
    matrix, rho = (xmp.numbers(f"Camera:Fisheye{n}") for n in ("AffineMatrix", "Polynomial"))
    written = xmp.text("Camera:FisheyeAffineMatrix")
    if xmp.text("Camera:ModelType").lower() != "fisheye" or not written:
        return None
    if len(matrix) != 4 or not (matrix[0] > 0 and matrix[3] > 0 and all(map(math.isfinite, rho))):
        return f"an affine matrix of {plain(written, 60)}"
    centre = _principal_point(xmp, _px_per_mm(exif, sensor, size), size)
    first, *higher = angular_of_pix4d(rho or (0.0, 1.0), math.hypot(*size) / 2 / matrix[0])
    if not first > 0:
        return f"a polynomial of {', '.join(f'{n:.4g}' for n in rho)}"
    k1, k2, k3 = (n / first for n in higher)
    focal, aspect = matrix[0] * first, matrix[3] / matrix[0]
    found = _camera(size, focal, centre, (k1, k2, k3, 0.0, 0.0), aspect=aspect)
    return replace(found, fisheye=1.0) if isinstance(found, Camera) else found


def _px_per_mm(exif: Exif, sensor: Sensor | None, size: tuple[int, int]) -> float | None:
    resolution = exif.number(tag.PLANE_X)
    mm = _MM_PER_UNIT.get(int(exif.number(tag.PLANE_UNIT) or 2))
    if resolution and mm:
        return resolution / mm
    return max(size) / sensor.width_mm if sensor else None


def _calibrated_focal(xmp: Xmp, size: tuple[int, int]) -> Camera | str | None:
    """DJI's value in px, or Skydio's structure; the optical centre is counted from the image's
    corner.
    """
    focal = xmp.number("CalibratedFocalLength", "CalibratedFocalLength.X")
    x, y = (
        xmp.number(f"CalibratedOpticalCenter{axis}", f"CalibratedOpticalCenter.{axis}")
        for axis in "XY"
    )
    centre = (x, y) if x and y else (size[0] / 2, size[1] / 2)
    return _camera(size, focal, centre, None) if focal else None


def _camera(
    size: tuple[int, int],
    focal: float,
    centre: tuple[float, float],
    distortion: tuple[float, ...] | None,
    *,
    aspect: float = 1.0,
) -> Camera | str:
    """A camera from px counted from the corner, or why the numbers are not those of a lens."""
    long = max(size)
    if not _PLAUSIBLE[0] * long < focal < _PLAUSIBLE[1] * long:
        return f"a focal length of {focal:.4g} px in a picture of {size[0]} x {size[1]} px"
    if not all(0.25 * s < c < 0.75 * s for c, s in zip(centre, size, strict=True)):
        return (
            f"a principal point at {centre[0]:.4g}, {centre[1]:.4g} px in a picture of"
            f" {size[0]} x {size[1]} px"
        )
    if not 0.9 < aspect < 1.1:
        return f"focal lengths along columns and rows that differ by the factor {aspect:.4g}"
    if not all(abs(k) < 10 for k in distortion or ()):
        return "a distortion that no lens has"
    k1, k2, k3, p1, p2 = distortion or (0.0,) * 5
    shape = _SIGMA_ASPECT if aspect != 1 else _UNTOLD[-1]
    told = (*(_SIGMA_RADIAL,) * 3, *(_SIGMA_TANGENTIAL,) * 2, shape)
    sigmas = (
        _SIGMA_FOCAL * focal,
        *(_SIGMA_CENTRE * long,) * 2,
        *(_UNTOLD if distortion is None else told),
        0.0,  # the kind of lens is certain
    )
    values = (focal, centre[0] - 0.5, centre[1] - 0.5, k1, k2, k3, p1, p2, aspect)
    known = dict(zip(ADJUSTABLE, values, strict=True))
    return Camera(width=size[0], height=size[1], sigmas=sigmas, **known)
