"""Cameras in the formats of other software.

OpenSfM and OpenDroneMap give lengths in units of the longer side, from the image centre. Both put
the origin at ((w - 1) / 2, (h - 1) / 2) with pixel centres at integers. Their distortion runs from
undistorted to distorted as OpenCV's does, so coefficients keep their signs.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from skyquilt.geometry.camera import FURTHEST
from skyquilt.model.camera import Camera
from skyquilt.outside import plain, real

DEVIATIONS = "standard_deviations"
"""Key of the standard deviations, in the units of the values; readers of OpenSfM's format ignore
keys they do not know.
"""
_LEAST_FOCAL = 0.02
_MOST = {"width": 1e6, "height": 1e6, "focal": 100.0, "focal_x": 100.0, "focal_y": 100.0}
"""Largest plausible values; lengths in units of the longer side."""
PINHOLES = ("brown", "perspective", "simple_radial", "radial")
FISHEYES = ("fisheye", "fisheye_opencv", "fisheye62")
"""Projections by their names there: of `fisheye62`, the tangential terms take coordinates before
radial distortion here, and after it there, which is the same to first order.
"""
_NAMES = ("focal_x", "c_x", "c_y", "k1", "k2", "k3", "p1", "p2", "aspect")


def camera_from_opensfm(record: Mapping[str, Any]) -> Camera:
    """A camera of one of `PINHOLES` or `FISHEYES`.

    Raises `ValueError` for any other projection and for a broken record. Standard deviations
    are read from the key that `camera_to_opensfm` writes.
    """
    kind = str(record.get("projection_type", "perspective"))
    if kind not in (*PINHOLES, *FISHEYES):
        raise ValueError(
            f"its projection is '{kind}'; expected {', '.join((*PINHOLES, *FISHEYES[:-1]))}"
            f" or {FISHEYES[-1]}"
        )
    higher = [_number(record, k, 0.0) for k in ("k4", "k5", "k6")]
    if any(higher):
        raise ValueError("it has more than three radial coefficients (k4 and more are not 0)")
    width, height = int(_number(record, "width")), int(_number(record, "height"))
    if width < 1 or height < 1:
        raise ValueError(f"its size is {width}x{height} px")
    unit = max(width, height)
    focals = [_number(record, k) for k in ("focal_x", "focal_y", "focal") if k in record]
    if not focals or min(focals) < _LEAST_FOCAL:
        raise ValueError("it has no positive focal length (focal, or focal_x and focal_y)")
    return Camera(
        width=width,
        height=height,
        focal=focals[0] * unit,
        cx=_number(record, "c_x", 0.0) * unit + (width - 1) / 2,
        cy=_number(record, "c_y", 0.0) * unit + (height - 1) / 2,
        k1=_number(record, "k1", 0.0),
        k2=_number(record, "k2", 0.0),
        k3=_number(record, "k3", 0.0),
        p1=_number(record, "p1", 0.0),
        p2=_number(record, "p2", 0.0),
        aspect=_number(record, "focal_y", focals[0]) / focals[0] if "focal_x" in record else 1.0,
        fisheye=1.0 if kind in FISHEYES else 0.0,
        sigmas=_deviations(record, unit),
    )


def _deviations(record: Mapping[str, Any], unit: int) -> tuple[float, ...] | None:
    """Standard deviation of each parameter in px; None where the record has none. Raises
    `ValueError` for invalid ones.
    """
    stated = record.get(DEVIATIONS)
    if stated is None:
        return None
    if not isinstance(stated, Mapping):
        raise ValueError(f"its '{DEVIATIONS}' are {stated!r}; expected numbers by name")
    found = tuple(
        _number(stated, name, 0.0 if name == "aspect" else None) * (unit if k < 3 else 1)
        for k, name in enumerate(_NAMES)
    )
    if min(found) < 0 or not all(map(math.isfinite, found)):
        raise ValueError(f"its '{DEVIATIONS}' are {dict(stated)}; expected none below zero")
    return (*found, 0.0)  # the kind of lens is certain


def camera_to_opensfm(camera: Camera) -> dict[str, Any]:
    """The camera as a `brown` record, or a `fisheye62` record with the coefficients that a fisheye
    has of these, ready for JSON; its standard deviations, if it has any, under a key that other
    software ignores.
    """
    unit = max(camera.width, camera.height)
    stated = {}
    if camera.sigmas:
        shares = [s / unit if k < 3 else s for k, s in enumerate(camera.sigmas)]
        stated = {DEVIATIONS: dict(zip(_NAMES, shares, strict=False))}
    fisheye = {"k4": 0.0, "k5": 0.0, "k6": 0.0} if camera.fisheye else {}
    return {
        "projection_type": "fisheye62" if camera.fisheye else "brown",
        "width": camera.width,
        "height": camera.height,
        "focal_x": camera.focal / unit,
        "focal_y": camera.focal * camera.aspect / unit,
        "c_x": (camera.cx - (camera.width - 1) / 2) / unit,
        "c_y": (camera.cy - (camera.height - 1) / 2) / unit,
        **{k: getattr(camera, k) for k in ("k1", "k2", "p1", "p2", "k3")},
        **fisheye,
        **stated,
    }


def _number(record: Mapping[str, Any], key: str, otherwise: float | None = None) -> float:
    value = record.get(key, otherwise)
    most = _MOST.get(key, 1e3)
    number = None if isinstance(value, str) else real(value, -most, most)
    if number is None:
        raise ValueError(
            f"its '{key}' is {plain(repr(value), 60)}; expected a number of at most {most:g}"
        )
    return number


def radial_of_rational(
    k: tuple[float, float, float], rational: Sequence[float], radius: float
) -> tuple[float, float, float]:
    """k1, k2, k3 that come closest to OpenCV's rational model (1 + k1 r^2 + k2 r^4 + k3 r^6) /
    (1 + k4 r^2 + k5 r^4 + k6 r^6) over a picture; `radius` of its corners in units of the focal
    length. NaN where the model has a pole in the picture.
    """
    r = np.linspace(0, radius, 200)[1:]
    powers = np.stack([r**2, r**4, r**6], axis=1)
    wanted = (1 + powers @ np.array(k)) / (1 + powers @ np.array(rational)) - 1
    if not np.isfinite(wanted).all():
        return math.nan, math.nan, math.nan
    found = np.linalg.lstsq(powers * r[:, None], wanted * r, rcond=None)[0]
    return float(found[0]), float(found[1]), float(found[2])


def angular_of_pix4d(rho: Sequence[float], radius: float) -> list[float]:
    """Coefficients of the angle from the axis in rad, of its 3rd, 5th and 7th power, that come
    closest to Pix4D's fisheye: the polynomial `rho`, lowest degree first, of the angle over a right
    angle; `radius` of a picture's corners in units of the affine matrix.
    """
    angle = np.linspace(0, min(radius * math.pi / 2, FURTHEST), 200)[1:]
    wanted = np.polyval(list(reversed(rho)), angle * 2 / math.pi)
    powers = np.stack([angle, angle**3, angle**5, angle**7], axis=1)
    return [float(n) for n in np.linalg.lstsq(powers, wanted, rcond=None)[0]]
