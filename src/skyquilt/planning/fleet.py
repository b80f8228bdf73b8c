"""Drones and their means: from a fleet.toml, or several alike."""

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from shapely import Point, union_all
from shapely.ops import nearest_points

from skyquilt.errors import SideFileError, UsageError
from skyquilt.outside import plain, read_bounded, real
from skyquilt.planning.records import FORMATS, Drone, Site, View
from skyquilt.planning.site import in_zone
from skyquilt.planning.view import find_view

MOST_DRONES = 50
"""Largest number of drones of a plan."""
MOST_BYTES = 1_000_000
_NUMBERS = {
    "endurance_min": (0.1, 6000.0),
    "reserve": (0.0, 0.9),
    "speed": (0.1, 100.0),
    "climb": (0.1, 50.0),
    "turn_radius": (0.0, 1000.0),
    "photo": (0.0, 120.0),
    "swap_min": (0.0, 600.0),
}
"""Numbers of a drone with their limits."""
_FIELDS = {
    "reserve": "reserve",
    "speed": "speed_ms",
    "climb": "climb_ms",
    "turn_radius": "turn_radius_m",
    "photo": "photo_s",
}
_KNOWN = {*_NUMBERS, "name", "start", "landing", "camera", "formats"}


def read_fleet(path: Path, crs: str, view: View | None) -> tuple[Drone, ...]:
    """The drones of a fleet.toml, in the zone of the plan; `view`: camera of those that name none.

    Raises:
        SideFileError: the file is malformed.
        UsageError: a drone has no camera.
    """
    path = Path(path)
    try:
        content = tomllib.loads(read_bounded(path, MOST_BYTES).decode("utf-8"))
    except OSError as error:
        raise SideFileError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise SideFileError(f"{path.name} is not TOML: {plain(str(error), 200)}") from error
    rows = content.get("drone")
    if not isinstance(rows, list) or not all(isinstance(r, dict) for r in rows) or not rows:
        raise SideFileError(f"{path.name} needs a table [[drone]] for each drone")
    if len(rows) > MOST_DRONES:
        raise SideFileError(f"{path.name} has {len(rows)} drones, and {MOST_DRONES} are the most")
    return tuple(_drone(path, k, row, crs, view) for k, row in enumerate(rows, 1))


def _drone(path: Path, number: int, row: Mapping[str, Any], crs: str, view: View | None) -> Drone:
    name = plain(str(row.get("name", f"drone {number}")), 60)
    unknown = sorted(plain(k, 40) for k in row if k not in _KNOWN)
    if unknown:
        raise SideFileError(
            f"{path.name}: {name} has '{unknown[0]}'; known are {', '.join(sorted(_KNOWN))}"
        )
    given: dict[str, Any] = {}
    for key, (low, high) in _NUMBERS.items():
        if key in row:
            value = real(row[key], low, high)
            if value is None:
                raise SideFileError(
                    f"{path.name}: {key} of {name} must be {low:g} to {high:g}, not"
                    f" '{plain(str(row[key]), 40)}'"
                )
            given[key] = value
    if "start" not in row:
        raise SideFileError(
            f"{path.name}: {name} has no start = {{latitude = ..., longitude = ...}}"
        )
    start = _place(path, name, row["start"], crs)
    own = find_view(str(row["camera"])) if "camera" in row else view
    if own is None:
        raise UsageError(f"{path.name}: {name} has no camera; give one, or --camera for all")
    drone = Drone(
        name=name,
        start=start,
        landing=_place(path, name, row["landing"], crs) if "landing" in row else start,
        view=own,
        formats=_formats(path, name, row.get("formats", list(FORMATS))),
        **{_FIELDS[k]: v for k, v in given.items() if k in _FIELDS},
    )
    if "endurance_min" in given:
        drone = replace(drone, endurance_s=60 * given["endurance_min"])
    return replace(drone, swap_s=60 * given["swap_min"]) if "swap_min" in given else drone


def _formats(path: Path, name: str, stated: Any) -> tuple[Any, ...]:
    if not isinstance(stated, list) or not stated or not set(map(str, stated)) <= set(FORMATS):
        raise SideFileError(
            f"{path.name}: formats of {name} are a list of {', '.join(FORMATS)}, not"
            f" {plain(str(stated), 80)}"
        )
    return tuple(f for f in FORMATS if f in stated)


def _place(path: Path, name: str, stated: Any, crs: str) -> tuple[float, float]:
    known = isinstance(stated, dict)
    latitude = real(stated.get("latitude"), -80, 84) if known else None
    longitude = real(stated.get("longitude"), -180, 180) if known else None
    if latitude is None or longitude is None:
        raise SideFileError(
            f"{path.name}: a place of {name} is {plain(str(stated), 80)}; expected"
            " {latitude = 52.1, longitude = 13.1}"
        )
    x, y = in_zone(crs, np.array([[longitude, latitude]]))[0]
    return float(x), float(y)


def start_at(text: str, crs: str) -> tuple[float, float]:
    """A place from `LATITUDE,LONGITUDE`; UsageError for anything else."""
    words = text.split(",")
    latitude = real(words[0], -80, 84)
    longitude = real(words[1], -180, 180) if len(words) == 2 else None
    if latitude is None or longitude is None:
        raise UsageError(f"--start takes LATITUDE,LONGITUDE such as 52.1,13.1, not '{plain(text)}'")
    x, y = in_zone(crs, np.array([[longitude, latitude]]))[0]
    return float(x), float(y)


def alike(
    site: Site,
    number: int,
    view: View,
    *,
    start: tuple[float, float] | None,
    clearance: float,
    separation: float,
) -> tuple[Drone, ...]:
    """Drones that start side by side, `separation` m apart, at a place or at the rim of the area
    nearest to its middle; each lands where it started.
    """
    if not 1 <= number <= MOST_DRONES:
        raise UsageError(f"--drones must be 1 to {MOST_DRONES}, not {number}")
    closed = union_all([k.shape.buffer(clearance + 1) for k in site.keep_out])
    if start is None:
        rim = site.observe.boundary.difference(closed)
        middle = site.observe.centroid
        at = nearest_points(rim, middle)[0] if not rim.is_empty else middle
        start = (at.x, at.y)
    apart = max(separation, 1.0) * 1.05
    places: list[tuple[float, float]] = []
    k = 0
    while len(places) < number:
        x = start[0] + apart * ((k + 1) // 2) * (1 if k % 2 else -1)
        # the first place is what was asked for, closed or not: that is told later
        if k == 0 or not closed.intersects(Point(x, start[1])) or k > 1000:
            places.append((x, start[1]))
        k += 1
    return tuple(
        Drone(name=f"drone {k}", start=p, landing=p, view=view) for k, p in enumerate(places, 1)
    )
