"""One photo as its metadata describe it: measurements with standard deviations, not facts."""

from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from skyquilt import registry
from skyquilt.model.camera import Camera

if TYPE_CHECKING:
    from skyquilt.model.clip import Clip

Datum = Literal["takeoff", "sea_level", "egm96", "ellipsoid", "control", "unknown"]
"""What a height refers to; `egm96`: the geoid; `sea_level`: sea level as the device defines it;
`control`: the same zero as the heights of the control points.
"""


Stored = Literal[
    "",
    "celsius",
    "kelvin",
    "decikelvin",
    "centikelvin",
    "decicelsius",
    "centicelsius",
    "fahrenheit",
    "counts",
]
"""What a value of a thermal TIFF may mean: degrees Celsius, (tenths, hundredths of a) kelvin, or
sensor counts.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class GeoPosition:
    """A measured camera position, WGS 84."""

    latitude_deg: float
    """Degrees, north positive."""
    longitude_deg: float
    """Degrees, east positive."""
    altitude_m: float | None
    """Height in m above `datum`; None where the photo gives none. Where several are given, the most
    reliable one.
    """
    datum: Datum
    """Zero of `altitude_m`."""
    sigma_xy_m: float = 1.5
    """Standard deviation of each horizontal axis in m."""
    sigma_z_m: float = 3.0
    """Standard deviation of the height in m."""
    source: str = "exif"
    """Where it was read: `xmp`, `exif`, `geo.txt`, `csv`, `srt`, `mrk`, `pos`, `gpx`."""
    takeoff_m: float | None = None
    """Height above take-off in m, where given."""
    sea_level_m: float | None = None
    """Height above sea level in m, where given."""
    ellipsoid_m: float | None = None
    """Height above the WGS 84 ellipsoid in m, where given."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Attitude:
    """A measured camera attitude: R_ned_body = Rz(yaw) Ry(pitch) Rx(roll) of a body whose belly
    camera looks down.

    The image top points along the body's nose, so yaw 0 = image top to true north, clockwise
    positive; pitch 0 = nadir, positive = looking ahead; roll positive = right wing down. Gimbal
    angles of other conventions are converted where they are read
    (`geometry.frames.belly_from_gimbal`).
    """

    yaw_deg: float
    """Degrees clockwise from true north to the image top."""
    pitch_deg: float
    """Degrees from nadir towards the image top."""
    roll_deg: float
    """Degrees about the body's nose."""
    source: str = "xmp-gimbal"
    """Where it was read: `xmp-gimbal`, `xmp-camera`, `xmp-flight`, `geo.txt`, `csv`."""
    sigma_yaw_deg: float = 5.0
    """Standard deviation of the yaw in degrees, provided that the value is no gross error."""
    sigma_tilt_deg: float = 1.0
    """Standard deviation of pitch and of roll in degrees."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Focal:
    """A focal length with its standard deviation."""

    px: float
    """Focal length in px of this file."""
    sigma_px: float
    """Standard deviation in px."""
    source: Literal["calibrated", "sensor", "focal-plane", "mode", "35mm", "guess"]
    """Calibrated value, mm with the sensor database, focal-plane resolution, table of video modes,
    35 mm equivalent, guess.
    """


@dataclass(frozen=True, kw_only=True, eq=False)
class Zoom:
    """A digital zoom: the middle of a camera's picture, enlarged to the size of the whole; or a
    part of it that was cut out.
    """

    camera: str
    """`Photo.camera_key` of the camera without it."""
    factor: float
    """How many times as large the ground looks."""
    sigma: float = 0.0
    """Standard deviation of the factor, as a share of it."""
    centred: bool = True
    """Whether it shows the middle of the picture, and not any part of it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shutter:
    """How long a camera takes to read a photo out, row by row."""

    readout_s: float
    """Time in s from the first row to the last; 0 = all rows at once."""
    sigma_s: float
    """Standard deviation in s; 0 = known for sure."""
    source: Literal["global", "option", "table", "guess", "unknown"]
    """A shutter that exposes all rows at once; the user; the table of cameras; rolling, of unlisted
    speed; unknown.
    """


UNKNOWN_SHUTTER = Shutter(readout_s=0.0, sigma_s=0.0, source="unknown")


def evenly(number: int, most: int) -> list[int]:
    """Indices of at most `most` of a number of photos, spread evenly from the first to the last;
    none of no photos.
    """
    spread = np.linspace(0, number - 1, most if number else 0).round().astype(int)
    return [int(k) for k in np.unique(spread)]


@dataclass(frozen=True, kw_only=True, eq=False)
class DetectorFaults:
    """What is wrong with a thermal camera's detector, in every frame of a flight."""

    bad: NDArray[np.int32]
    """(n,) pixels that do not measure, counted along rows."""
    columns: NDArray[np.float32]
    """(w,) by how much columns are too warm, in the frames' unit."""
    rows: NDArray[np.float32]
    """(h,) the same of rows."""
    key: str
    """Hash of the above (hex)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Photo:
    """One photo: where its pixels are and what its metadata report."""

    name: str
    """Unique in the survey: the path below the survey's folder, with forward slashes."""
    path: Path
    """The file."""
    digest: str
    """Hash of the file's content (hex)."""
    width: int
    """Width in px of the decoded sensor image; never rotated by EXIF Orientation."""
    height: int
    """Height in px."""
    channels: int
    """1 or 3 (or more, multi-band TIFF)."""
    dtype: Literal["uint8", "uint16", "float32"]
    """Type of the decoded pixels."""
    placed: bool = False
    """Whether its file tells where on the ground its pixels lie, as a map does (GeoTIFF)."""
    alpha: bool = False
    """Whether pixels may be see-through; these are black, or NaN where values are real numbers."""
    saved_grey: bool = False
    """Whether its file has one band, though it is read as colours, as others of its camera are."""
    band: Literal["visible", "thermal"]
    """Spectrum."""
    unit: Literal["", "celsius", "counts"] = ""
    """What a single-band pixel value means; empty for pictures."""
    stored: Stored = ""
    """What a value of a thermal TIFF means as stored in the file; empty for other files."""
    faults: DetectorFaults | None = None
    """Faults of its detector, mended when its pixels are read; None where none are known."""
    camera_key: str
    """Photos with equal keys share their intrinsics: make, model, serial, lens, size, zoom."""
    zoom: Zoom | None = None
    """Its digital zoom; None where it has none."""
    calibration: Camera | None = None
    """Intrinsics that metadata or a side file give, distortion included."""
    shown_lens: Camera | None = None
    """A lens of another kind than metadata tell, where the photos of its camera show it
    (`matching.lens_kind`).
    """
    band_name: str = ""
    """Band that a file of a multispectral camera shows, in lower case (`bands.canonical`);
    empty for others.
    """
    unusable_calibration: str = ""
    """A phrase on what its metadata give as a calibration and no lens can have; it is ignored."""
    focal: Focal
    """Always present; a guess with a large standard deviation where nothing is known."""
    whole_told: bool = False
    """Whether it shows a part of the picture that the camera took, and EXIF tells the size of that:
    the focal length is the one of that picture.
    """
    position: GeoPosition | None
    """None where the photo has none or it is invalid, e.g. (0, 0); then a note reports it."""
    height_m: float | None = None
    """Height above take-off in m of a photo without a position; None where the position tells it,
    or nothing does.
    """
    attitude: Attitude | None
    """The camera's attitude as reported."""
    flight_yaw_deg: float | None = None
    """Heading of the aircraft as reported, degrees clockwise from true north; an independent check
    of the yaw. Without camera angles, that of the image top.
    """
    flight_yaw_source: str = "xmp-flight"
    """Where it was read: `xmp-flight`, `exif` (`GPSImgDirection`)."""
    flight_tilt_deg: tuple[float, float] = (0.0, 0.0)
    """Pitch (positive: nose up) and roll (positive: right wing down) of the aircraft as reported,
    degrees; 0 where they are not.
    """
    time: datetime | None
    """Capture time with sub-seconds; naive local time unless the photo states an offset."""
    orientation_tag: int = 1
    """EXIF Orientation as written; never applied."""
    rolling_shutter: bool | None = None
    """True for known electronic (rolling) shutters, False for known global/mechanical ones, None
    where unknown.
    """
    shutter: Shutter = UNKNOWN_SHUTTER
    """How its rows are read out."""
    velocity_ned: tuple[float, float, float] | None = None
    """Velocity of the aircraft as reported, north, east and down in m/s."""
    editor: str | None = None
    """Software that rewrote the file after the camera, where the metadata name one, or where files
    are coded otherwise than the others of their camera.
    """
    coding: str = ""
    """How a JPEG is coded (`photos.headers.JpegHeader.coding`); empty for other files."""
    frame_s: float | None = None
    """Time in s of the frame in the clip that `path` is; None where `path` is a photo."""

    @property
    def above_takeoff_m(self) -> float | None:
        """Height above take-off in m that it tells."""
        return self.position.takeoff_m if self.position else self.height_m

    @property
    def pixels_key(self) -> str:
        """Stands for its pixels as they are read: the digest of its file, what values mean, and
        what is mended.
        """
        faults = "" if self.faults is None else self.faults.key
        return "-".join(part for part in (self.digest, self.stored or self.unit, faults) if part)

    @property
    def lens_guessed(self) -> bool:
        """Whether nothing tells the lens, so that its focal length is a guess."""
        return self._uncalibrated and self.focal.source == "guess"

    @property
    def focal_alone(self) -> bool:
        """Whether its focal length is all that is told of the lens."""
        return self._uncalibrated and self.focal.source != "guess"

    @property
    def _uncalibrated(self) -> bool:
        return self.calibration is None and self.shown_lens is None

    @property
    def shows_a_band(self) -> bool:
        """Whether the file shows one band of a multispectral camera."""
        return bool(self.band_name) and self.channels == 1

    @property
    def in_colours(self) -> bool:
        """Whether it shows the colours that the eye sees."""
        return self.channels == 3 and self.band == "visible"

    def other_band(self, shown: str) -> str:
        """The reason why a map of the band `shown` (empty: of photos in colours) leaves the file
        out; empty if it shows it too, or is of one channel and names no band.
        """
        if shown and self.in_colours:
            return f"it is in colours; the map shows the band {shown} (--band)"
        if not self.shows_a_band or self.band_name == shown:
            return ""
        instead = shown or "the photos in colours"
        return f"it shows the band {self.band_name}; the map shows {instead} (--band)"

    notes: tuple[str, ...] = ()
    """Plain sentences: what is missing, invalid or contradictory."""

    @property
    def lens(self) -> Camera:
        """The lens that the photos show, or the calibration that metadata or a side file give, or
        an ideal camera with the reported focal length.
        """
        known = self.shown_lens or self.calibration
        return known or Camera.ideal(width=self.width, height=self.height, focal=self.focal.px)


@dataclass(frozen=True, kw_only=True, eq=False)
class RejectedPhoto:
    """A file that is not used, and why. Never an exception: a bad photo never stops a survey."""

    name: str
    """As in `Photo.name`."""
    reason: str
    """A plain sentence."""
    trace: str = field(default="", repr=False)
    """Where the program failed on it, for the log of errors; empty where the file itself is bad."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Survey:
    """The content of a folder of photos."""

    photos: tuple[Photo, ...]
    """In order of capture (time, then name)."""
    rejected: tuple[RejectedPhoto, ...] = ()
    """Image files that could not be used, with reasons."""
    ignored: tuple[str, ...] = ()
    """Names of files that are no photos (text, archives) and are not read."""
    other_bands: tuple[Photo, ...] = ()
    """Files of a multispectral camera's other bands, which are among the rejected ones."""
    clips: "tuple[Clip, ...]" = ()
    """Clips whose frames are still to be chosen."""
    notes: tuple[str, ...] = ()
    """Plain sentences about the survey as a whole (two cameras, different clocks, duplicates
    ...).
    """

    def facts(self) -> dict[str, str]:
        """What matters of it, by name."""
        cameras = sorted({p.camera_key for p in self.photos})
        times = sorted(p.time.replace(tzinfo=None) for p in self.photos if p.time is not None)
        told = {
            "photos": str(len(self.photos)),
            "with positions": str(sum(p.position is not None for p in self.photos)),
            "cameras": ", ".join(cameras[:3]) + (" ..." if len(cameras) > 3 else ""),
        }
        if times:
            told["taken"] = f"{times[0]:%Y-%m-%d %H:%M} to {times[-1]:%H:%M}"
        counts = {"rejected": self.rejected, "ignored": self.ignored, "clips": self.clips}
        return told | {name: str(len(many)) for name, many in counts.items() if many}

    def __repr__(self) -> str:
        return f"Survey({', '.join(f'{k}: {v}' for k, v in self.facts().items())})"

    def _repr_html_(self) -> str:
        return str(registry.load("notebook", "survey")(self))


@dataclass(frozen=True, kw_only=True, eq=False)
class PointObservation:
    """One observation of a control point in a photo."""

    photo: str
    """Photo.name."""
    x: float
    """Pixel, centres at integers."""
    y: float
    """Pixel, centres at integers."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlPoint:
    """A surveyed point on the ground."""

    name: str
    """Label."""
    x: float
    """Easting or longitude in `crs`."""
    y: float
    """Northing or latitude in `crs`."""
    z: float | None
    """Height in m; None where the file says NaN."""
    crs: str
    """As pyproj reads it, e.g. `EPSG:32615`."""
    datum: Datum = "control"
    """Zero of `z` as far as `crs` states it: `egm96`, `ellipsoid`, else `control`."""
    observations: tuple[PointObservation, ...]
    """Its observations in photos."""
    sigma_m: float = 0.02
    """Standard deviation of each coordinate in m."""
    check: bool = False
    """True: not used in the adjustment, but to check it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownDistance:
    """A distance measured on the ground, used to check maps (Y 6.1)."""

    a: str
    """Label of one end."""
    b: str
    """Label of the other."""
    metres: float
    """Length in m."""
    observations_a: tuple[PointObservation, ...]
    """Observations of a."""
    observations_b: tuple[PointObservation, ...]
    """Observations of b."""
