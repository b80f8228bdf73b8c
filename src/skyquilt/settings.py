"""The settings of a mosaic in groups: each stage gets the group that concerns it.

Words are checked here, against the names that are registered; numbers against their limits.
"""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from math import isfinite
from pathlib import Path
from typing import Any

from skyquilt import registry
from skyquilt.effects import MOSAIC, refuse_idle, refuse_untaken
from skyquilt.errors import UsageError
from skyquilt.outside import MOST_MP
from skyquilt.typed import instance, typed

IMAGE_SEARCHES = ("chain", "loop", "overview")
OPTIMISERS = ("anneal", "surfaces")
LINES = ("heading", "distance")
TRANSFORMS = ("translation", "similarity", "affine", "homography")
BLENDS = ("feather", "first", "average", "multiband")
COMPRESSIONS = ("auto", "jpeg", "deflate", "zstd", "lzw", "none")
SURFACES = ("auto", "dense", "sweep", "ties")
THERMAL_UNITS = (
    "auto",
    "celsius",
    "kelvin",
    "decikelvin",
    "centikelvin",
    "decicelsius",
    "centicelsius",
    "fahrenheit",
    "counts",
)
VERTICAL_DATUMS = ("ellipsoid", "egm96", "takeoff")
DISTORTIONS = ("none", "2", "4", "6", "6t", "full")
SHUTTERS = ("global", "rolling")
USUAL_GB = 1.2
"""Memory allowed by default."""
HELD_GB, THREAD_GB = 0.5, 0.06
"""Memory that a run needs besides its threads, and what each thread may take, about."""


def one_of(option: str, value: str, allowed: Iterable[str]) -> None:
    """Refuses a word that is none of those allowed.

    Raises:
        UsageError: the sentence lists them.
    """
    allowed = tuple(allowed)
    if value not in allowed:
        raise UsageError(f"{option} {value!r} is not one of {', '.join(allowed)}")


def within(option: str, value: float | None, low: float, high: float, unit: str = "") -> None:
    """Refuses a number outside its limits; None passes.

    Raises:
        UsageError: it lies outside; the sentence tells the unit.
    """
    if value is not None and not low <= value <= high:
        raise UsageError(f"{option} {value} lies outside {low} to {high} {unit}".rstrip())


def check_shutter(shutter: str | None, readout_ms: float | None) -> None:
    """Refuses what cannot be said of a shutter (`--shutter`, `--shutter-readout`).

    Raises:
        UsageError: an unknown kind, an impossible time, or a global shutter with a readout.
    """
    if shutter is not None:
        one_of("--shutter", shutter, SHUTTERS)
    if readout_ms is not None and not 0 < readout_ms <= 1000:
        raise UsageError(
            f"--shutter-readout {readout_ms:g} is no readout of a camera, which takes more than 0"
            " and at most 1000 ms; for a global shutter say --shutter global"
        )
    if shutter == "global" and readout_ms is not None:
        raise UsageError("--shutter global has no readout; leave --shutter-readout out")


def _check_scheduler(scheduler: str | None) -> None:
    """Refuses what is neither local:N, nor an address, nor a file.

    Raises:
        UsageError: the sentence says what is expected.
    """
    if scheduler is None or "://" in scheduler:
        return
    kind, _, number = scheduler.partition(":")
    if kind == "local":
        if not (number.isdecimal() and number.isascii() and 1 <= int(number[:5]) <= 1024):
            raise UsageError(f"--scheduler {scheduler}: local:N starts N processes, 1 to 1024")
    elif not Path(scheduler).is_file():
        raise UsageError(
            f"--scheduler {scheduler} is neither local:N, nor an address such as"
            " tcp://host:8786, nor a scheduler file that exists"
        )


@dataclass(frozen=True, kw_only=True)
class InputSettings:
    """Files beside the photos, and how far metadata are believed."""

    gcp: Path | None = None
    """Control points (gcp_list.txt); None = the one in the folder of photos, if any."""
    geo: Path | None = None
    """Positions (geo.txt, CSV, MRK, SRT); None = the geo.txt in the folder of photos, if any."""
    cameras: Path | None = None
    """Calibrations (cameras.json)."""
    distances: Path | None = None
    """Known distances (CSV) by which the map is judged."""
    sequence: str = "time"
    """Order of the photos for methods that join them one by one: time, name, or a file of names."""
    thermal_unit: str | None = None
    """One of `THERMAL_UNITS`: what values of single-band TIFFs mean; None = found from the file, as
    is whether they are thermal.
    """
    band: str | None = None
    """Band that the map shows, of cameras that write a file for each; None = the usual one."""
    lever_arm: tuple[float, float, float] | None = None
    """From the antenna, to which reported positions refer, to the camera: right, forward, up in m
    in the aircraft's body; None = positions are those of the camera.
    """
    repair: bool = True
    """Treat metadata as measurements that may be wrong."""
    max_mp: float = MOST_MP
    """Largest area of a photo in megapixels; larger ones are left out before they are decoded."""
    shutter: str | None = None
    """One of `SHUTTERS`: how the cameras expose; None = as metadata and table of cameras say."""
    shutter_readout_ms: float | None = None
    """Time in ms in which a rolling shutter reads a photo out; None = as the table says."""
    frame_overlap: float = 78.0
    """Overlap in percent wanted between frames that are chosen from a clip."""
    clock_offset: float | None = None
    """Seconds to add to a clip's time to get the time of its positions; None = found from the
    flight's turns where possible.
    """
    write_frames: bool = False
    """Write the chosen frames of clips as JPEG files."""

    def __post_init__(self) -> None:
        typed(self)
        within("--max-mp", self.max_mp, 0.01, 10_000, "megapixels")
        if self.thermal_unit is not None:
            one_of("--thermal-unit", self.thermal_unit, THERMAL_UNITS)
        check_shutter(self.shutter, self.shutter_readout_ms)
        within("--frame-overlap", self.frame_overlap, 30, 95, "percent")
        within("--clock-offset", self.clock_offset, -1e8, 1e8, "s")
        for value in self.lever_arm or ():
            within("--lever-arm", value, -20, 20, "m")


@dataclass(frozen=True, kw_only=True)
class MatchingSettings:
    """How photos are compared with one another."""

    detector: str | None = None
    """A registered detector of features; None = sift."""
    matcher: str | None = None
    """A registered matcher; None = mutual."""
    estimator: str | None = None
    """A registered estimator; None = the method's own: magsac for links, ransac for `image`, ste
    for `flightline`.
    """
    transform: str | None = None
    """One of `TRANSFORMS`: how two photos may differ, for methods `image` (None = similarity) and
    `flightline` (None = homography).
    """
    features: int = 1200
    """Features per photo."""

    def __post_init__(self) -> None:
        typed(self)
        for stage in ("detector", "matcher", "estimator"):
            word = getattr(self, stage)
            if word is not None:
                one_of(f"--{stage}", word, registry.names(stage))
        if self.transform is not None:
            one_of("--transform", self.transform, TRANSFORMS)
        within("--features", self.features, 100, 50000)


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """What is assumed or adjusted of the cameras."""

    distortion: str | None = None
    """One of `DISTORTIONS`: what self-calibration may change of the lens model (None = full), or,
    for methods that do not calibrate, the order fitted to a calibration that photos bring along
    (None = 6t; `flightline` none).
    """
    height_m: float | None = None
    """Height above ground for methods without tie points, where altitudes do not give it."""
    heading_deg: float | None = None
    """Common heading for method `position`; None = the commonest reported one, north where none is.
    """

    def __post_init__(self) -> None:
        typed(self)
        if self.distortion is not None:
            one_of("--distortion", self.distortion, DISTORTIONS)
        within("--height", self.height_m, 0.5, 1e5, "m")
        within("--heading", self.heading_deg, -360, 360, "degrees")


@dataclass(frozen=True, kw_only=True)
class GroundSettings:
    """The surface that photos are projected on."""

    surface: str = "auto"
    """One of `SURFACES`: dense heights by multi-view matching where the ground has relief (auto) or
    everywhere and finer (dense), tie points refined by a plane sweep, or tie points alone.
    """

    def __post_init__(self) -> None:
        typed(self)
        one_of("--surface", self.surface, SURFACES)


@dataclass(frozen=True, kw_only=True)
class PictureSettings:
    """The map's grid, and how photos become one picture."""

    gsd_cm: float | None = None
    """Ground size of a map pixel in cm; None = the photos' own."""
    crs: str | None = None
    """Output CRS as PROJ knows it; None = the local UTM zone."""
    vertical_datum: str | None = None
    """One of `VERTICAL_DATUMS`: zero of the map's heights; None = what most photos state."""
    bounds: tuple[float, float, float, float] | None = None
    """West, south, east, north in the output CRS."""
    boundary: Path | None = None
    """Polygon that the map is cut to."""
    blend: str = "auto"
    """One of `BLENDS`; auto = feather, and average for method `flightline`, whose blend it is."""
    feather_px: float = 6.0
    """Width of feathered seams in map pixels."""
    max_view_angle: float = 70.0
    """Largest angle from the vertical in degrees at which a photo is shown."""
    balance: bool = True
    """Bring photos to one brightness: 8-bit pictures; for measured values see `balance_thermal`."""
    balance_thermal: bool | None = None
    """Balance the drift between thermal frames on their overlaps; False leaves values as recorded.
    None = temperatures, if `balance`, but not counts.
    """

    def __post_init__(self) -> None:
        typed(self)
        one_of("--blend", self.blend, ("auto", *BLENDS))
        if self.vertical_datum is not None:
            one_of("--vertical-datum", self.vertical_datum, VERTICAL_DATUMS)
        within("--gsd", self.gsd_cm, 0.05, 10000, "cm")
        within("--feather", self.feather_px, 0, 10000, "px")
        within("--max-view-angle", self.max_view_angle, 1, 90, "degrees")
        b = self.bounds
        if b and not (all(isfinite(v) for v in b) and b[0] < b[2] and b[1] < b[3]):
            raise UsageError(
                f"--bounds is west,south,east,north with west < east and south < north, got {b}"
            )


@dataclass(frozen=True, kw_only=True)
class OutputSettings:
    """How the map is written."""

    compress: str = "auto"
    """One of `COMPRESSIONS`; auto = JPEG for 8-bit pictures, deflate for measured values."""
    quality: int = 85
    """JPEG quality."""
    dtm: bool = False
    """Write dtm.tif as well: the bare ground, without what stands on it."""
    contours_m: float | None = None
    """Write contour lines of the bare ground, this many m apart; None = none."""

    def __post_init__(self) -> None:
        typed(self)
        one_of("--compress", self.compress, COMPRESSIONS)
        within("--quality", self.quality, 1, 100)
        within("--contours", self.contours_m, 0.05, 1000, "m")


@dataclass(frozen=True, kw_only=True)
class RunningSettings:
    """What a run may use; nothing here but `seed` changes the result."""

    jobs: int = 0
    """Threads; 0 = all processors, as far as the memory allows."""
    memory_gb: float | None = None
    """Memory to plan with in GB; None = 1.2."""
    seed: int = 0
    """Of everything random in methods `image`, `hybrid`, `flightline`."""
    scheduler: str | None = None
    """Processes that share the work: local:N (N of this machine), the address of a Dask scheduler
    (tcp://host:8786), or its scheduler file; None = threads of this process.
    """

    @property
    def threads(self) -> int:
        """Threads to use."""
        room = ((self.memory_gb or USUAL_GB) - HELD_GB) / THREAD_GB
        return self.jobs or max(1, min(os.cpu_count() or 1, int(room)))

    def __post_init__(self) -> None:
        typed(self)
        within("--jobs", self.jobs, 0, 1024)
        within("--memory", self.memory_gb, 0.5, 4096, "GB")
        within("--seed", self.seed, 0, 2**32 - 1)
        _check_scheduler(self.scheduler)


@dataclass(frozen=True, kw_only=True)
class ImageSettings:
    """Method `image` (Y 4.2)."""

    levelled: bool = True
    """Register by features of the dominant plane only."""
    image_search: str = "chain"
    """One of `IMAGE_SEARCHES`: against the last photo, the same with loops closed, or against the
    whole map so far.
    """
    relief_m: float | None = None
    """Largest height variation on the ground in m; None = a tenth of the flying height."""

    def __post_init__(self) -> None:
        typed(self)
        one_of("--image-search", self.image_search, IMAGE_SEARCHES)
        within("--relief", self.relief_m, 0, 1e4, "m")


@dataclass(frozen=True, kw_only=True)
class HybridSettings:
    """Method `hybrid` (Y 4.1.2), and the thesis's quality function (Y 4.6)."""

    alpha: float = 0.5
    """Weight of distances against looks in lambda (Y 4.6), of any method's map."""
    optimiser: str = "surfaces"
    """One of `OPTIMISERS`: how `hybrid` maximises lambda."""

    def __post_init__(self) -> None:
        typed(self)
        one_of("--optimiser", self.optimiser, OPTIMISERS)
        within("--alpha", self.alpha, 0, 1)


@dataclass(frozen=True, kw_only=True)
class FlightlineSettings:
    """Method `flightline` (A)."""

    lines: str = "heading"
    """One of `LINES`: how flight lines are told apart."""

    def __post_init__(self) -> None:
        typed(self)
        one_of("--lines", self.lines, LINES)


GROUPS: dict[str, type] = {
    "input": InputSettings,
    "matching": MatchingSettings,
    "camera": CameraSettings,
    "ground": GroundSettings,
    "picture": PictureSettings,
    "output": OutputSettings,
    "running": RunningSettings,
    "image": ImageSettings,
    "hybrid": HybridSettings,
    "flightline": FlightlineSettings,
}
"""Groups by the name of their field."""
GROUP_OF = {f.name: name for name, kind in GROUPS.items() for f in fields(kind)}
"""Name of a setting -> the group it belongs to."""
DEFAULTS = {f.name: f.default for kind in GROUPS.values() for f in fields(kind)}
"""Name of a setting -> its value if it is not given."""


@dataclass(frozen=True, kw_only=True, init=False)
class MosaicSettings:
    """All settings of a mosaic; the defaults suit most surveys."""

    method: str
    """A registered alignment, or auto."""
    input: InputSettings
    """Side files and metadata."""
    matching: MatchingSettings
    """How photos are compared."""
    camera: CameraSettings
    """Cameras."""
    ground: GroundSettings
    """Surface."""
    picture: PictureSettings
    """Grid and picture."""
    output: OutputSettings
    """Files."""
    running: RunningSettings
    """Threads, memory, seed."""
    image: ImageSettings
    """Method `image`."""
    hybrid: HybridSettings
    """Method `hybrid`."""
    flightline: FlightlineSettings
    """Method `flightline`."""

    def __init__(self, *, method: str = "auto", **options: Any) -> None:
        """`options` are settings by their own names (`gsd_cm=2.0`), sorted into their groups, or
        whole groups (`picture=PictureSettings(gsd_cm=2.0)`).

        Raises:
            UsageError: an impossible word or number, or an option that the method does not take.
            TypeError: there is no such setting.
        """
        if unknown := [name for name in options if name not in GROUPS and name not in GROUP_OF]:
            raise TypeError(f"there is no setting {', '.join(unknown)}")
        object.__setattr__(self, "method", method)
        one_of("--method", method, registry.names("alignment"))
        for name, kind in GROUPS.items():
            given = instance(name, options.get(name), kind)
            changes = {f.name: getattr(given, f.name) for f in fields(kind)}
            changes |= {k: v for k, v in options.items() if GROUP_OF.get(k) == name}
            object.__setattr__(self, name, kind(**changes))
        asked = {name for name, value in self if value != DEFAULTS.get(name, value)}
        refuse_untaken(dict(self), asked)
        refuse_idle(MOSAIC, dict(self), asked)

    def changed(self, **options: Any) -> "MosaicSettings":
        """The same with other values of these settings, by their own names, or of the method."""
        groups = {name: getattr(self, name) for name in GROUPS}
        return MosaicSettings(**{"method": self.method, **groups, **options})

    def __iter__(self) -> Iterator[tuple[str, Any]]:
        """Names and values of all settings, the method first."""
        yield "method", self.method
        for setting, group in GROUP_OF.items():
            yield setting, getattr(getattr(self, group), setting)

    def as_table(self) -> dict[str, Any]:
        """Names and values as written to run.toml; unset ones left out."""
        return {k: str(v) if isinstance(v, Path) else v for k, v in self if v is not None}
