"""plan.json: the whole plan, written and read. docs/planning.md states its schema."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from shapely import get_coordinates, transform
from shapely.geometry import mapping
from shapely.geometry import shape as from_geojson
from shapely.geometry.base import BaseGeometry

from skyquilt.errors import SideFileError
from skyquilt.outside import plain, read_bounded, real, whole
from skyquilt.planning.records import (
    FORMATS,
    Drone,
    KeepOut,
    PicturePoint,
    Plan,
    Proof,
    Site,
    Sortie,
    View,
    Waypoint,
)
from skyquilt.planning.site import geographic, in_zone
from skyquilt.raster.atomic import write_text
from skyquilt.version import __version__

SCHEMA = 1
"""Version of the schema."""
MOST_POINTS = 50_000
"""Largest number of points and of places of a route that are read."""
MOST_HEIGHT = 20_000.0


def write_plan(path: Path, plan: Plan) -> None:
    """Writes plan.json."""
    write_text(path, json.dumps(as_record(plan), allow_nan=False, ensure_ascii=False) + "\n")


def as_record(plan: Plan) -> dict[str, Any]:
    """The plan as JSON."""
    crs = plan.site.crs
    return {
        "skyquilt_plan": SCHEMA,
        "version": __version__,
        "crs": crs,
        "origin": list(plan.site.origin),
        "heights": "sea level" if plan.terrain else "flat ground",
        "options": dict(plan.options),
        "area": _geometry(plan.site.observe, crs),
        "keep_out": [
            {"name": k.name, "ceiling_m": k.ceiling_m, "geometry": _geometry(k.shape, crs)}
            for k in plan.site.keep_out
        ],
        "drones": [_drone(d, crs) for d in plan.drones],
        "points": [
            {"id": p.id, "longitude": lon, "latitude": lat, "z": round(p.z, 3),
             "ground": round(p.ground, 3), "yaw_deg": round(p.yaw + turn, 3) % 360}
            for p, (lon, lat), turn in zip(plan.points, _places(crs, plan.points),
                                           _turns(crs, plan.points), strict=True)
        ],
        "sorties": [
            {
                "drone": s.drone,
                "number": s.number,
                "way": [
                    [lon, lat, round(w.z, 3), round(w.time_s, 2), w.point]
                    for w, (lon, lat) in zip(s.way, _places(crs, s.way), strict=True)
                ],
            }
            for s in plan.sorties
        ],
        "seconds": round(plan.seconds, 1),
        "bound_s": round(plan.bound_s, 1),
        "proof": asdict(plan.proof) if plan.proof else None,
        "warnings": list(plan.warnings),
    }  # fmt: skip


def _places(crs: str, items: Any) -> list[list[float]]:
    if not len(items):
        return []
    found = geographic(crs, np.array([(i.x, i.y) for i in items]))
    return [[lon, lat] for lon, lat in np.round(found, 9).tolist()]


def _turns(crs: str, points: Any) -> list[float]:
    """What turns headings in the zone to those from true north, which files have, degrees."""
    return list(convergence(crs, np.array([(p.x, p.y) for p in points]).reshape(-1, 2)))


def convergence(crs: str, xy: np.ndarray) -> np.ndarray:
    """Meridian convergence (n,) in degrees at places (n, 2): true heading = grid heading + it."""
    from pyproj import CRS, Proj

    if not len(xy):
        return np.zeros(0)
    places = geographic(crs, xy)
    factors = Proj(CRS(crs)).get_factors(places[:, 0], places[:, 1])
    return np.asarray(factors.meridian_convergence, np.float64)


def _geometry(shape: BaseGeometry, crs: str) -> dict[str, Any]:
    turned = transform(shape, lambda xy: np.round(geographic(crs, xy), 9))
    return dict(mapping(turned))


def _drone(drone: Drone, crs: str) -> dict[str, Any]:
    record = asdict(drone)
    for key in ("start", "landing"):
        record[key] = np.round(geographic(crs, np.array([record[key]]))[0], 9).tolist()
    return record


def read_plan(path: Path) -> Plan:
    """Reads plan.json.

    Raises:
        SideFileError: it is no plan, or holds values that cannot be meant.
    """
    path = Path(path)
    try:
        return from_record(json.loads(read_bounded(path).decode("utf-8")))
    except OSError as error:
        raise SideFileError(f"{path} cannot be read: {error.strerror or error}") from error
    except SideFileError as error:
        raise SideFileError(f"{path.name}: {error}") from error
    except Exception as error:  # a file from outside can be wrong in every place
        raise SideFileError(
            f"{path.name} is not a plan of Skyquilt: {plain(str(error), 200)}"
        ) from error


def from_record(record: Mapping[str, Any]) -> Plan:
    """The plan of a JSON record; any exception where it is malformed."""
    if not isinstance(record, Mapping) or record.get("skyquilt_plan") != SCHEMA:
        raise SideFileError(f"it is no plan of version {SCHEMA}")
    crs = str(record["crs"])
    if not (len(crs) == 10 and crs.startswith(("EPSG:326", "EPSG:327")) and whole(crs[8:], 1, 60)):
        raise SideFileError(f"its zone '{plain(crs, 40)}' is no UTM zone")
    if max(len(record["points"]), sum(len(s["way"]) for s in record["sorties"])) > MOST_POINTS:
        raise SideFileError(f"it has more than {MOST_POINTS} points")
    site = Site(
        crs=crs,
        origin=(_number(record["origin"][0]), _number(record["origin"][1])),
        observe=_area(record["area"], crs),
        keep_out=tuple(
            KeepOut(
                shape=_area(k["geometry"], crs),
                ceiling_m=None if k["ceiling_m"] is None else _number(k["ceiling_m"]),
                name=plain(str(k["name"]), 200),
            )
            for k in record["keep_out"]
        ),
    )
    drones = tuple(_read_drone(d, crs) for d in record["drones"])
    points = _read_points(record["points"], crs)
    return Plan(
        site=site,
        drones=drones,
        points=points,
        sorties=tuple(_sortie(s, crs, len(drones), {p.id for p in points})
                      for s in record["sorties"]),
        options={str(k): v for k, v in record["options"].items()
                 if v is None or isinstance(v, int | float | str)},
        terrain=record["heights"] == "sea level",
        proof=None if record["proof"] is None else _proof(record["proof"]),
        bound_s=_number(record["bound_s"]),
        warnings=tuple(plain(str(w), 400) for w in record["warnings"]),
    )  # fmt: skip


def _number(value: Any, low: float = -1e8, high: float = 1e8) -> float:
    found = real(value, low, high) if not isinstance(value, str) else None
    if found is None:
        raise SideFileError(f"'{plain(str(value), 40)}' is no number from {low:g} to {high:g}")
    return found


def _index(value: Any, low: int, high: int) -> int:
    found = whole(value, low, high) if not isinstance(value, str) else None
    if found is None:
        raise SideFileError(f"'{plain(str(value), 40)}' is no number from {low} to {high}")
    return found


def _area(geometry: Any, crs: str) -> Any:
    shape = from_geojson(geometry)
    if shape.geom_type not in ("Polygon", "MultiPolygon") or shape.is_empty:
        raise SideFileError("an area is no polygon")
    places = get_coordinates(shape)
    if len(places) > 200_000 or not np.isfinite(places).all() or (np.abs(places) > 180).any():
        raise SideFileError("an area has places that are nowhere")
    return transform(shape, lambda xy: in_zone(crs, xy))


def _read_drone(record: Mapping[str, Any], crs: str) -> Drone:
    view = record["view"]
    tangents = {k: _number(view[k], 1e-3, 10) for k in ("left", "right", "up", "down")}
    numbers = ("endurance_s", "reserve", "speed_ms", "climb_ms", "turn_radius_m", "photo_s",
               "swap_s")  # fmt: skip
    places = in_zone(crs, np.array([[_number(v, -180, 180) for v in record[k]]
                                    for k in ("start", "landing")]))  # fmt: skip
    return Drone(
        name=plain(str(record["name"]), 60),
        start=(float(places[0, 0]), float(places[0, 1])),
        landing=(float(places[1, 0]), float(places[1, 1])),
        view=View(name=plain(str(view["name"]), 120),
            width=_index(view["width"], 1, 10**6),
            height=_index(view["height"], 1, 10**6),
            focal=_number(view["focal"], 1, 1e7),
            **tangents,
        ),
        formats=tuple(f for f in FORMATS if f in record["formats"]),
        **{k: _number(record[k], 0, 1e6) for k in numbers},
    )  # fmt: skip


def _read_points(records: Any, crs: str) -> tuple[PicturePoint, ...]:
    if not records:
        return ()
    places = [[_number(r["longitude"], -180, 180), _number(r["latitude"], -90, 90)]
              for r in records]  # fmt: skip
    xy = in_zone(crs, np.array(places))
    turn = convergence(crs, xy)
    ids = [_index(r["id"], 1, 10**9) for r in records]
    if len(set(ids)) < len(ids):
        raise SideFileError("two points have the same id")
    return tuple(
        PicturePoint(
            id=k, x=x, y=y, z=_number(r["z"], -MOST_HEIGHT, MOST_HEIGHT),
            ground=_number(r["ground"], -MOST_HEIGHT, MOST_HEIGHT),
            yaw=(_number(r["yaw_deg"], -1e4, 1e4) - t) % 360,
        )
        for k, r, (x, y), t in zip(ids, records, xy.tolist(), turn.tolist(), strict=True)
    )  # fmt: skip


def _sortie(record: Mapping[str, Any], crs: str, drones: int, ids: set[int]) -> Sortie:
    rows = record["way"]
    if len(rows) < 2:
        raise SideFileError("a sortie has no way")
    xy = in_zone(crs, np.array([[_number(r[0], -180, 180), _number(r[1], -90, 90)]
                                for r in rows]))  # fmt: skip
    way = tuple(
        Waypoint(x=x, y=y, z=_number(r[2], -MOST_HEIGHT, MOST_HEIGHT),
                 time_s=_number(r[3], 0, 1e8), point=r[4] if r[4] in ids else None)
        for r, (x, y) in zip(rows, xy.tolist(), strict=True)
    )  # fmt: skip
    return Sortie(drone=_index(record["drone"], 0, drones - 1),
                  number=_index(record["number"], 1, 10**6), way=way)  # fmt: skip


def _proof(record: Mapping[str, Any]) -> Proof:
    names = ("cell_m", "median", "missing_m2", "closed_m2", "overlap")
    return Proof(
        **{k: _number(record[k]) for k in names},
        views=_index(record["views"], 0, 2**31),
        cells=_index(record["cells"], 0, 2**31),
        least=_index(record["least"], 0, 2**31),
        gsd_cm=(_number(record["gsd_cm"][0]), _number(record["gsd_cm"][1])),
    )
