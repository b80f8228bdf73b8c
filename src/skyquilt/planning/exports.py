"""Files for ground stations: QGroundControl, ArduPilot, DJI (WPML) and Litchi."""

import csv
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from skyquilt.planning.records import Format, Plan
from skyquilt.planning.stops import Flight, flights_of
from skyquilt.planning.wpml import dji
from skyquilt.raster.atomic import whole_file

TAKE_OFF, WAYPOINT, RETURN, LAND, SPEED, CAMERA, MOUNT, CAPTURE = (
    22,
    16,
    20,
    21,
    178,
    203,
    205,
    2000,
)
"""MAVLink commands (common.xml)."""
RELATIVE = 3
"""MAVLink's frame of heights above the take-off place."""
LITCHI_ACTIONS = 15


@dataclass(frozen=True, kw_only=True)
class Writer:
    """A format of files."""

    ending: str
    """Of the file name."""
    write: Callable[[Flight], bytes]
    """The content."""
    most: int = 10**9
    """Places that the ground station takes in one mission."""


def write_missions(folder: Path, plan: Plan) -> list[str]:
    """Writes every drone's files in the formats that it reads; returns their names. Longer ways
    than a ground station takes are divided into parts.
    """
    names = []
    for flight in flights_of(plan):
        for kind in flight.drone.formats:
            writer = WRITERS[kind]
            for part in parts(flight, writer.most):
                name = part.name + writer.ending
                with whole_file(folder / name) as file:
                    file.write(writer.write(part))
                names.append(name)
    return names


def parts(flight: Flight, most: int) -> list[Flight]:
    """A flight divided so that no part has more places than `most`."""
    count = -(-len(flight.stops) // most)
    if count <= 1:
        return [flight]
    size = -(-len(flight.stops) // count)
    return [
        replace(flight, name=f"{flight.name}-part-{k + 1}",
                stops=flight.stops[k * size : (k + 1) * size])
        for k in range(count)
    ]  # fmt: skip


def commands(flight: Flight, *, capture: int) -> list[tuple[int, tuple[float, ...]]]:
    """MAVLink commands with their seven parameters: take-off, camera down, places with photos,
    home.
    """
    first = flight.stops[0]
    place = (flight.home.latitude, flight.home.longitude)
    found: list[tuple[int, tuple[float, ...]]] = [
        (TAKE_OFF, (0, 0, 0, 0, *place, first.height)),
        (SPEED, (1, flight.drone.speed_ms, -1, 0, 0, 0, 0)),
        (MOUNT, (-90, 0, 0, 0, 0, 0, 2)),
    ]
    photo = (0, 0, 1, 0, 0, 0, 0) if capture == CAPTURE else (0, 0, 0, 0, 1, 0, 0)
    for stop in flight.stops:
        hold = 1 if stop.photo else 0
        found.append((WAYPOINT, (hold, 0, 0, stop.yaw, stop.latitude, stop.longitude, stop.height)))
        if stop.photo:
            found.append((capture, photo))
    home = flight.home
    lands_at_home = (flight.landing.latitude, flight.landing.longitude) == place
    if lands_at_home:
        found.append((RETURN, (0, 0, 0, 0, 0, 0, 0)))
    else:
        end = flight.landing
        found.append((LAND, (0, 0, 0, 0, end.latitude, end.longitude, end.height - home.height)))
    return found


def qgroundcontrol(flight: Flight) -> bytes:
    """A `.plan` with the places to keep out of and a ring around the way as fence."""
    items: list[dict[str, Any]] = [
        {
            "AMSLAltAboveTerrain": None,
            "Altitude": params[6],
            "AltitudeMode": 1,
            "autoContinue": True,
            "command": command,
            "doJumpId": k,
            "frame": RELATIVE if command in (TAKE_OFF, WAYPOINT, LAND) else 2,
            "params": list(params),
            "type": "SimpleItem",
        }
        for k, (command, params) in enumerate(commands(flight, capture=CAPTURE), 1)
    ]
    rings = [(flight.rim, True), *((ring, False) for ring in flight.fence)]
    record = {
        "fileType": "Plan",
        "version": 1,
        "groundStation": "QGroundControl",
        "mission": {
            "version": 2,
            "firmwareType": 12,
            "vehicleType": 1 if flight.drone.turn_radius_m else 2,
            "cruiseSpeed": flight.drone.speed_ms,
            "hoverSpeed": flight.drone.speed_ms,
            "globalPlanAltitudeMode": 1,
            "plannedHomePosition": [flight.home.latitude, flight.home.longitude, flight.home_z],
            "items": items,
        },
        "geoFence": {
            "version": 2,
            "circles": [],
            "polygons": [
                {"inclusion": inner, "polygon": ring.tolist(), "version": 1}
                for ring, inner in rings
            ],
        },
        "rallyPoints": {"version": 2, "points": []},
    }
    return (json.dumps(record, indent=1, allow_nan=False) + "\n").encode()


def ardupilot(flight: Flight) -> bytes:
    """A `.waypoints` file (QGC WPL 110)."""
    home = (0, 0, 0, 0, flight.home.latitude, flight.home.longitude, flight.home_z)
    rows: list[tuple[int, int, tuple[float, ...]]] = [(0, WAYPOINT, home)]
    rows += [
        (RELATIVE, command, (*params[:4], 0, 0, 0) if command == MOUNT else params)
        for command, params in commands(flight, capture=CAMERA)
    ]
    lines = ["QGC WPL 110"]
    for k, (frame, command, params) in enumerate(rows):
        words = [str(k), str(int(k == 0)), str(frame), str(command),
                 *(f"{p:.8f}" for p in params), "1"]  # fmt: skip
        lines.append("\t".join(words))
    return ("\n".join(lines) + "\n").encode()


def litchi(flight: Flight) -> bytes:
    """A CSV that Litchi's mission hub imports."""
    actions = [f"action{w}{k}" for k in range(1, LITCHI_ACTIONS + 1) for w in ("type", "param")]
    head = [
        "latitude", "longitude", "altitude(m)", "heading(deg)", "curvesize(m)", "rotationdir",
        "gimbalmode", "gimbalpitchangle", *actions, "altitudemode", "speed(m/s)", "poi_latitude",
        "poi_longitude", "poi_altitude(m)", "poi_altitudemode", "photo_timeinterval",
        "photo_distinterval",
    ]  # fmt: skip
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(head)
    for stop in flight.stops:
        none = ["-1", "0"] * (LITCHI_ACTIONS - 1)
        rows.writerow([
            f"{stop.latitude:.8f}", f"{stop.longitude:.8f}", f"{stop.height:g}",
            f"{stop.yaw % 360:g}", "0", "0", "2", "-90", "1" if stop.photo else "-1", "0", *none,
            "0", f"{flight.drone.speed_ms:g}", "0", "0", "0", "0", "-1", "-1",
        ])  # fmt: skip
    return text.getvalue().encode()


WRITERS: dict[Format, Writer] = {
    "qgc": Writer(ending=".plan", write=qgroundcontrol),
    "ardupilot": Writer(ending=".waypoints", write=ardupilot),
    "dji": Writer(ending=".kmz", write=dji, most=200),
    "litchi": Writer(ending=".csv", write=litchi, most=99),
}
