"""A video clip as its container and the files beside it describe it; frames chosen from it."""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from skyquilt.model.photo import Focal, Shutter

Doubles = NDArray[Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """Where a camera was at which time, as a telemetry file tells it: one fix per row.

    A value that stays the same from row to row counts as measured in the first of these rows only.
    """

    file: str
    """Name of the file."""
    source: str
    """`srt`, `gpx`, `csv`, `photos`, or `clip`: a track of data in the clip itself."""
    digest: str
    """Hash of what was read (hex)."""
    on_clip: bool
    """Whether times count from the first frame of the clip; otherwise they are seconds since 1970.
    """
    time_s: Doubles
    """(n,) times of the fixes in s, increasing."""
    latitude_deg: Doubles
    """(n,) WGS 84."""
    longitude_deg: Doubles
    """(n,) WGS 84."""
    step_deg: float
    """Step to which the file rounds latitude and longitude."""
    height_time_s: Doubles
    """(m,) times of heights and angles in s, increasing."""
    takeoff_m: Doubles
    """(m,) heights above take-off; NaN where not given."""
    sea_level_m: Doubles
    """(m,) heights above sea level; NaN where not given."""
    gimbal_deg: Doubles
    """(m, 3) yaw, pitch and roll of the gimbal (pitch -90 = nadir); NaN where not given."""
    flight_yaw_deg: Doubles
    """(m,) heading of the aircraft; NaN where not given."""
    start: datetime | None = None
    """What the file's own clock says at time 0 of a track on the clip's clock."""
    focal_35mm: float | None = None
    """35 mm equivalent focal length in mm."""
    zoom: float = 1.0
    """Digital zoom."""
    rows: int = 0
    """Rows of the file with or without a position."""
    zeros: int = 0
    """Rows whose position is (0, 0) or none."""
    repeats: int = 0
    """Rows that only repeat the fix before."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Clip:
    """One video clip; its frames are not decoded yet."""

    name: str
    """Unique in the survey: the path below the survey's folder, with forward slashes."""
    path: Path
    """The file."""
    digest: str
    """Hash of the file's size and of parts of its content (hex)."""
    width: int
    """Width in px as the sensor recorded it: a rotation flag of the container is not applied."""
    height: int
    """Height in px."""
    fps: float
    """Mean frames per second."""
    frames: int
    """Number of frames that the container states."""
    codec: str
    """Four letters."""
    rotation_deg: int
    """Rotation by which a player shows the clip; never applied."""
    start: datetime | None
    """When the clip starts: naive local time of the drone, or UTC where only the container says."""
    model: str
    """Camera model as the container names it; empty where it does not."""
    camera_key: str
    """As `Photo.camera_key`."""
    focal: Focal
    """In px of the clip."""
    shutter: Shutter
    """How rows are read out."""
    track: Track | None
    """Positions beside it."""
    notes: tuple[str, ...] = ()
    """Plain sentences: what is missing, invalid or contradictory."""

    @property
    def duration_s(self) -> float:
        """Length in s that the container states."""
        return self.frames / self.fps if self.fps > 0 else 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Looks:
    """What was seen at the frames of a clip that were looked at, in order of time."""

    time_s: Doubles
    """(n,) times in s from the first frame."""
    sharp: Doubles
    """(n,) logarithm of fine detail against detail of four times the size; greater is sharper."""
    turn: Doubles
    """(n,) complex: rotation and scale from this look to the one before."""
    shift: Doubles
    """(n,) complex: its middle in the look before, x + iy from the middle there, px of the clip."""
    linked: Doubles
    """(n,) bool: turn and shift could be measured."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ChosenFrame:
    """One chosen frame."""

    look: int
    """Index among the looks."""
    time_s: float
    """From the first frame, s."""
    overlap: float
    """With the chosen frame before, as share of the frame; NaN for the first of a run."""
    sharp: float
    """Sharpness against the median of the clip (logarithm; 0 = median)."""
    reason: str
    """Why this frame: `first`, `overlap`, `sharpest`, `cut`, `last`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ChosenFrames:
    """The frames chosen from a clip and how, as the report tells it."""

    clip: str
    """Clip.name."""
    fps: float
    """Clip.fps."""
    looked: int
    """Frames looked at."""
    chosen: tuple[ChosenFrame, ...]
    """In order of time."""
    blurred: int
    """Looks that are too blurred."""
    still: int
    """Looks at which nothing had moved since the one before."""
    overlap: float
    """Wanted share."""
    focal: Focal
    """Before the adjustment."""
    shutter: Shutter
    """Before the adjustment."""
    offset_s: float = 0.0
    """Seconds added to the clip's time to get the time of its positions."""
    offset_sigma_s: float | None = None
    """Standard deviation of the offset in s; None where it was not found from the flight."""
    offset_source: str = "none"
    """`turns` (found from the flight), `option`, `span` (positions last as long as the clip and are
    taken to begin with it), `clock` or `none`.
    """
    placed: int = 0
    """Chosen frames that got a position."""

    def name(self, frame: ChosenFrame) -> str:
        """The name of a frame in the survey: the clip's, and the number of the frame."""
        return f"{self.clip}.{round(frame.time_s * self.fps):06d}"
