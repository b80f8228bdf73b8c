"""Records of a mission. Lengths in m in a UTM zone, x east and y north; times in s; angles in
degrees clockwise from the zone's north.
"""

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon

Array = NDArray[np.float64]
Area: TypeAlias = Polygon | MultiPolygon
Format = Literal["qgc", "ardupilot", "dji", "litchi"]
FORMATS: tuple[Format, ...] = ("qgc", "ardupilot", "dji", "litchi")


@dataclass(frozen=True, kw_only=True)
class View:
    """What a camera sees when it looks straight down: tangents of the angles from its axis to the
    borders of the largest upright rectangle inside the undistorted picture.
    """

    name: str
    """The camera's name."""
    width: int
    """Picture width in px."""
    height: int
    """Picture height in px."""
    focal: float
    """Focal length in px."""
    left: float
    """To the left border."""
    right: float
    """To the right border."""
    up: float
    """To the upper border, which points ahead."""
    down: float
    """To the lower border."""

    @property
    def along(self) -> float:
        """Length of the footprint along the heading, per m of height."""
        return self.up + self.down

    @property
    def across(self) -> float:
        """Width of the footprint, per m of height."""
        return self.left + self.right

    @property
    def reach(self) -> float:
        """Largest tangent, that of a corner."""
        return float(np.hypot(max(self.left, self.right), max(self.up, self.down)))


@dataclass(frozen=True, kw_only=True)
class KeepOut:
    """A place that no drone may enter."""

    shape: Polygon
    """Its outline."""
    ceiling_m: float | None = None
    """Height above its highest ground up to which it is closed; None = closed at every height."""
    name: str = ""
    """Its name."""


@dataclass(frozen=True, kw_only=True)
class Site:
    """What is to be observed, and where nobody may fly."""

    crs: str
    """The UTM zone of all coordinates, such as `EPSG:32633`."""
    origin: tuple[float, float]
    """Easting and northing in whole m near its middle; simulations put their frame there."""
    observe: Area
    """Ground to be observed."""
    keep_out: tuple[KeepOut, ...] = ()
    """Closed places."""


@dataclass(frozen=True, kw_only=True)
class Drone:
    """A drone and its means."""

    name: str
    """Its name."""
    start: tuple[float, float]
    """Take-off place."""
    landing: tuple[float, float]
    """Landing place."""
    endurance_s: float = 1500.0
    """Flight time of one charge."""
    reserve: float = 0.2
    """Share of the endurance that must be left at landing."""
    speed_ms: float = 8.0
    """Speed through the air."""
    climb_ms: float = 3.0
    """Largest vertical speed."""
    turn_radius_m: float = 0.0
    """Least radius of a turn; 0 = it turns on the spot."""
    photo_s: float = 1.5
    """Time that a photo takes: stopping, exposure, starting."""
    swap_s: float = 180.0
    """Time on the ground between two sorties."""
    view: View
    """Its camera."""
    formats: tuple[Format, ...] = FORMATS
    """Files that its ground station reads."""

    @property
    def usable_s(self) -> float:
        """Flight time less the reserve."""
        return self.endurance_s * (1 - self.reserve)


@dataclass(frozen=True, kw_only=True)
class PicturePoint:
    """A place at which a photo is taken, looking straight down (thesis 2.4)."""

    id: int
    """Number in the plan, from 1."""
    x: float
    """Easting."""
    y: float
    """Northing."""
    z: float
    """Height above the sea; above the ground where no terrain is known."""
    ground: float
    """Height of the ground below it, same zero."""
    yaw: float
    """Direction of the picture's top."""

    @property
    def xyz(self) -> tuple[float, float, float]:
        """The three coordinates."""
        return self.x, self.y, self.z


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """A place on a route."""

    x: float
    """Easting."""
    y: float
    """Northing."""
    z: float
    """Height, as of the points."""
    time_s: float
    """Arrival, after the mission's start."""
    point: int | None = None
    """Id of the picture-point where a photo is taken; None = it only passes."""


@dataclass(frozen=True, kw_only=True)
class Sortie:
    """One flight on one charge."""

    drone: int
    """Index of the drone."""
    number: int
    """Counted from 1 for each drone."""
    way: tuple[Waypoint, ...]
    """From the take-off place on the ground to the landing place on the ground."""

    @property
    def seconds(self) -> float:
        """Its duration."""
        return self.way[-1].time_s - self.way[0].time_s

    @property
    def photos(self) -> int:
        """Number of photos."""
        return sum(w.point is not None for w in self.way)

    @property
    def metres(self) -> float:
        """Length of its way."""
        xyz = np.array([(w.x, w.y, w.z) for w in self.way])
        return float(np.linalg.norm(np.diff(xyz, axis=0), axis=1).sum())


@dataclass(frozen=True, kw_only=True)
class Proof:
    """What the footprints of all points, projected on the terrain, show."""

    views: int
    """Views asked for in every cell."""
    cell_m: float
    """Side of a cell."""
    cells: int
    """Cells of the area."""
    least: int
    """Least number of views of a cell."""
    median: float
    """Median number of views."""
    missing_m2: float
    """Area under the number asked for."""
    closed_m2: float
    """Area inside closed places; it is not asked for."""
    gsd_cm: tuple[float, float]
    """Finest and coarsest ground size of a pixel at the middle of a picture, and within the area.
    """
    overlap: float
    """Least share that consecutive photos of a line have in common on the ground."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A whole mission."""

    site: Site
    """Areas."""
    drones: tuple[Drone, ...]
    """The fleet."""
    points: tuple[PicturePoint, ...]
    """All picture-points."""
    sorties: tuple[Sortie, ...]
    """All flights, in order of drone and number."""
    options: dict[str, float | int | str | None]
    """The options that shaped it."""
    terrain: bool
    """Whether heights count from the sea; otherwise from flat ground."""
    proof: Proof | None = None
    """Coverage."""
    bound_s: float = 0.0
    """No plan for these points and drones can end earlier."""
    warnings: tuple[str, ...] = field(default=())
    """What does not hold."""

    @property
    def seconds(self) -> float:
        """When the last drone has landed."""
        return max((s.way[-1].time_s for s in self.sorties), default=0.0)
