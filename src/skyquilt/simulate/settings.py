"""Settings of a simulated flight, as nested records."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal

import numpy as np

from skyquilt.errors import UsageError
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.scene import SceneSettings
from skyquilt.simulate.terrain import height
from skyquilt.simulate.weather import Weather

YawLie = Literal["none", "turned", "tag"]
Pattern = Literal["block", "strip", "roundtrip"]


@dataclass(frozen=True, kw_only=True)
class Route:
    """The flight route."""

    pattern: Pattern = "block"
    """Parallel lines, one line, or a rectangle flown once around."""
    photos: int = 40
    """Photos planned, before losses."""
    site: tuple[float, float] | None = None
    """Extent along and across the lines in m that the camera centres cover; replaces `photos` for a
    block.
    """
    overlap: float = 0.75
    """Forward overlap, share of the footprint."""
    sidelap: float = 0.60
    """Side overlap between lines."""
    height: float = 60.0
    """Height above the take-off point, m."""
    heading: float = 20.0
    """Direction of the first line, degrees from the map's north."""
    speed: float = 6.0
    """Ground speed, m/s."""
    stops: bool = False
    """The drone stops for each photo."""
    fixed_yaw: bool = False
    """The image top points along the heading on all lines; otherwise the drone turns with them."""
    turns: float = 0.0
    """Standard deviation of the rates at which the camera turns about its axes, degrees/s."""
    jitter: float = 0.5
    """Standard deviation of the true position around the plan, each axis, m."""
    yaw_noise: float = 2.0
    """Standard deviation of the true yaw around the heading, degrees."""
    tilt_noise: float = 1.0
    """Standard deviation of the true pitch and of the true roll, degrees."""
    drones: int = 1
    """Drones that fly at the same time, each on its share of the lines."""
    lost: int = 0
    """Photos planned but not delivered, never two neighbours."""
    wind: float = 0.0
    """Speed of the wind, m/s: it pushes photos off their places, by a tenth of a second's way on
    average, in gusts by as much more or less. The drones of a plan lean into it, too, and it
    changes their ground speed.
    """
    wind_from: float = 0.0
    """Where it comes from, degrees from the map's north."""
    oblique: int = 0
    """Photos taken besides the planned ones, looking ahead, some with the sky."""
    oblique_tilts: tuple[float, float] = (57.0, 80.0)
    """Least and largest tilt of these from the vertical, degrees; they are spread evenly."""

    def pushed(self, rng: np.random.Generator) -> tuple[float, float]:
        """How far east and north the wind pushes the next photo, m."""
        if self.wind <= 0:
            return 0.0, 0.0
        off = 0.1 * self.wind * (1 + float(rng.normal()))
        to = math.radians(self.wind_from + 180)
        return off * math.sin(to), off * math.cos(to)


MOST_M = 10_000.0
"""Largest error in m of a reported place."""


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """How the pixels are formed."""

    exposure_noise: float = 0.05
    """Standard deviation of the logarithm of each photo's exposure."""
    vignetting: float = 0.15
    """Loss of light in the corners, share."""
    sun_hours: float = 0.0
    """Hours by which the sun moves on over the flight; 0 = it stands still."""
    blur: float = 0.45
    """Standard deviation of the lens's blur, px."""
    motion_blur: float = 0.0
    """Length of the blur along the flight, px."""
    fires: int = 0
    """Fires on the site, whose smoke drifts over it."""
    clouds: float = 0.0
    """Share of the ground in shadows of clouds that drift with the wind."""
    blurred: int = 0
    """Photos spoilt one by one, by a shake of the camera."""
    blurred_px: float = 16.0
    """Length of their blur, px."""
    noise: float = 1.5
    """Standard deviation of the sensor noise, levels of 255."""
    quality: int = 92
    """JPEG quality."""


@dataclass(frozen=True, kw_only=True)
class Reporting:
    """How the metadata differ from the truth."""

    gps_noise: float = 2.0
    """Standard deviation of the position, each horizontal axis, m."""
    gps_noise_z: float | None = None
    """Standard deviation of the height above sea level, m; 1.5 times the horizontal one where None.
    """
    gps_correlation: float = 0.0
    """Correlation time in s of position errors; 0 means independent errors."""
    barometer_noise: float = 0.3
    """Standard deviation of the height above take-off, m."""
    altitude_drift: float = 0.0
    """Error of all reported heights that grows linearly to this value over the flight, m."""
    angle_noise: float = 0.5
    """Standard deviation of each reported angle, degrees."""
    compass_error: float = 0.0
    """Error that all reported headings have in common, degrees clockwise."""
    gimbal_error: float = 0.0
    """Error that all reported pitch angles have in common, degrees upwards."""
    yaw_lie: YawLie = "none"
    """Error of one whole line: files rotated by 180 degrees in a viewer, or only the yaw tag wrong
    by 180 degrees.
    """
    focal_error: float = 0.01
    """Relative error of the focal length in the EXIF."""
    dewarp: tuple[float, float] | None = None
    """A factory calibration (DJI's `DewarpData`) in every file: the true lens but for its focal
    length, which errs by `focal_error`, and these values of p1 and p2.
    """
    dewarp_aspect: bool = True
    """Whether that calibration gives the true ratio of focal lengths (otherwise 1)."""
    rtk: bool = False
    """Files say that positions come from RTK, with `gps_noise` as their deviation; heights are
    then those of the camera without drift.
    """
    focal_missing: bool = False
    """No focal length at all."""
    attitude_missing: bool = False
    """No gimbal or flight angles (no XMP at all)."""
    gps_missing: int = 0
    """Number of photos without position."""
    clock_offsets: tuple[float, ...] = (0.0, 40.0, -25.0)
    """Clock error of each drone, s, repeated as needed."""


@dataclass(frozen=True, kw_only=True)
class Control:
    """Surveyed targets."""

    points: int = 5
    """Number of control points."""
    checks: int = 4
    """Number of check points."""
    accuracy: float = 0.02
    """Standard deviation of each surveyed coordinate, m."""
    pixel_noise: float = 0.3
    """Standard deviation of each observation, px."""


@dataclass(frozen=True, kw_only=True)
class Thermal:
    """A second drone with a thermal camera over the same site."""

    lens: Lens = field(
        default_factory=lambda: Lens(
            width=640,
            height=512,
            focal=772.0,
            offset_x=3.0,
            offset_y=2.0,
            k1=-0.22,
            k2=0.08,
            p1=0.001,
            p2=0.0005,
        )
    )
    """Its camera."""
    overlap: float = 0.80
    """Forward overlap."""
    sidelap: float = 0.65
    """Sideways overlap."""
    height: float = 75.0
    """Height above take-off, m."""
    weather: Weather = field(default_factory=lambda: Weather(hour=13.0))
    """Its own time of day and season."""
    drift: float = 0.2
    """Standard deviation of the offset between frames, K."""
    noise: float = 0.05
    """Standard deviation per pixel, K."""


@dataclass(frozen=True, kw_only=True)
class Multispectral:
    """A camera of five bands on the same drone."""

    width: int = 960
    """Width of its files, px."""
    height: int = 720
    """Height of its files, px."""
    narrower: float = 1.12
    """Its view is narrower than that of the photos by this factor."""
    turned_deg: float = 0.4
    """Standard deviation of the angle, about each axis, by which its cameras are turned."""
    apart_m: float = 0.03
    """Distance between its cameras, m."""
    light_changes: float = 0.15
    """Largest relative change of the light during the flight."""
    sun_sensor_noise: float = 0.02
    """Relative standard deviation of what its sun sensor measures."""

    def designed(self, flown: Lens) -> float:
        """The focal length in px that files tell, beside a camera of the photos with this lens."""
        return self.narrower * flown.focal * self.width / flown.width


SrtLayout = Literal["mavic3", "gimbal", "air2s", "mavic2", "p4rtk", "mavic-pro", "matrice300"]
InClipLayout = Literal["mini2", "mini4", "gopro"]


@dataclass(frozen=True, kw_only=True)
class Video:
    """A clip of the whole flight, turns included."""

    fps: float = 5.0
    """Frames per second."""
    seconds: float | None = None
    """The clip ends after so many seconds; None = at the last waypoint."""
    layout: SrtLayout | InClipLayout = "mavic3"
    """Layout of the telemetry, by a drone that writes it so beside the clip (`gimbal`: `mavic3`
    with the gimbal's angles), or into it.
    """
    shift: float = 0.0
    """Seconds by which the telemetry's times are late against the pictures."""
    fixes_per_second: float = 2.0
    """How often the receiver measures; its last fix is repeated in between."""
    gust_every: float = 20.0
    """A gust in every so many seconds."""
    gust_seconds: float = 1.2
    """Its duration."""
    gust_blur: float = 0.0
    """Length of the blur in a gust, px; 0 = no gusts."""


@dataclass(frozen=True, kw_only=True)
class FlightSettings:
    """A whole simulated survey; equal settings give equal bytes."""

    seed: int = 1
    """Seed of all random numbers."""
    lens: Lens = field(default_factory=Lens)
    """The true camera."""
    scene: SceneSettings = field(default_factory=SceneSettings)
    """The terrain."""
    weather: Weather = field(default_factory=Weather)
    """Season and hour of the visible flight."""
    route: Route = field(default_factory=Route)
    """Where photos are taken."""
    pictures: Pictures = field(default_factory=Pictures)
    """How photos are formed."""
    reporting: Reporting = field(default_factory=Reporting)
    """How metadata are reported."""
    control: Control = field(default_factory=Control)
    """Targets on the ground."""
    thermal: Thermal | None = None
    """The thermal flight, if there is one."""
    multispectral: Multispectral | None = None
    """The multispectral camera, if there is one."""
    video: Video | None = None
    """The clip, if there is one."""
    gsd: float | None = None
    """Cell size of the terrain's raster, m; the nominal ground resolution of the photos where
    None.
    """

    @property
    def resolution(self) -> float:
        """Cell size of the terrain's raster and of the true orthophoto, m."""
        return self.gsd if self.gsd is not None else self.route.height / self.lens.focal

    def checked(self) -> "FlightSettings":
        """The settings unchanged; raises UsageError where values do not fit together."""
        for name in not_finite(self):
            raise UsageError(f"{name} must be a number, not nan or infinite")
        for rules in (_route_rules(self), _other_rules(self)):
            for holds, sentence in rules:
                if not holds:
                    raise UsageError(sentence)
        return self


def not_finite(record: Any, name: str = "") -> Iterator[str]:
    """Names of the numbers in a record, and in those within it, that are NaN or infinite."""
    if is_dataclass(record):
        for known in fields(record):
            yield from not_finite(getattr(record, known.name), known.name)
    elif isinstance(record, tuple):
        for value in record:
            yield from not_finite(value, name)
    elif isinstance(record, float) and not math.isfinite(record):
        yield name.replace("_", " ")


_Rules = list[tuple[bool, str]]


def _route_rules(settings: FlightSettings) -> _Rules:
    route, relief, kind = settings.route, settings.scene.relief, settings.scene.kind
    low = f"height {route.height:g} m is too low over a relief of {relief:g} m"
    lost = f"cannot lose {route.lost} of {route.photos} photos, at most every second one"
    return [
        (1 <= route.photos <= 100_000, f"photos must be 1 to 100,000, not {route.photos}"),
        (0 <= route.overlap < 0.98, f"overlap must be 0 to 97 %, not {100 * route.overlap:.0f} %"),
        (0 <= route.sidelap < 0.98, f"sidelap must be 0 to 97 %, not {100 * route.sidelap:.0f} %"),
        (
            25 <= route.height <= 20_000,
            f"height must be at least 25 m (trees, houses) and at most 20 km, not {route.height:g}"
            " m",
        ),
        (
            -360 <= route.heading <= 360,
            f"the heading must be -360 to 360 degrees, not {route.heading:g}",
        ),
        (route.height > 2 * relief, low),
        (
            route.height >= 25 + height(kind),
            f"height must be at least {25 + height(kind):g} m over {kind}, not {route.height:g} m",
        ),
        (0 < route.speed <= 60, f"speed must be above 0 and at most 60 m/s, not {route.speed:g}"),
        (
            0 <= settings.lens.readout <= 1,
            f"a readout takes 0 to 1000 ms, not {1000 * settings.lens.readout:g}",
        ),
        (
            0.9 <= settings.lens.aspect <= 1.1,
            f"aspect must be 0.9 to 1.1, not {settings.lens.aspect:g}",
        ),
        (0 <= route.turns <= 30, f"turns must be 0 to 30 degrees/s, not {route.turns:g}"),
        (route.drones >= 1, f"drones must be at least 1, not {route.drones}"),
        (0 <= 2 * route.lost < route.photos, lost),
        (
            0 <= route.tilt_noise <= 30,
            f"tilt noise must be 0 to 30 degrees, not {route.tilt_noise:g}",
        ),
        (
            0 <= route.oblique <= 1000,
            f"the number of oblique photos must be 0 to 1000, not {route.oblique}",
        ),
        (
            0 <= route.oblique_tilts[0] <= route.oblique_tilts[1] <= 80,
            "oblique photos are tilted by 0 to 80 degrees, the least tilt first",
        ),
    ]


def _other_rules(settings: FlightSettings) -> _Rules:
    hour, relief, control = settings.weather.hour, settings.scene.relief, settings.control
    reporting, pictures = settings.reporting, settings.pictures
    return [
        (settings.seed >= 0, f"the seed must not be negative, not {settings.seed}"),
        (relief >= 0, f"relief must not be negative, not {relief:g} m"),
        (0 <= hour < 24, f"hour must be 0 to 24, not {hour:g}"),
        (
            min(settings.lens.width, settings.lens.height) >= 64,
            "photos must be at least 64 px wide and high",
        ),
        (
            not settings.lens.folds,
            "the lens's distortion leaves the corners of photos without rays",
        ),
        (
            control.points >= 0 and control.checks >= 0,
            "numbers of control and check points must not be negative",
        ),
        (
            0 <= reporting.gps_noise <= MOST_M and 0 <= (reporting.gps_noise_z or 0) <= MOST_M,
            f"GPS noise must be 0 to {MOST_M:g} m, not {reporting.gps_noise:g}"
            + ("" if reporting.gps_noise_z is None else f" and {reporting.gps_noise_z:g}"),
        ),
        (
            abs(reporting.altitude_drift) <= MOST_M,
            f"altitude drift must be at most {MOST_M:g} m, not {reporting.altitude_drift:g}",
        ),
        (
            abs(reporting.compass_error) <= 180,
            f"compass error must be -180 to 180 degrees, not {reporting.compass_error:g}",
        ),
        (
            abs(reporting.gimbal_error) <= 30,
            f"gimbal error must be -30 to 30 degrees, not {reporting.gimbal_error:g}",
        ),
        (reporting.gps_missing >= 0, "the number of photos without position must not be negative"),
        (
            -0.9 < reporting.focal_error <= 10,
            "the error of the focal length must be above -90 % and at most 1000 %",
        ),
        (
            0 <= pictures.exposure_noise <= 5,
            f"exposure noise must be 0 to 5, not {pictures.exposure_noise:g}",
        ),
        (
            0 <= pictures.vignetting <= 0.9,
            f"vignetting must be 0 to 90 %, not {100 * pictures.vignetting:.0f} %",
        ),
        (0 <= pictures.sun_hours <= 12, "the sun must move by 0 to 12 hours"),
        (
            0 <= pictures.blurred <= settings.route.photos,
            f"at most all {settings.route.photos} photos can be blurred, not {pictures.blurred}",
        ),
        (0 <= pictures.fires <= 100, f"there can be 0 to 100 fires, not {pictures.fires}"),
        (
            0 <= pictures.clouds <= 0.9,
            f"clouds must shade 0 to 90 % of the ground, not {100 * pictures.clouds:g} %",
        ),
        (0 <= settings.route.wind <= 40, "wind must be 0 to 40 m/s"),
        (0 <= pictures.motion_blur <= 100, "motion blur must be 0 to 100 px"),
        (
            settings.video is None or 0.2 <= settings.video.fps <= 120,
            "a clip has 0.2 to 120 frames per second",
        ),
        (
            settings.video is None or 0 <= settings.video.gust_blur <= 100,
            "a gust's blur must be 0 to 100 px",
        ),
        (
            settings.video is None or settings.route.drones == 1,
            "a clip is filmed by one drone; leave --drones out",
        ),
    ]
