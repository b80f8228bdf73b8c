"""Missions of other programs: QGroundControl `.plan`, ArduPilot `.waypoints`, DJI `.kmz`."""

import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from defusedxml.ElementTree import fromstring

from skyquilt.errors import SideFileError
from skyquilt.outside import (
    MOST_TEXT_BYTES,
    open_regular,
    plain,
    read_bounded,
    real,
    unzipped,
    whole,
)
from skyquilt.planning.exports import CAMERA, CAPTURE, LAND, RETURN, TAKE_OFF, WAYPOINT
from skyquilt.planning.records import Array

DISTANCE = 206
"""MAVLink: photos by distance."""
MOST_ITEMS = 50_000
DEEPEST = 4
"""Nesting of items."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Mission:
    """What a file tells a drone to do."""

    places: Array
    """(n, 2) longitude and latitude along the way."""
    heights: Array
    """(n,) in m."""
    relative: bool
    """Heights count from the take-off place; otherwise from the sea."""
    yaws: Array
    """(n,) headings from true north in degrees; NaN where the file states none."""
    photos: Array
    """(k,) positions along the way at which photos are taken, counted in places: 2.5 is half way
    between the third and the fourth.
    """
    fence: tuple[Array, ...] = ()
    """Rings (n, 2), longitude and latitude, of places to keep out of."""
    home: tuple[float, float] | None = None
    """Longitude and latitude of the take-off place."""


@dataclass(frozen=True, kw_only=True)
class Item:
    """A MAVLink command."""

    command: int
    """Its number."""
    params: tuple[float, ...]
    """Seven; NaN where there is none."""
    relative: bool
    """Frame of the height."""


def read_mission(path: Path) -> Mission:
    """The way and the photos of a file; raises SideFileError where it cannot be used."""
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise SideFileError(
            f"{path.name}: a mission is plan.json or one of {', '.join(READERS)}, got"
            f" '{path.suffix}'"
        )
    try:
        mission = reader(path)
    except SideFileError as error:
        raise SideFileError(f"{path.name}: {error}") from error
    except OSError as error:
        raise SideFileError(f"{path} cannot be read: {error.strerror or error}") from error
    except Exception as error:  # a file from outside can be wrong in every place
        raise SideFileError(
            f"{path.name} is not a readable {path.suffix[1:]} file:"
            f" {plain(str(error), 200) or type(error).__name__}"
        ) from error
    if not len(mission.places):
        raise SideFileError(f"{path.name} holds no waypoint")
    return mission


def read_qgroundcontrol(path: Path) -> Mission:
    """A `.plan` of version 1, with the items of surveys."""
    record = json.loads(read_bounded(path).decode("utf-8-sig"))
    if record.get("fileType") != "Plan":
        raise ValueError("its fileType is not Plan")
    mission = record["mission"]
    items = _flat(mission.get("items", []), 0)
    home = mission.get("plannedHomePosition") or [None, None]
    latitude, longitude = real(home[0], -90, 90), real(home[1], -180, 180)
    fence = []
    for ring in (record.get("geoFence") or {}).get("polygons", [])[:MOST_ITEMS]:
        if not ring.get("inclusion", True):
            corners = [(_coordinate(q[1], 180), _coordinate(q[0], 90)) for q in ring["polygon"]]
            fence.append(np.array(corners, np.float64))
    return _followed(
        items,
        tuple(fence),
        None if latitude is None or longitude is None else (longitude, latitude),
    )


def _coordinate(value: Any, most: float) -> float:
    found = real(value, -most, most)
    if found is None:
        raise SideFileError(f"'{plain(str(value), 40)}' is no coordinate")
    return found


def _flat(items: Any, depth: int) -> list[Item]:
    """The simple items of a list, those inside surveys included."""
    if not isinstance(items, list) or len(items) > MOST_ITEMS or depth > DEEPEST:
        raise SideFileError(f"its items are no list of at most {MOST_ITEMS}")
    found: list[Item] = []
    for item in items:
        inner = item.get("TransectStyleComplexItem", item)
        if "Items" in inner:
            found += _flat(inner["Items"], depth + 1)
        elif item.get("type") == "SimpleItem":
            found.append(_simple(item))
    return found


def _simple(item: Mapping[str, Any]) -> Item:
    params = [real(p) if p is not None else None for p in item["params"][:7]]
    padded = [*params, *([None] * (7 - len(params)))]
    command = whole(item["command"], 0, 65535)
    if command is None:
        raise SideFileError("an item's command is no number")
    frame = whole(item.get("frame", 3), 0, 255)
    return Item(
        command=command,
        params=tuple(np.nan if p is None else p for p in padded),
        relative=frame in (3, 6, 10, 11),
    )


def read_waypoints(path: Path) -> Mission:
    """`QGC WPL 110` or 120: a line of twelve fields for each command."""
    lines = read_bounded(path).decode("utf-8-sig").splitlines()
    if not lines or not lines[0].startswith("QGC WPL"):
        raise ValueError("it does not begin with 'QGC WPL'")
    if len(lines) > MOST_ITEMS:
        raise SideFileError(f"it has more than {MOST_ITEMS} lines")
    items, home = [], None
    for line in lines[1:]:
        words = line.split()
        if not words:
            continue
        if len(words) < 12:
            raise SideFileError(f"a line has {len(words)} fields, not 12")
        numbers = [real(w, -1e10, 1e10) for w in words[:12]]
        if any(n is None for n in numbers):
            raise SideFileError(f"'{plain(line, 60)}' has a field that is no number")
        values = [float(n or 0.0) for n in numbers]
        item = Item(
            command=int(values[3]), params=tuple(values[4:11]), relative=values[2] in (3, 6, 10, 11)
        )
        if values[0] == 0 and not item.relative:
            home = (_coordinate(item.params[5], 180), _coordinate(item.params[4], 90))
        else:
            items.append(item)
    return _followed(items, (), home)


def _followed(
    items: list[Item], fence: tuple[Array, ...], home: tuple[float, float] | None
) -> Mission:
    """The way through a list of commands, and where on it photos are taken."""
    places: list[tuple[float, float]] = []
    heights: list[float] = []
    yaws: list[float] = []
    photos: list[float] = []
    spacing, relative = 0.0, True
    for item in items:
        p = item.params
        if item.command in (WAYPOINT, LAND, TAKE_OFF) and np.isfinite(p[4:6]).all():
            if p[4] == 0 and p[5] == 0:
                continue  # 'here'
            place = (_coordinate(p[5], 180), _coordinate(p[4], 90))
            if spacing > 0 and places:
                photos += _on_the_way(places[-1], place, len(places) - 1, spacing)
            places.append(place)
            heights.append(float(p[6]) if np.isfinite(p[6]) else 0.0)
            yaws.append(float(p[3]) if item.command == WAYPOINT and p[3] else np.nan)
            relative = item.relative
        elif item.command == DISTANCE:
            spacing = max(float(p[0]), 0.0) if np.isfinite(p[0]) else 0.0
            if p[2] == 1 and places:
                photos.append(len(places) - 1.0)
        elif item.command in (CAMERA, CAPTURE) and places:
            photos.append(len(places) - 1.0)
        elif item.command == RETURN:
            spacing = 0.0
        if len(photos) > MOST_ITEMS:
            raise SideFileError(f"it takes more than {MOST_ITEMS} photos")
    return Mission(
        places=np.array(places).reshape(-1, 2),
        heights=np.array(heights),
        relative=relative,
        yaws=np.array(yaws),
        photos=np.unique(photos),
        fence=fence,
        home=home,
    )


def _on_the_way(
    a: tuple[float, float], b: tuple[float, float], index: int, spacing: float
) -> list[float]:
    """Positions every `spacing` m between two places."""
    from pyproj import Geod

    length = float(Geod(ellps="WGS84").inv(*a, *b)[2])
    if length / spacing > MOST_ITEMS:
        raise SideFileError("its photos are too close")
    return [index + k * spacing / length for k in range(1, int(length / spacing) + 1)]


def read_wpml(path: Path) -> Mission:
    """DJI's `wpmz/waylines.wpml` inside a `.kmz`."""
    with open_regular(path) as file, zipfile.ZipFile(file) as archive:
        names = [n for n in archive.namelist() if n.lower().endswith("waylines.wpml")]
        if not names:
            raise ValueError("it holds no waylines.wpml")
        text = unzipped(archive, names[0], MOST_TEXT_BYTES)
    root = fromstring(text)
    places, heights, yaws, photos = [], [], [], []
    for mark in root.iterfind(".//{*}Placemark"):
        words = (mark.findtext("{*}Point/{*}coordinates") or "").strip().split(",")
        if len(words) < 2:
            raise SideFileError("a place has no coordinates")
        places.append((_coordinate(words[0], 180), _coordinate(words[1], 90)))
        heights.append(real(mark.findtext("{*}executeHeight"), -1000, 20_000) or 0.0)
        param = mark.find("{*}waypointHeadingParam")
        angle = None if param is None else param.findtext("{*}waypointHeadingAngle")
        used = param is not None and param.findtext("{*}waypointHeadingAngleEnable") == "1"
        yaw = real(angle, -360, 360)
        yaws.append(yaw if used and yaw is not None else np.nan)
        actions = {a.text for a in mark.iterfind(".//{*}actionActuatorFunc")}
        if "takePhoto" in actions:
            photos.append(len(places) - 1.0)
        if len(places) > MOST_ITEMS:
            raise SideFileError(f"it has more than {MOST_ITEMS} places")
    mode = root.findtext(".//{*}executeHeightMode")
    return Mission(
        places=np.array(places).reshape(-1, 2),
        heights=np.array(heights),
        relative=mode == "relativeToStartPoint",
        yaws=np.array(yaws),
        photos=np.array(photos),
    )


READERS: dict[str, Callable[[Path], Mission]] = {
    ".plan": read_qgroundcontrol,
    ".waypoints": read_waypoints,
    ".kmz": read_wpml,
}
