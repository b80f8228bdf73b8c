"""Checks a file: a plan of ours, or a mission of another program."""

from pathlib import Path

from shapely import MultiPoint

from skyquilt.alignment.priors import utm_epsg
from skyquilt.errors import UsageError
from skyquilt.planning.check import Verdict, check_mission, check_plan
from skyquilt.planning.missions import read_mission
from skyquilt.planning.plan_file import read_plan
from skyquilt.planning.site import in_zone, read_site
from skyquilt.planning.terrain import FLAT, read_terrain
from skyquilt.planning.view import find_view
from skyquilt.settings import within

AROUND_M = 300.0
"""Terrain is read so far around a mission."""


def check_file(
    path: Path,
    *,
    area: Path | None,
    camera: str | None,
    terrain: Path | None,
    views: int | None,
    width_m: float | None,
    clearance: float,
) -> Verdict:
    """Coverage and conflicts of a file.

    Raises:
        SideFileError, UsageError, RefusedError: a file cannot be used.
    """
    path = Path(path)
    within("--views", views, 1, 200)
    within("--width", width_m, 0.1, 100_000, "m")
    within("--clearance", clearance, 0, 1000, "m")
    if path.suffix.lower() == ".json":
        plan = read_plan(path)
        if terrain is None and plan.terrain:
            raise UsageError(f"{path.name} was planned on terrain; give it with --terrain")
        around = FLAT
        if terrain is not None:
            around = read_terrain(terrain, plan.site.crs, plan.site.observe, AROUND_M)
        return check_plan(plan, around, views)
    mission = read_mission(path)
    view = find_view(camera) if camera else None
    site = read_site(area, width_m=width_m) if area else None
    ground = FLAT
    if terrain is not None:
        crs = site.crs if site else utm_epsg(*mission.places.mean(axis=0)[::-1])
        hull = MultiPoint(in_zone(crs, mission.places)).convex_hull.buffer(1.0)
        ground = read_terrain(terrain, crs, hull, AROUND_M)
    return check_mission(mission, view, site, ground, views=views or 1, clearance=clearance)
