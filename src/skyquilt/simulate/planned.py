"""A plan of `skyquilt plan` as a flight to be simulated. It reads plan.json by itself, so the loop
from plan to map is judged by code that the planner does not share.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import Transformer

from skyquilt.errors import UsageError
from skyquilt.simulate.camera import Lens, wrap
from skyquilt.simulate.flight import Waypoint
from skyquilt.simulate.grid import Doubles
from skyquilt.simulate.reported import place_at
from skyquilt.simulate.settings import FlightSettings, Route

MOST_BYTES = 64_000_000
MOST_POINTS = 50_000
MOST_PIXELS, MOST_CELLS = 2e8, 3e9
"""Of a photo; of the ground at the size of the pixels."""
_SAME_M = 0.1
_LEAN = np.tan(np.radians(35)) / 16.0**2
"""Tangent of the lean over the square of the speed through the air."""
_LEFT = 0.1
"""Share of the lean that the gimbal leaves."""
_GUST = 0.3
"""Standard deviation of the wind's strength, as a share."""


@dataclass(frozen=True, kw_only=True)
class PlannedFlight:
    """What to simulate."""

    settings: FlightSettings
    """With the plan's place, camera and number of photos."""
    waypoints: list[Waypoint]
    """Photos in order of time."""
    takeoff: tuple[float, float]
    """Take-off place of the first drone (local x, y), from which heights count."""


def planned_flight(path: Path, settings: FlightSettings, *, lost: float) -> PlannedFlight:
    """The flight of a plan.json; `lost`: share of the photos that do not arrive.

    Raises:
        UsageError: the file cannot be read, or is no plan.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES // 10**6} MB")
        record = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(record, dict) or record.get("skyquilt_plan") != 1:
            raise ValueError("it is no plan of version 1")
        if not 0 < len(record["points"]) <= MOST_POINTS:
            raise ValueError(f"it has {len(record['points'])} points")
        return _flight(record, settings, lost)
    except (OSError, ValueError, KeyError, TypeError, IndexError, ArithmeticError) as error:
        raise UsageError(f"--plan: {path.name} cannot be flown: {str(error)[:200]}") from error


def _flight(record: dict[str, Any], settings: FlightSettings, lost: float) -> PlannedFlight:
    back = Transformer.from_crs(record["crs"], "EPSG:4326", always_xy=True)
    longitude, latitude = back.transform(*record["origin"])
    place = place_at(latitude, longitude)
    there = Transformer.from_crs("EPSG:4326", place.crs, always_xy=True)

    def local(lon: float, lat: float) -> tuple[float, float]:
        x, y = there.transform(lon, lat)
        if not np.isfinite([x, y]).all() or abs(x - place.easting) + abs(y - place.northing) > 1e5:
            raise ValueError("a place lies far from its origin")
        return float(x - place.easting), float(y - place.northing)

    points = {p["id"]: p for p in record["points"]}
    air = _Air(route=settings.route, rng=np.random.default_rng([settings.seed, 23]))
    flat = record["heights"] != "sea level"
    takeoff = local(*record["drones"][0]["start"])
    waypoints = []
    for sortie in record["sorties"]:
        way = np.array([local(row[0], row[1]) for row in sortie["way"]])
        drone = record["drones"][int(sortie["drone"])]
        for k, (_, _, _, time, number) in enumerate(sortie["way"]):
            if number is not None:
                point = points[number]
                above = _number(point["z"], -2e4, 2e4) - _number(point["ground"], -2e4, 2e4)
                planned = Waypoint(
                    x=float(way[k, 0]),
                    y=float(way[k, 1]),
                    heading=wrap(_number(point["yaw_deg"], -1e4, 1e4) - place.convergence),
                    line=int(sortie["number"]) - 1,
                    drone=int(sortie["drone"]),
                    time=_number(time, 0, 1e8),
                    z=None if flat else float(point["z"]) - settings.scene.base,
                    point=int(number),
                    above=max(above, 1.0),
                )
                waypoints.append(air.flown(planned, drone, _course(way, k)))
    if not waypoints:
        raise ValueError("it takes no photo")
    waypoints.sort(key=lambda w: (w.time, w.drone))
    first = waypoints[0].time
    view = record["drones"][0]["view"]
    above = float(np.median([w.above for w in waypoints]))
    _check_extent(waypoints, above, float(_number(view["focal"], 1, 1e6)))
    count = len(waypoints)
    route = replace(
        settings.route,
        photos=count,
        height=above,
        speed=_number(record["drones"][0]["speed_ms"], 0.1, 60),
        drones=len({w.drone for w in waypoints}),
        lost=round(lost * count),
        stops=True,
    )
    return PlannedFlight(
        settings=replace(
            settings,
            lens=_lens(view),
            route=route,
            scene=replace(settings.scene, latitude=latitude, longitude=longitude),
        ),
        waypoints=[replace(w, time=w.time - first) for w in waypoints],
        takeoff=takeoff,
    )


def _course(way: Doubles, k: int) -> float:
    """Direction in radians in which a way (n, 2) passes its place k: the mean of before and after,
    as on a curve, unless the way turns sharply there.
    """
    steps = [way[j + 1] - way[j] for j in range(len(way) - 1)]
    before = next((s for s in reversed(steps[:k]) if np.hypot(*s) > _SAME_M), None)
    after = next((s for s in steps[k:] if np.hypot(*s) > _SAME_M), None)
    ahead = [s / np.hypot(*s) for s in (before, after) if s is not None] or [np.array([0.0, 1.0])]
    mean = sum(ahead, np.zeros(2))
    x, y = mean if np.hypot(*mean) > 1.0 else ahead[0]
    return float(np.arctan2(x, y))


@dataclass(frozen=True, kw_only=True)
class _Air:
    """How drones fly in the wind.

    A multirotor leans into the air that passes it: drag grows with its square, and 35 degrees hold
    16 m/s. Its gimbal takes out the lean but for a tenth. Where a photo takes time it stops over
    the ground, in the wind; otherwise it flies on. A drone with a radius of turn is a fixed wing:
    it never stops, does not lean, and points into the wind by the triangle of velocities, with a
    camera fixed to it.
    """

    route: Route
    """Gives the wind."""
    rng: np.random.Generator
    """Of the gusts."""

    def flown(self, point: Waypoint, drone: dict[str, Any], course: float) -> Waypoint:
        """A planned photo as it is flown on a course in radians."""
        fixed_wing = _number(drone["turn_radius_m"], 0, 1e4) > 0
        stops = _number(drone["photo_s"], 0, 1e4) > 0 and not fixed_wing
        ahead = np.array([np.sin(course), np.cos(course)])
        to = np.radians(self.route.wind_from + 180)
        wind = self.route.wind * np.array([np.sin(to), np.cos(to)])
        along = float(wind @ ahead)
        across = float(wind @ [ahead[1], -ahead[0]])
        speed = _number(drone["speed_ms"], 0.1, 60)
        if not stops and speed <= abs(across):
            raise ValueError(f"its drone cannot fly straight in {self.route.wind:g} m/s of wind")
        pace = 0.0 if stops else float(np.sqrt(speed**2 - across**2)) + along
        if not stops and pace <= 0:
            raise ValueError(f"its drone makes no way against {self.route.wind:g} m/s of wind")
        velocity = pace * ahead
        heading = point.heading
        if fixed_wing:
            back = np.cos(course - np.radians(heading)) < 0
            heading = wrap(
                heading + 180 * bool(back) - float(np.degrees(np.arcsin(across / speed)))
            )
            return replace(
                point, heading=heading, velocity=(float(velocity[0]), float(velocity[1]))
            )
        gust = 1 + _GUST * float(self.rng.normal())
        passing = velocity - wind * gust
        lean = _LEAN * float(passing @ passing)
        tilt = _LEFT * float(np.degrees(np.arctan(lean)))
        toward = passing / max(float(np.hypot(*passing)), 1e-9)
        h = np.radians(heading)
        nose, wing = np.array([np.sin(h), np.cos(h)]), np.array([np.cos(h), -np.sin(h)])
        return replace(
            point,
            velocity=(float(velocity[0]), float(velocity[1])),
            pitch=-tilt * float(toward @ nose),  # with the nose down it looks behind
            roll=tilt * float(toward @ wing),
        )


def _lens(view: dict[str, Any]) -> Lens:
    """A lens without distortion that sees what the plan counts on."""
    focal = _number(view["focal"], 1, 1e6)
    sides = {k: _number(view[k], 1e-3, 10) for k in ("left", "right", "up", "down")}
    width, height = (int(_number(view[k], 64, 1e5)) for k in ("width", "height"))
    if width * height > MOST_PIXELS:
        raise ValueError(f"its camera has {width}x{height} px; {MOST_PIXELS:.0e} are the most")
    return Lens(
        width=width,
        height=height,
        focal=focal,
        offset_x=(sides["left"] - sides["right"]) / 2 * focal,
        offset_y=(sides["up"] - sides["down"]) / 2 * focal,
        k1=0.0,
        k2=0.0,
        p1=0.0,
        p2=0.0,
    )


def _number(value: Any, low: float, high: float) -> float:
    """A number of a plan from outside; raises ValueError for any other."""
    found = float(value)
    if not low <= found <= high:  # NaN is not either
        raise ValueError(f"it has {found:g} where a number from {low:g} to {high:g} is expected")
    return found


def _check_extent(waypoints: list[Waypoint], above: float, focal: float) -> None:
    """Refuses flights over more ground than can be drawn."""
    xy = np.array([(w.x, w.y) for w in waypoints])
    sides = np.ptp(xy, axis=0) + 4 * max(w.above for w in waypoints)
    cells = float(np.prod(sides / (above / focal)))
    if cells > MOST_CELLS:
        raise ValueError(
            f"its ground of {sides[0]:.0f} x {sides[1]:.0f} m has {cells:.0e} pixels; at most"
            f" {MOST_CELLS:.0e} are drawn"
        )
