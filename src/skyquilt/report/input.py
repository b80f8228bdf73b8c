"""The input of the report: plain arrays and numbers from a finished run, independent of other
stages.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

Bounds = tuple[float, float, float, float]
"""West, south, east, north in m (map frame)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One placed photo."""

    name: str
    """Photo.name."""
    xyz: NDArray[Any]
    """(3,) solved camera centre in m (map frame)."""
    reported_xyz: NDArray[Any]
    """(3,) position reported by its metadata in m (map frame); NaN where there is none."""
    block: int = 0
    """Number of its block, the largest is 0."""
    method: str = ""
    """How it was placed."""
    footprint: NDArray[Any]
    """(k, 2) outline on the ground in m (map frame); empty if unknown."""
    time: str = ""
    """Capture time, ISO 8601; empty if unknown."""
    above_ground_m: float | None = None
    """Height of the camera above the ground below it in m."""
    yaw_deg: float | None = None
    """Direction of the image top in degrees clockwise from true north."""
    tilt_deg: float | None = None
    """Angle between the optical axis and the vertical in degrees."""
    tie_points: int | None = None
    """Number of tie points that it shows."""
    error_px: float | None = None
    """RMS of their residuals in px."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraResiduals:
    """Observations of tie points in all photos of one camera, or an even sample of them."""

    camera: str
    """Name of its calibration."""
    width: int
    """Image width in px."""
    height: int
    """Image height in px."""
    px: NDArray[Any]
    """(N, 2) observed pixels."""
    residual_px: NDArray[Any]
    """(N, 2) projected minus observed."""
    every: int = 1
    """One of so many observations is given."""


@dataclass(frozen=True, kw_only=True)
class SeamMark:
    """A place on a seam where the two photos were compared."""

    x: float
    """Easting in m (map frame)."""
    y: float
    """Northing in m (map frame)."""
    disparity_px: float | None
    """Displacement between the two photos in map px; None where it could not be measured."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthPicture:
    """Disparities of one registration in false colours."""

    name: str
    """Name of the registered photo."""
    pixels: NDArray[Any]
    """(h, w, 3) uint8."""
    features: int
    """Number of inliers."""
    removed: int
    """Number of features left out because they are off the dominant plane."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportInput:
    """Everything the page shows. Absent data are replaced by a sentence that says why."""

    metrics: Mapping[str, Any]
    """The content of metrics.json, with `control`, `cameras`, `notes`, `warnings` where there are
    any.
    """
    doubts: Sequence[str] = ()
    """What the alignment warned of; `notes` have it among others."""
    preview: NDArray[Any] | None = None
    """(H, W, 4) uint8 RGBA, north up: the mosaic, reduced."""
    bounds: Bounds | None = None
    """Bounds of the preview."""
    origin: tuple[float, float] = (0.0, 0.0)
    """Offset in m from map coordinates to coordinates in `crs`."""
    crs: str | None = None
    """As pyproj reads it; None when nothing says where on Earth the survey is."""
    metric: bool = True
    """False when even the scale is unknown: then 1 m is an arbitrary unit."""
    views: NDArray[Any] | None = None
    """(h, w) integers: number of photos that see each cell, row 0 is the northernmost."""
    views_bounds: Bounds | None = None
    """Bounds of the views."""
    surface: NDArray[Any] | None = None
    """(h, w) float heights in m, NaN where unknown, row 0 is the northernmost."""
    surface_bounds: Bounds | None = None
    """Bounds of the surface."""
    vertical_datum: str = "unknown"
    """What heights refer to: `takeoff`, `sea_level`, `ellipsoid`, `control`, `unknown`, or any
    phrase.
    """
    shots: Sequence[Shot] = ()
    """Placed photos in order of capture."""
    residuals: Sequence[CameraResiduals] = ()
    """Reprojection residuals by camera."""
    seams: Sequence[SeamMark] = ()
    """Samples along the seams."""
    worst_seams: Sequence[NDArray[Any]] = ()
    """(h, w, 3) uint8 crops of the map around the largest steps of colour, the worst first."""
    depths: Sequence[DepthPicture] = ()
    """Depth maps of a few registrations, for methods that compute them."""
    values: tuple[float, float, str] | None = None
    """For measured values: those of the first and of the last colour of the preview, and their unit
    as printed.
    """
    processed: str = ""
    """When the map was made, ISO 8601, local time."""
    files: Sequence[str] = ()
    """Names of the files beside the page that it links to."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """The resolved settings, nested as they are."""
    title: str = "Survey"
    """Heading of the page."""
    version: str = ""
    """Version of Skyquilt."""
