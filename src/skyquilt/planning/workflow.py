"""From an area to a folder of plans."""

import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from skyquilt.engine.folder import check_room, claimed
from skyquilt.errors import UsageError
from skyquilt.model.event import Event, Note, Result, StageFinished, StageStarted
from skyquilt.planning.coverage import all_seen, counted, make_cells, sight_may_be_blocked
from skyquilt.planning.exports import WRITERS, write_missions
from skyquilt.planning.fill import follow_up
from skyquilt.planning.fleet import alike, read_fleet, start_at
from skyquilt.planning.kml import write_kml
from skyquilt.planning.missing import is_mission, is_run, missing_site, read_mission_state
from skyquilt.planning.page import write_plan_page
from skyquilt.planning.plan_file import write_plan
from skyquilt.planning.points import height_of, place_points
from skyquilt.planning.records import Drone, Plan, Site, View
from skyquilt.planning.routes import plan_routes
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.site import read_site
from skyquilt.planning.stops import flights_of
from skyquilt.planning.terrain import FLAT, Terrain, read_terrain
from skyquilt.planning.view import find_view, narrowest
from skyquilt.raster.older_map import older_map
from skyquilt.raster.vector import lines, points
from skyquilt.typed import typed

FILES = ("plan.json", "points.geojson", "routes.geojson", "plan.kml", "plan.html")
"""Files of a plan, besides those of the drones."""
WASTED = 0.1
"""Share of ground by which a camera has to see more than all have in common, to be told."""


@dataclass(frozen=True, kw_only=True)
class Order:
    """What a plan is made from."""

    area: Path
    """File with areas, or the folder of a run."""
    settings: PlanSettings
    """Options."""
    camera: str | None = None
    """Model, calibration or photo."""
    keep_out: Path | None = None
    """File with places to keep out of."""
    terrain: Path | None = None
    """Heights."""
    drones: int = 1
    """Number of drones alike, where there is no fleet."""
    start: str | None = None
    """Where they start: latitude,longitude."""
    fleet: Path | None = None
    """fleet.toml."""
    base: Path | None = None
    """An old map under the plan's page."""

    def __post_init__(self) -> None:
        typed(self)


def iter_plan(order: Order, output: Path, *, overwrite: bool = False) -> Iterator[Event]:
    """Plans and writes all files; the last event is the Result.

    Raises:
        UsageError, SideFileError, RefusedError, OutputError: one sentence each.
    """
    output = Path(output)
    if order.base is not None:
        older_map(order.base)  # refused before the routes are planned
    check_room(output, _names(output), overwrite=overwrite)
    if is_mission(order.area):
        yield from refilled(order, output, overwrite=overwrite)
        return
    settings = order.settings.checked()
    if is_run(order.area):
        site = missing_site(order.area, settings.views or 1, keep_out=order.keep_out)
    else:
        site = read_site(order.area, keep_out=order.keep_out, width_m=settings.width_m)
    drones, view = fleet_of(order, site)
    yield from planned(order, site, drones, view, output, overwrite=overwrite)


def refilled(order: Order, output: Path, *, overwrite: bool) -> Iterator[Event]:
    """The follow-up of a live map that knows its plan, by what its photos show so far."""
    yield StageStarted(stage="routes", total=0)
    begun, cpu = time.monotonic(), time.process_time()
    mission = read_mission_state(order.area)
    site = mission.plan.site
    terrain = FLAT
    if order.terrain is not None:
        terrain = read_terrain(order.terrain, site.crs, site.observe, 500)
    plan = follow_up(mission.plan, mission.cover, mission.counts, mission.again, terrain)
    yield StageFinished(
        stage="routes", seconds=time.monotonic() - begun, cpu_seconds=time.process_time() - cpu,
        reused=False,
    )  # fmt: skip
    for text in plan.warnings:
        yield Note(text=text, warning=True)
    view = plan.drones[0].view
    size = plan.proof.cell_m if plan.proof else 1.0
    cells = make_cells(site.observe, plan.points[0].yaw, 2 * size, FLAT)
    xyz = np.array([(p.x, p.y, p.z - p.ground) for p in plan.points])
    seen = all_seen(cells, view, xyz, np.array([p.yaw for p in plan.points]), blocked=False)
    before = mission.at(cells.centres(np.arange(cells.inside.size))[:, :2])
    with _room(output, overwrite):
        names = write_all(output, plan)
        write_plan_page(
            output / "plan.html", plan, cells, counted(cells, seen) + before, order.base
        )
    yield Result(output=output, metrics=summary_of(plan, names))


def fleet_of(order: Order, site: Site) -> tuple[tuple[Drone, ...], View]:
    """The drones, and the camera for which points are planned."""
    view = find_view(order.camera) if order.camera else None
    if order.fleet is not None:
        drones = read_fleet(order.fleet, site.crs, view)
        return drones, narrowest([d.view for d in drones])
    if view is None:
        raise UsageError(
            "no camera is known; give --camera (a model such as FC6310, a cameras.json or a photo)"
        )
    settings = order.settings
    start = start_at(order.start, site.crs) if order.start else None
    drones = alike(site, order.drones, view, start=start, clearance=settings.clearance_m,
                   separation=settings.separation_m)  # fmt: skip
    return drones, view


def planned(
    order: Order, site: Site, drones: Sequence[Drone], view: View, output: Path, *, overwrite: bool
) -> Iterator[Event]:
    """Plans a site and writes all files."""
    begun, cpu = time.monotonic(), time.process_time()
    height = height_of(order.settings, view)
    terrain = terrain_of(order, site, drones, height, view)
    yield StageStarted(stage="points", total=0)
    found, proof, warnings, cells = place_points(site, view, order.settings, terrain)
    yield StageFinished(
        stage="points", seconds=time.monotonic() - begun, cpu_seconds=time.process_time() - cpu,
        reused=False,
    )  # fmt: skip
    begun, cpu = time.monotonic(), time.process_time()
    yield StageStarted(stage="routes", total=0)
    routes = plan_routes(site, found, drones, order.settings, terrain, height)
    yield StageFinished(
        stage="routes", seconds=time.monotonic() - begun, cpu_seconds=time.process_time() - cpu,
        reused=False,
    )  # fmt: skip
    plan = Plan(
        site=site,
        drones=tuple(drones),
        points=found,
        sorties=routes.sorties,
        options={**asdict(order.settings), "camera": view.name, "flown_m": round(height, 3)},
        terrain=terrain.known,
        proof=proof,
        bound_s=routes.bound_s,
        warnings=(*warnings, *routes.warnings, *_of_mixed_cameras(drones, view)),
    )
    for text in plan.warnings:
        yield Note(text=text, warning=True)
    xyz = np.array([p.xyz for p in found])
    yaw = np.array([p.yaw for p in found])
    seen = all_seen(cells, view, xyz, yaw, blocked=sight_may_be_blocked(view, terrain))
    with _room(output, overwrite):
        names = write_all(output, plan)
        write_plan_page(output / "plan.html", plan, cells, counted(cells, seen), order.base)
    yield Result(output=output, metrics=summary_of(plan, names))


def _of_mixed_cameras(drones: Sequence[Drone], view: View) -> list[str]:
    """What it costs that points are planned for the view that all cameras share."""
    common = view.along * view.across
    told = []
    for own in {d.view.name: d.view for d in drones}.values():
        more = own.along * own.across / common - 1
        if more > WASTED:
            told.append(
                f"points are planned for what all cameras see; {own.name} alone would need"
                f" {100 * more / (1 + more):.0f} % fewer photos: plan an area of its own for it if"
                " that matters."
            )
    return told


def terrain_of(
    order: Order, site: Site, drones: Sequence[Drone], height: float, view: View
) -> Terrain:
    """The terrain around the area and the starts."""
    if order.terrain is None:
        return FLAT
    from shapely import MultiPoint

    starts = MultiPoint([p for d in drones for p in (d.start, d.landing)])
    reach = site.observe.distance(starts) + np.hypot(
        *np.subtract(starts.bounds[2:], starts.bounds[:2])
    )
    return read_terrain(
        order.terrain, site.crs, site.observe, 2 * height * view.reach + float(reach) + 50
    )


def _room(output: Path, overwrite: bool) -> AbstractContextManager[None]:
    """The prepared folder; with `overwrite`, only files of an earlier plan are removed."""
    return claimed(output, _names(output), overwrite=overwrite)


def _names(output: Path) -> tuple[str, ...]:
    """Files of a plan, with those of the drones of an earlier one."""
    endings = {w.ending for w in WRITERS.values()}
    try:
        old = [p.name for p in output.glob("[0-9][0-9]-*") if p.suffix in endings]
    except OSError:  # the folder is none, which is told when it is to be written
        old = []
    return (*FILES, *old)


def write_all(output: Path, plan: Plan) -> list[str]:
    """All files but the page; returns the names of those for ground stations."""
    write_plan(output / "plan.json", plan)
    crs = plan.site.crs
    drone_of = {w.point: s for s in plan.sorties for w in s.way if w.point is not None}
    points(
        output / "points.geojson",
        [
            (p.xyz, {"id": p.id, "yaw_deg": p.yaw, "height_m": p.z - p.ground,
                     "drone": plan.drones[drone_of[p.id].drone].name if p.id in drone_of else None,
                     "sortie": drone_of[p.id].number if p.id in drone_of else None})
            for p in plan.points
        ],
        crs=crs,
    )  # fmt: skip
    lines(
        output / "routes.geojson",
        [
            ([(w.x, w.y, w.z) for w in s.way],
             {"drone": plan.drones[s.drone].name, "sortie": s.number, "photos": s.photos,
              "starts_s": s.way[0].time_s, "seconds": s.seconds, "metres": s.metres})
            for s in plan.sorties
        ],
        crs=crs,
    )  # fmt: skip
    write_kml(output / "plan.kml", plan, flights_of(plan))
    return write_missions(output, plan)


def summary_of(plan: Plan, names: Sequence[str]) -> dict[str, object]:
    """Figures of a plan."""
    return {
        "points": len(plan.points),
        "drones": len(plan.drones),
        "sorties": len(plan.sorties),
        "seconds": plan.seconds,
        "bound_s": plan.bound_s,
        "proof": asdict(plan.proof) if plan.proof else None,
        "files": list(names),
        "warnings": list(plan.warnings),
    }
