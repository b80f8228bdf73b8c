"""A sortie as ground stations want it: places in degrees with heights above the take-off place."""

from dataclasses import dataclass

import numpy as np

from skyquilt.planning.plan_file import convergence
from skyquilt.planning.records import Drone, Plan, Sortie
from skyquilt.planning.site import geographic


@dataclass(frozen=True, kw_only=True)
class Stop:
    """A place on a route."""

    latitude: float
    """Degrees."""
    longitude: float
    """Degrees."""
    height: float
    """Above the take-off place, m."""
    yaw: float
    """Heading of the picture's top from true north, degrees from -180 to 180."""
    photo: bool
    """Whether a photo is taken."""


@dataclass(frozen=True, kw_only=True)
class Flight:
    """One sortie, ready to be written."""

    name: str
    """File name without ending."""
    drone: Drone
    """The drone."""
    home: Stop
    """Take-off place; its height is 0."""
    home_z: float
    """Its height above the sea (above flat ground where no terrain is known), m."""
    stops: tuple[Stop, ...]
    """From the end of the climb to the last place before the descent."""
    landing: Stop
    """Landing place at its height."""
    fence: tuple[np.ndarray, ...]
    """Outer rings (n, 2) of closed places, latitude and longitude."""
    rim: np.ndarray
    """Ring (n, 2) around the whole way, latitude and longitude."""


FENCE_M = 50.0
"""Distance of the fence around a way in m."""


def flights_of(plan: Plan) -> list[Flight]:
    """All sorties of a plan."""
    return [_flight(plan, s) for s in plan.sorties]


def _flight(plan: Plan, sortie: Sortie) -> Flight:
    from shapely import LineString

    drone, crs = plan.drones[sortie.drone], plan.site.crs
    xy = np.array([(w.x, w.y) for w in sortie.way])
    places, turns = geographic(crs, xy), convergence(crs, xy)
    yaws = {p.id: p.yaw for p in plan.points}
    home_z = sortie.way[0].z
    found, yaw = [], yaws.get(next((w.point for w in sortie.way if w.point), 0), 0.0)
    for w, (lon, lat), turn in zip(sortie.way, places.tolist(), turns.tolist(), strict=True):
        yaw = yaws[w.point] if w.point is not None else yaw
        found.append(
            Stop(
                latitude=round(lat, 8),
                longitude=round(lon, 8),
                height=round(w.z - home_z, 2),
                yaw=round((yaw + turn + 180) % 360 - 180, 2),
                photo=w.point is not None,
            )
        )
    rim = LineString(xy).buffer(FENCE_M).convex_hull.simplify(2.0)
    shapes = [k.shape for k in plan.site.keep_out if k.ceiling_m is None]
    rings = [np.array(shape.exterior.coords)[:-1] for shape in (rim, *shapes)]
    outer = [np.round(geographic(crs, ring)[:, ::-1], 8) for ring in rings]
    word = "".join(c if c.isalnum() else "-" for c in drone.name.lower()).strip("-") or "drone"
    number = f"-{sortie.number}" if any(s.number > 1 for s in plan.sorties) else ""
    return Flight(
        name=f"{sortie.drone + 1:02d}-{word}{number}",
        drone=drone,
        home=found[0],
        home_z=home_z,
        stops=tuple(found[1:-1]),
        landing=found[-1],
        fence=tuple(outer[1:]),
        rim=outer[0],
    )
