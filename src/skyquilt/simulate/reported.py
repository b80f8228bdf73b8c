"""The metadata that photos report: the truth with noise and gross errors."""

from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Proj, Transformer

from skyquilt.simulate.camera import Lens, gimbal_angles, wrap
from skyquilt.simulate.flight import Shot
from skyquilt.simulate.grid import Doubles
from skyquilt.simulate.settings import Reporting


@dataclass(frozen=True, kw_only=True)
class Place:
    """Position of the local map frame on Earth."""

    crs: str
    """UTM zone, e.g. `EPSG:32633`."""
    easting: float
    """Easting of the map origin, m."""
    northing: float
    """Northing of the map origin, m."""
    convergence: float
    """Degrees from true north to the map's north at the origin, clockwise positive."""

    def geographic(self, x: float, y: float) -> tuple[float, float]:
        """Latitude and longitude of a map point (local), degrees."""
        to = Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True)
        longitude, latitude = to.transform(self.easting + x, self.northing + y)
        return float(latitude), float(longitude)


def place_at(latitude: float, longitude: float) -> Place:
    """The map frame whose origin is the position rounded to whole metres, in its UTM zone."""
    zone = int((longitude + 180) % 360 // 6) + 1
    crs = f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"
    to = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    easting, northing = to.transform(longitude, latitude)
    factors = Proj(CRS(crs)).get_factors(longitude, latitude)
    return Place(
        crs=crs,
        easting=round(easting),
        northing=round(northing),
        convergence=float(factors.meridian_convergence),
    )


@dataclass(frozen=True, kw_only=True)
class Report:
    """The metadata of one photo, as written."""

    latitude: float | None
    """Degrees."""
    longitude: float | None
    """Degrees."""
    sea_level: float | None
    """Height above the sea, m."""
    takeoff: float | None
    """Height above take-off, m."""
    gimbal: tuple[float, float, float] | None
    """Yaw from true north, pitch, roll, degrees; pitch -90 looks straight down."""
    flight_yaw: float | None
    """Degrees from true north."""
    clock: float
    """Seconds since the survey's nominal start, according to the drone's clock."""
    focal: float | None
    """px."""
    velocity: tuple[float, float, float] | None = None
    """Of the aircraft, north, east, down, m/s."""
    dewarp: tuple[float, ...] | None = None
    """fx, fy, cx, cy (from the middle), k1, k2, p1, p2, k3 of a factory calibration."""
    rtk: tuple[float, float] | None = None
    """Deviations of an RTK position, horizontal and vertical, m."""
    turned: bool
    """The file's pixels were rotated by 180 degrees after the flight."""
    lies: tuple[str, ...]
    """Fields with gross errors: `yaw`, `altitude`, `position`, `focal`."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """Zero heights of the reports."""

    base: float
    """Base level above the sea, m."""
    takeoff: float
    """Take-off point above the base, m."""


def report_all(
    shots: list[Shot], settings: Reporting, place: Place, start: Start, lens: Lens, seed: int
) -> list[Report]:
    """The metadata of a flight's photos, in order."""
    rng = np.random.default_rng([seed, 31, len(shots)])
    errors = _position_errors(shots, settings, rng)
    silent = set(rng.permutation(len(shots))[: settings.gps_missing].tolist())
    liars = _liars(shots) if settings.yaw_lie != "none" else set()
    last = max((shot.waypoint.time for shot in shots), default=0.0) or 1.0
    return [
        _report(
            shot,
            settings,
            place,
            start,
            lens=lens,
            error=errors[i],
            drift=settings.altitude_drift * shot.waypoint.time / last,
            lying=i in liars,
            silent=i in silent,
            rng=rng,
        )
        for i, shot in enumerate(shots)
    ]


def _position_errors(shots: list[Shot], settings: Reporting, rng: np.random.Generator) -> Doubles:
    """(n, 3) errors in m; correlated over `gps_correlation` seconds per drone (Gauss-Markov)."""
    vertical = 1.5 * settings.gps_noise if settings.gps_noise_z is None else settings.gps_noise_z
    white = rng.normal(0, 1, (len(shots), 3)) * np.array(
        [settings.gps_noise, settings.gps_noise, vertical]
    )
    if settings.gps_correlation <= 0:
        return np.asarray(white)
    last: dict[int, int] = {}
    for i, shot in enumerate(shots):
        before = last.get(shot.waypoint.drone)
        last[shot.waypoint.drone] = i
        if before is not None:
            gap = shot.waypoint.time - shots[before].waypoint.time
            keep = float(np.exp(-gap / settings.gps_correlation))
            white[i] = keep * white[before] + np.sqrt(1 - keep**2) * white[i]
    return np.asarray(white)


def _liars(shots: list[Shot]) -> set[int]:
    """The photos with gross errors: those of the middle line, or the middle third of a single
    line.
    """
    lines = sorted({shot.waypoint.line for shot in shots})
    if len(lines) == 1:
        return set(range(len(shots) // 3, 2 * len(shots) // 3))
    return {i for i, shot in enumerate(shots) if shot.waypoint.line == lines[len(lines) // 2]}


def _ned(shot: Shot, convergence: float) -> tuple[float, float, float]:
    """The velocity as drones report it: from true north, in tenths of m/s."""
    east, north, up = shot.velocity
    s, c = np.sin(np.radians(convergence)), np.cos(np.radians(convergence))
    return (
        round(float(c * north - s * east), 1),
        round(float(s * north + c * east), 1),
        round(-up, 1),
    )


def _dewarp(lens: Lens, settings: Reporting) -> tuple[float, ...] | None:
    """The factory calibration that files carry."""
    if settings.dewarp is None:
        return None
    focal = lens.focal * (1 + settings.focal_error)
    aspect = lens.aspect if settings.dewarp_aspect else 1.0
    lengths = (focal, focal * aspect, lens.offset_x, lens.offset_y)
    return (*lengths, lens.k1, lens.k2, *settings.dewarp, lens.k3)


def _report(
    shot: Shot,
    settings: Reporting,
    place: Place,
    start: Start,
    *,
    lens: Lens,
    error: Doubles,
    drift: float,
    lying: bool,
    silent: bool,
    rng: np.random.Generator,
) -> Report:
    x, y, z = shot.centre
    latitude, longitude = place.geographic(x + error[0], y + error[1])
    angles = np.array([shot.yaw, shot.pitch, shot.roll]) + rng.normal(0, settings.angle_noise, 3)
    nose = rng.normal(0, settings.angle_noise)
    barometer = rng.normal(0, settings.barometer_noise)
    lie = 180.0 if lying and settings.yaw_lie == "tag" else 0.0
    north = place.convergence
    compass = north + lie + settings.compass_error
    gimbal = gimbal_angles(angles[0] + compass, angles[1] + settings.gimbal_error, angles[2])
    offsets = settings.clock_offsets or (0.0,)
    altitude_lie = abs(settings.altitude_drift) > 3
    turned = lying or abs(settings.compass_error) > 15
    lies = ["yaw"] * turned + ["altitude"] * altitude_lie
    with_angles = not settings.attitude_missing
    return Report(
        latitude=None if silent else round(latitude, 9),
        longitude=None if silent else round(longitude, 9),
        sea_level=None if silent else round(start.base + z + error[2] + drift, 3),
        takeoff=round(z - start.takeoff + barometer + drift, 3) if with_angles else None,
        gimbal=(round(gimbal[0], 2), round(gimbal[1], 2), round(gimbal[2], 2))
        if with_angles
        else None,
        flight_yaw=round(wrap(shot.waypoint.heading + compass + nose), 2) if with_angles else None,
        clock=round(shot.waypoint.time + offsets[shot.waypoint.drone % len(offsets)], 3),
        focal=None if settings.focal_missing else lens.focal * (1 + settings.focal_error),
        velocity=_ned(shot, north) if with_angles else None,
        dewarp=_dewarp(lens, settings),
        rtk=(settings.gps_noise, settings.gps_noise_z or 1.5 * settings.gps_noise)
        if settings.rtk
        else None,
        turned=lying and settings.yaw_lie == "turned",
        lies=tuple(lies),
    )
