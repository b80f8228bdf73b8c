"""Chooses the map frame and converts the metadata of photos to priors in it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Proj, Transformer
from pyproj.exceptions import CRSError

from skyquilt.alignment.heights import chosen_datum, control_datum, height_above
from skyquilt.errors import UsageError
from skyquilt.geometry.frames import angle_difference_deg
from skyquilt.model.photo import ControlPoint, Photo
from skyquilt.model.poses import MapFrame, Prior
from skyquilt.outside import plain


def utm_epsg(latitude_deg: float, longitude_deg: float) -> str:
    """The UTM zone of a place as `EPSG:326zz` or `EPSG:327zz`."""
    zone = int((longitude_deg + 180) // 6) % 60 + 1
    return f"EPSG:{32600 + zone if latitude_deg >= 0 else 32700 + zone}"


def choose_frame(
    photos: Sequence[Photo],
    crs: str | None,
    control: Sequence[ControlPoint] = (),
    vertical_datum: str | None = None,
) -> MapFrame:
    """The frame of a survey: `crs` if given, otherwise the UTM zone of the median position; heights
    above `vertical_datum` if given, otherwise above what most photos state.

    Without photo positions, the UTM zone of the control points; without these, the survey is not
    georeferenced.

    Raises:
        UsageError: `crs` is unknown, or not projected in metres; or heights cannot be converted to
            `vertical_datum`.
    """
    places = [(p.position.latitude_deg, p.position.longitude_deg) for p in photos if p.position]
    if not places and control:
        to_wgs = Transformer.from_crs(control[0].crs, 4326, always_xy=True)
        lon, lat = to_wgs.transform([c.x for c in control], [c.y for c in control])
        places = list(zip(lat, lon, strict=True))
    name = checked_crs(crs) if crs else ""
    if not places:
        metric = any(p.position and p.position.takeoff_m for p in photos)
        if vertical_datum is not None:
            raise UsageError(
                f"--vertical-datum {vertical_datum} needs positions, and the photos have none; give"
                " them with --geo"
            )
        return MapFrame(crs=None, origin=(0.0, 0.0), vertical_datum="unknown", metric=metric)
    latitude, longitude = _middle(np.array(places))
    name = name or utm_epsg(latitude, longitude)
    x, y = Transformer.from_crs(4326, name, always_xy=True).transform(longitude, latitude)
    origin = (float(np.round(x, -2)), float(np.round(y, -2)))
    convergence = Proj(name).get_factors(longitude, latitude).meridian_convergence
    datum, takeoff = chosen_datum(photos, control, vertical_datum)
    return MapFrame(
        crs=name,
        origin=origin,
        vertical_datum=datum,
        takeoff_m=takeoff,
        control_datum=control_datum(control, vertical_datum, datum),
        convergence_deg=float(convergence),
    )


def _middle(places: NDArray[np.float64]) -> tuple[float, float]:
    """Median latitude and longitude of places (n, 2); the meridian of 180 degrees may lie between
    them.
    """
    latitude, longitude = places.T
    if np.ptp(longitude) <= 180:
        return float(np.median(latitude)), float(np.median(longitude))
    east = float(np.median(longitude % 360))
    return float(np.median(latitude)), east if east < 180 else east - 360


def checked_crs(crs: str) -> str:
    """The coordinate system, where a map can be made in it.

    Raises:
        UsageError: it is unknown, or suits no map.
    """
    try:
        parsed = CRS.from_user_input(crs)
    except CRSError as error:
        raise UsageError(
            f"--crs '{plain(crs, 80)}' is not a coordinate system known to PROJ; try e.g."
            " EPSG:32633"
        ) from error
    if not parsed.is_projected or any(
        axis.unit_name not in ("metre", "meter") for axis in parsed.axis_info[:2]
    ):
        raise UsageError(
            f"--crs {crs!r} ({parsed.name}) is not projected in metres; a mosaic needs one that is"
        )
    return crs


def empty_prior() -> Prior:
    """The prior of a photo without position and attitude."""
    return Prior(
        map_C=np.full(3, np.nan),
        sigma_C=np.full(3, np.inf),
        yaw_deg=np.nan,
        pitch_deg=0.0,
        roll_deg=0.0,
        sigma_yaw_deg=15.0,
        sigma_tilt_deg=6.0,
    )


def photo_prior(photo: Photo, frame: MapFrame, to_map: Transformer | None) -> Prior:
    """The pose prior of one photo in the map frame."""
    C, sigma = np.full(3, np.nan), np.array([np.inf, np.inf, np.inf])
    if photo.position and to_map is not None:
        x, y = to_map.transform(photo.position.longitude_deg, photo.position.latitude_deg)
        C[:2] = x - frame.origin[0], y - frame.origin[1]
        sigma[:2] = photo.position.sigma_xy_m
    if photo.position:
        C[2] = height_above(photo.position, frame.vertical_datum, frame.takeoff_m)
        sigma[2] = photo.position.sigma_z_m
    attitude = photo.attitude
    yaw = attitude.yaw_deg if attitude else photo.flight_yaw_deg
    return Prior(
        map_C=C,
        sigma_C=sigma,
        yaw_deg=np.nan if yaw is None else angle_difference_deg(yaw, frame.convergence_deg),
        pitch_deg=attitude.pitch_deg if attitude else 0.0,
        roll_deg=attitude.roll_deg if attitude else 0.0,
        sigma_yaw_deg=attitude.sigma_yaw_deg if attitude else 15.0,
        sigma_tilt_deg=attitude.sigma_tilt_deg if attitude else 6.0,
        yaw_source=attitude.source if attitude else ("xmp-flight" if yaw is not None else ""),
    )


def priors(photos: Sequence[Photo], frame: MapFrame) -> list[Prior]:
    """Priors of all photos."""
    to_map = Transformer.from_crs(4326, frame.crs, always_xy=True) if frame.crs else None
    return [photo_prior(photo, frame, to_map) for photo in photos]
