"""Chooses the map frame and converts the metadata of photos to priors in it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Geod, Proj, Transformer
from pyproj.exceptions import CRSError

from skyquilt.alignment.heights import chosen_datum, control_datum, height_above
from skyquilt.errors import UsageError
from skyquilt.geometry.frames import angle_difference_deg
from skyquilt.model.photo import ControlPoint, Datum, Photo
from skyquilt.model.poses import MapFrame, Prior
from skyquilt.outside import plain

SIGMA_HEIGHT_M = 3.0
"""Deviation in m of the height above take-off of a photo without a position."""
STRETCH_STEP_M = 50.0
"""Way in m over which a coordinate system's scale is measured."""
STRETCH_TOLD, STRETCH_REFUSED = 0.005, 0.1
"""Departure of the scale from one that is told, and of the scale along one direction from that
across it that is refused: a map cannot hold what photos show then.
"""
STRETCH_MOST = 4.0
"""Scale that is refused, too, as its inverse is: that of Web Mercator at 75 degrees."""
TURNED_TOLD_DEG = 10.0
"""Angle between north and up that is told of an export."""
NORTH_OFF_DEG = 3.0
"""Departure of north from where a coordinate system should have it that is refused: systems with
axes west and south are 180 degrees off.
"""


def utm_epsg(latitude_deg: float, longitude_deg: float) -> str:
    """The UTM zone of a place as `EPSG:326zz` or `EPSG:327zz`."""
    zone = int((longitude_deg + 180) // 6) % 60 + 1
    return f"EPSG:{32600 + zone if latitude_deg >= 0 else 32700 + zone}"


def choose_frame(
    photos: Sequence[Photo],
    crs: str | None,
    control: Sequence[ControlPoint] = (),
    vertical_datum: str | None = None,
    level: bool = False,
) -> MapFrame:
    """The frame of a survey: `crs` if given, otherwise the UTM zone of the median position; heights
    above `vertical_datum` if given, otherwise above what most photos state, or above take-off for
    a method of `level` ground.

    Without photo positions, the UTM zone of the control points; without these, the survey is not
    georeferenced.

    Raises:
        UsageError: `crs` is unknown, not projected in metres, or does not suit the place; or
            heights cannot be converted to `vertical_datum`.
    """
    places = [(p.position.latitude_deg, p.position.longitude_deg) for p in photos if p.position]
    if not places and control:
        to_wgs = Transformer.from_crs(control[0].crs, 4326, always_xy=True)
        lon, lat = to_wgs.transform([c.x for c in control], [c.y for c in control])
        places = list(zip(lat, lon, strict=True))
    name = checked_crs(crs) if crs else ""
    if not places:
        metric = any(p.height_m is not None for p in photos)
        if vertical_datum is not None:
            raise UsageError(
                f"--vertical-datum {vertical_datum} needs positions, and the photos have none; give"
                " them with --geo"
            )
        datum: Datum = "takeoff" if metric else "unknown"
        return MapFrame(crs=None, origin=(0.0, 0.0), vertical_datum=datum, metric=metric)
    latitude, longitude = _middle(np.array(places))
    name = name or utm_epsg(latitude, longitude)
    x, y = Transformer.from_crs(4326, name, always_xy=True).transform(longitude, latitude)
    origin = (float(np.round(x, -2)), float(np.round(y, -2)))
    convergence = Proj(name).get_factors(longitude, latitude).meridian_convergence
    if crs:
        _check_suits(name, latitude, longitude, convergence)
    datum, takeoff = chosen_datum(photos, control, vertical_datum, level)
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
    parsed = horizontal_crs(crs)
    if not parsed.is_projected or any(
        axis.unit_name not in ("metre", "meter") for axis in parsed.axis_info[:2]
    ):
        raise UsageError(
            f"--crs {crs!r} ({parsed.name}) is not projected in metres; a mosaic needs one that is"
        )
    return crs


def horizontal_crs(crs: str) -> CRS:
    """The coordinate system that `--crs` names.

    Raises:
        UsageError: it is unknown, is none of maps, or says what heights count from as well.
    """
    try:
        parsed = CRS.from_user_input(crs)
    except CRSError as error:
        raise UsageError(
            f"--crs '{plain(crs, 80)}' is not a coordinate system known to PROJ; try e.g."
            " EPSG:32633"
        ) from error
    shown = f"--crs '{plain(crs, 80)}' ({plain(parsed.name, 80)})"
    if not (parsed.is_projected or parsed.is_geographic):
        raise UsageError(
            f"{shown} is not projected or geographic, as that of a map is; try e.g. EPSG:32633"
        )
    if parsed.is_compound or len(parsed.axis_info) > 2:
        flat = parsed.sub_crs_list[0] if parsed.is_compound else parsed.to_2d()
        code = flat.to_authority()
        raise UsageError(
            f"{shown} says what heights count from as well, which --crs does not change; give its"
            f" horizontal part{', ' + ':'.join(code) if code else ''}"
        )
    return parsed


def stretch(crs: str, latitude: float, longitude: float) -> NDArray[np.float64]:
    """(2, 2) map coordinates of a way of one metre to the east (first column) and to the north."""
    to_map, geod = Transformer.from_crs(4326, crs, always_xy=True), CRS(crs).get_geod()
    here = np.array(to_map.transform(longitude, latitude))
    ends = [
        (geod or Geod(ellps="WGS84")).fwd(longitude, latitude, a, STRETCH_STEP_M) for a in (90, 0)
    ]
    return np.array([to_map.transform(lon, lat) - here for lon, lat, _ in ends]).T / STRETCH_STEP_M


def stretch_warnings(frame: MapFrame) -> list[str]:
    """A sentence where lengths in the map's coordinate system are not those on the ground."""
    if frame.crs is None:
        return []
    to_wgs = Transformer.from_crs(frame.crs, 4326, always_xy=True)
    longitude, latitude = to_wgs.transform(*frame.origin)
    most = _farthest_from_one(stretch(frame.crs, latitude, longitude))
    if abs(most - 1) <= STRETCH_TOLD:
        return []
    return [
        f"A metre on the ground is {most:.3f} m in {plain(frame.crs, 80)} here, so lengths, areas"
        " and heights of the map are off by as much; a map in the local UTM zone (without --crs)"
        " has true ones, and can be exported (skyquilt export --crs)."
    ]


def distortion(crs: str, latitude: float, longitude: float) -> str:
    """What a projection does to a place (degrees, WGS 84) that lies far from where it is meant for:
    lengths that are not those on the ground, north that is not up. Empty where neither is so, and
    for geographic systems.
    """
    if not CRS(crs).is_projected:
        return ""
    jacobian, name = stretch(crs, latitude, longitude), plain(crs, 80)
    metres = CRS(crs).axis_info[0].unit_conversion_factor
    most = _farthest_from_one(jacobian) * metres
    turned = np.degrees(np.arctan2(*jacobian[:, 1]))
    told = []
    if abs(most - 1) > STRETCH_TOLD:
        told.append(f"a metre on the ground is {most:.3f} m")
    if abs(turned) > TURNED_TOLD_DEG:
        told.append(f"north is {abs(turned):.0f} degrees from up")
    return f"in {name}, {' and '.join(told)} here" if told else ""


def _farthest_from_one(jacobian: NDArray[np.float64]) -> float:
    found = np.linalg.svd(jacobian, compute_uv=False)
    return float(found[np.argmax(np.abs(np.log(found)))])


def _check_suits(crs: str, latitude: float, longitude: float, convergence: float) -> None:
    """Refuses a coordinate system in which no map of this place can be made.

    Raises:
        UsageError: there, it stretches or turns what is measured, or has no coordinates.
    """
    advice = (
        "leave it out, and convert the finished map (skyquilt export --crs), or choose the system"
        " of the place"
    )
    where = f"--crs {plain(crs, 80)!r} ({plain(CRS(crs).name, 80)})"
    jacobian = stretch(crs, latitude, longitude)
    if not np.isfinite(jacobian).all():
        raise UsageError(
            f"{where} has no coordinates for {latitude:.2f}, {longitude:.2f}; {advice}"
        )
    least, most = sorted(np.linalg.svd(jacobian, compute_uv=False).tolist())
    if most > (1 + STRETCH_REFUSED) * least or not 1 / STRETCH_MOST < most < STRETCH_MOST:
        raise UsageError(
            f"{where} stretches a metre at {latitude:.2f}, {longitude:.2f} to {least:.2f} m one"
            f" way and to {most:.2f} m the other; {advice}"
        )
    north = np.degrees(np.arctan2(*jacobian[:, 1]))
    if (
        np.linalg.det(jacobian) < 0
        or abs(angle_difference_deg(north, -convergence)) > NORTH_OFF_DEG
    ):
        raise UsageError(f"{where} has axes that do not point east and north; {advice}")


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
    elif photo.height_m is not None:
        zero = 0.0 if frame.vertical_datum == "takeoff" else frame.takeoff_m
        C[2] = np.nan if zero is None else photo.height_m + zero
        sigma[2] = SIGMA_HEIGHT_M if zero is not None else np.inf
    attitude = photo.attitude
    yaw, source = photo.flight_yaw_deg, photo.flight_yaw_source
    if attitude is not None:
        yaw, source = attitude.yaw_deg, attitude.source
    return Prior(
        map_C=C,
        sigma_C=sigma,
        yaw_deg=np.nan if yaw is None else angle_difference_deg(yaw, frame.convergence_deg),
        pitch_deg=attitude.pitch_deg if attitude else 0.0,
        roll_deg=attitude.roll_deg if attitude else 0.0,
        sigma_yaw_deg=attitude.sigma_yaw_deg if attitude else 15.0,
        sigma_tilt_deg=attitude.sigma_tilt_deg if attitude else 6.0,
        yaw_source="" if yaw is None else source,
    )


def priors(photos: Sequence[Photo], frame: MapFrame) -> list[Prior]:
    """Priors of all photos."""
    to_map = Transformer.from_crs(4326, frame.crs, always_xy=True) if frame.crs else None
    return [photo_prior(photo, frame, to_map) for photo in photos]
