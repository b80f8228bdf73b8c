"""Plans a flight and flies it: the true poses of all photos."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from skyquilt.simulate.camera import Lens, camera_rotation, wrap
from skyquilt.simulate.grid import Doubles
from skyquilt.simulate.settings import Route

_TURN_S = 6.0  # seconds lost between two lines


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """A photo as planned."""

    x: float
    """Map x, m (local)."""
    y: float
    """Map y, m (local)."""
    heading: float
    """Degrees clockwise from the map's north; the image top points there."""
    line: int
    """Index of the flight line."""
    course: float | None = None
    """Direction of flight in degrees from the map's north, where it is not the heading."""
    drone: int = 0
    """Index of the drone."""
    time: float = 0.0
    """Seconds since the first photo of the flight."""
    z: float | None = None
    """Height above the base in m, where it is not the route's height above the take-off."""
    point: int | None = None
    """Id of the picture-point of a plan."""
    above: float = 0.0
    """Planned height above the ground in m, of the points of a plan."""
    velocity: tuple[float, float] | None = None
    """Over ground, m/s; None where the route's speed tells it."""
    pitch: float = 0.0
    """Mean pitch there, degrees, positive ahead."""
    roll: float = 0.0
    """Mean roll there, degrees, positive right wing down."""


@dataclass(frozen=True, kw_only=True)
class Shot:
    """The true pose of a photo."""

    name: str
    """File name."""
    waypoint: Waypoint
    """As planned."""
    centre: tuple[float, float, float]
    """Map x, y (local) and height above the base, m."""
    yaw: float
    """Degrees clockwise from the map's north to the camera's top."""
    pitch: float
    """Degrees, positive ahead."""
    roll: float
    """Degrees, positive right wing down."""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the camera in the map frame, m/s."""
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rates of rotation about the camera's x, y and z axes, degrees per second."""

    def moves(self, lens: Lens) -> bool:
        """Whether the rows of the photo are exposed from different places."""
        return lens.readout > 0 and bool(any(self.velocity) or any(self.spin))

    def exposed(self, lens: Lens, share: Doubles) -> tuple[Doubles, Doubles]:
        """Rotations (n, 3, 3) from map to camera and centres (n, 3) at the moments at which rows
        are exposed; `share` (n,): -0.5 for the first row, 0.5 for the last.
        """
        seconds = share * lens.readout
        turn = Rotation.from_rotvec(seconds[:, None] * np.radians(self.spin)).as_matrix()
        return turn @ self.rotation, self.place + seconds[:, None] * np.array(self.velocity)

    def project(self, lens: Lens, points: Doubles) -> Doubles:
        """Pixels (n, 2) of map points (n, 3), each from where the camera was when it exposed their
        row; NaN behind the camera.
        """
        pixels = lens.project(points, self.rotation, self.place)
        if not self.moves(lens):
            return pixels
        for _ in range(4):  # each round is a hundred times as close as the one before
            share = np.clip(pixels[:, 1] / (lens.height - 1) - 0.5, -2, 2)
            rotation, centre = self.exposed(lens, np.nan_to_num(share))
            pixels = lens.project(points, rotation, centre)
        return pixels

    @property
    def rotation(self) -> Doubles:
        """(3, 3) from map to camera."""
        return camera_rotation(self.yaw, self.pitch, self.roll)

    @property
    def place(self) -> Doubles:
        """The centre as an array (3,)."""
        return np.array(self.centre)


def plan(route: Route, lens: Lens) -> list[Waypoint]:
    """Waypoints in the order in which they are flown, centred on the map origin; times per
    drone.
    """
    wide, tall = lens.extent
    forward = (1 - route.overlap) * route.height * tall
    sideways = (1 - route.sidelap) * route.height * wide
    if route.pattern == "roundtrip":
        points = _around(route.photos, forward, route.heading)
    else:
        counts = [route.photos] if route.pattern == "strip" else _counts(route, forward, sideways)
        points = _lines(counts, forward, sideways, route.heading)
    if route.fixed_yaw:
        points = [replace(p, heading=route.heading, course=p.heading) for p in points]
    return _timed(_shared(points, route.drones), forward / route.speed)


def site(points: list[Waypoint], heading: float) -> tuple[float, float]:
    """Extent of waypoints along and across a heading, m."""
    turned = np.array([[p.x, p.y] for p in points]) @ _axes(heading).T
    along, across = np.ptp(turned, axis=0)
    return float(along), float(across)


def _axes(heading: float) -> Doubles:
    """Unit vectors along and to the right of a heading, as rows."""
    s, c = np.sin(np.radians(heading)), np.cos(np.radians(heading))
    return np.array([[s, c], [c, -s]])


def _counts(route: Route, forward: float, sideways: float) -> list[int]:
    """Number of photos on each line, for a given site, or for a number of photos on a nearly square
    site.
    """
    if route.site is not None:
        along, across = route.site
        return [int(np.ceil(along / forward - 1e-9)) + 1] * (
            int(np.ceil(across / sideways - 1e-9)) + 1
        )
    lines = min(max(1, round(np.sqrt(route.photos * forward / sideways))), route.photos)
    share, rest = divmod(route.photos, lines)
    return [share + (i < rest) for i in range(lines)]


def _lines(counts: list[int], forward: float, sideways: float, heading: float) -> list[Waypoint]:
    axes = _axes(heading)
    points = []
    for line, count in enumerate(counts):
        along = (np.arange(count) - (max(counts) - 1) / 2) * forward
        across = (line - (len(counts) - 1) / 2) * sideways
        back = line % 2 == 1
        for a in along[::-1] if back else along:
            x, y = np.array([a, across]) @ axes
            points.append(Waypoint(x=x, y=y, heading=wrap(heading + 180 * back), line=line))
    return points


def _around(photos: int, forward: float, heading: float) -> list[Waypoint]:
    """Waypoints once around a rectangle with sides of about 3 : 2, nose ahead; the last photo is
    beside the first.
    """
    length = photos * forward
    long_ = round(0.3 * length / forward) * forward
    sides = [long_, length / 2 - long_, long_, length / 2 - long_]
    corners = np.cumsum([0.0, *sides])
    axes = _axes(heading)
    ways = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    starts = np.cumsum(np.vstack([[0, 0], ways * np.array(sides)[:, None]]), axis=0) - [
        sides[0] / 2,
        sides[1] / 2,
    ]
    points = []
    for s in np.arange(photos) * forward:
        side = min(int(np.searchsorted(corners, s + 1e-6) - 1), 3)
        x, y = (starts[side] + ways[side] * (s - corners[side])) @ axes
        points.append(Waypoint(x=x, y=y, heading=wrap(heading + 90 * side), line=side))
    return points


def _shared(points: list[Waypoint], drones: int) -> list[Waypoint]:
    """Assigns a run of neighbouring lines to each drone (a run of photos where there are too few
    lines).
    """
    lines = max(p.line for p in points) + 1
    if lines >= drones:
        return [replace(p, drone=p.line * drones // lines) for p in points]
    return [replace(p, drone=i * drones // len(points)) for i, p in enumerate(points)]


def _timed(points: list[Waypoint], interval: float) -> list[Waypoint]:
    """Waypoints with times: all drones start together; photos in order of time."""
    clock: dict[int, tuple[float, int]] = {}
    timed = []
    for p in points:
        last = clock.get(p.drone)
        start = 0.37 * interval * p.drone
        time = (
            start if last is None else last[0] + interval + (_TURN_S if last[1] != p.line else 0.0)
        )
        clock[p.drone] = (time, p.line)
        timed.append(replace(p, time=time))
    return sorted(timed, key=lambda p: (p.time, p.drone))


def fly(points: list[Waypoint], route: Route, takeoff: float, seed: int, prefix: str) -> list[Shot]:
    """The true shots, without the lost ones; `takeoff` is the height of the take-off point above
    the base.
    """
    rng = np.random.default_rng([seed, 21, len(prefix)])
    lost = _losses(len(points), route.lost, rng)
    shaken = np.random.default_rng([seed, 22, len(prefix)]).normal(0, 1, (len(points), 3))
    spins = [(float(a), float(b), float(c)) for a, b, c in shaken * route.turns]
    shots = []
    for number, point in enumerate(points):
        dx, dy, dz = rng.normal(0, route.jitter, 3)
        yaw, pitch, roll = rng.normal(0, [route.yaw_noise, route.tilt_noise, route.tilt_noise])
        east, north = route.pushed(rng)
        course = np.radians(point.heading if point.course is None else point.course)
        speed = 0.0 if route.stops else route.speed
        over_ground = (float(speed * np.sin(course)), float(speed * np.cos(course)))
        letter = f"{chr(ord('A') + point.drone % 26)}_" if route.drones > 1 else ""
        shot = Shot(
            name=f"{prefix}_{letter}{number + 1:04d}",
            waypoint=point,
            centre=(
                point.x + dx + east,
                point.y + dy + north,
                (takeoff + route.height if point.z is None else point.z) + 0.6 * dz,
            ),
            yaw=wrap(point.heading + yaw),
            pitch=point.pitch + float(pitch),
            roll=point.roll + float(roll),
            velocity=(*(over_ground if point.velocity is None else point.velocity), 0.0),
            spin=spins[number],
        )
        if number not in lost:
            shots.append(shot)
    return sorted([*shots, *_oblique(shots, route, seed)], key=lambda s: s.waypoint.time)


def _oblique(shots: list[Shot], route: Route, seed: int) -> list[Shot]:
    """Photos taken one second after some of the shots, looking ahead; the shots themselves are the
    same with and without them.
    """
    rng = np.random.default_rng([seed, 22])
    after = rng.choice(len(shots), route.oblique, replace=route.oblique > len(shots))
    tilts = rng.permutation(np.linspace(*route.oblique_tilts, route.oblique))
    taken = []
    for number, (at, tilt) in enumerate(zip(after, tilts, strict=True)):
        last = shots[at]
        dx, dy, dz = rng.normal(0, route.jitter, 3)
        yaw, roll = rng.normal(0, [route.yaw_noise, min(route.tilt_noise, 3.0)])
        x, y, z = last.centre
        taken.append(
            replace(
                last,
                name=f"{last.name}_oblique{number + 1}",
                waypoint=replace(last.waypoint, time=last.waypoint.time + 1.0),
                centre=(x + dx, y + dy, z + 0.6 * dz),
                yaw=wrap(last.waypoint.heading + yaw),
                pitch=float(tilt),
                roll=float(roll),
            )
        )
    return taken


def _losses(count: int, lost: int, rng: np.random.Generator) -> set[int]:
    """Indices of lost photos: spread out, never neighbours, and not the first or last if
    possible.
    """
    if lost == 0:
        return set()
    edges = np.linspace(1, count - 1, lost + 1)
    chosen: set[int] = set()
    for low, high in pairwise(edges):
        chosen.add(
            int(rng.integers(int(np.ceil(low)), max(int(np.ceil(high)) - 1, int(np.ceil(low)) + 1)))
        )
    return chosen
