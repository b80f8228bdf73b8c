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
from skyquilt.simulate.reported import place_at
from skyquilt.simulate.settings import FlightSettings

MOST_BYTES = 64_000_000
MOST_POINTS = 50_000


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
    flat = record["heights"] != "sea level"
    takeoff = local(*record["drones"][0]["start"])
    waypoints = []
    for sortie in record["sorties"]:
        for lon, lat, _, time, number in sortie["way"]:
            if number is not None:
                point = points[number]
                x, y = local(lon, lat)
                waypoints.append(
                    Waypoint(
                        x=x,
                        y=y,
                        heading=wrap(float(point["yaw_deg"]) - place.convergence),
                        line=int(sortie["number"]) - 1,
                        drone=int(sortie["drone"]),
                        time=float(time),
                        z=None if flat else float(point["z"]) - settings.scene.base,
                        point=int(number),
                    )
                )
    if not waypoints:
        raise ValueError("it takes no photo")
    waypoints.sort(key=lambda w: (w.time, w.drone))
    first = waypoints[0].time
    view = record["drones"][0]["view"]
    above = float(np.median([p["z"] - p["ground"] for p in record["points"]]))
    count = len(waypoints)
    route = replace(
        settings.route,
        photos=count,
        height=above,
        speed=float(record["drones"][0]["speed_ms"]),
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


def _lens(view: dict[str, Any]) -> Lens:
    """A lens without distortion that sees what the plan counts on."""
    focal = float(view["focal"])
    return Lens(
        width=int(view["width"]),
        height=int(view["height"]),
        focal=focal,
        offset_x=(view["left"] - view["right"]) / 2 * focal,
        offset_y=(view["up"] - view["down"]) / 2 * focal,
        k1=0.0,
        k2=0.0,
        p1=0.0,
        p2=0.0,
    )
