"""What a mission's photos will show: coverage, overlap, ground size, and conflicts."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from shapely import LineString, MultiPoint, Polygon

from skyquilt.alignment.priors import utm_epsg
from skyquilt.errors import RefusedError
from skyquilt.planning.coverage import Cuts, all_seen, make_cells, sight_may_be_blocked
from skyquilt.planning.flights import Surface, nearest
from skyquilt.planning.footprints import proof_of
from skyquilt.planning.lattice import to_uv
from skyquilt.planning.missions import Mission
from skyquilt.planning.plan_file import convergence
from skyquilt.planning.points import MOST_CUTS, Layout
from skyquilt.planning.records import Array, KeepOut, Plan, Proof, Site, View
from skyquilt.planning.site import in_zone, make_site
from skyquilt.planning.terrain import Terrain

PER_FOOTPRINT = 48
"""Cells along the shorter side of a footprint."""
MOST_SEEN = 60_000_000
"""Cells seen by all photos together beyond which cells are larger."""
INSIDE = 0.003
"""Cells end so far inside a photo, m: files round places to millimetres."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The result of a check."""

    photos: int
    """Number of photos."""
    proof: Proof | None
    """What they see of the area; None without a camera."""
    conflicts: tuple[str, ...]
    """Sentences on keep-outs, clearance, separation and endurance."""


def check_plan(plan: Plan, terrain: Terrain, views: int | None) -> Verdict:
    """Checks a plan against its own areas, or other ground."""
    xyz = np.array([p.xyz for p in plan.points]).reshape(-1, 3)
    yaw = np.array([p.yaw for p in plan.points])
    asked = views or (plan.proof.views if plan.proof else 1)
    clearance = float(plan.options.get("clearance_m") or 0.0)
    ways = [np.array([(w.x, w.y, w.z) for w in s.way]) for s in plan.sorties]
    conflicts = way_conflicts([w[1:-1] for w in ways], plan.site.keep_out, terrain, clearance)
    separation = float(plan.options.get("separation_m") or 0.0)
    for a, b in combinations(range(len(plan.drones)), 2):
        pair = [[s for s in plan.sorties if s.drone == k] for k in (a, b)]
        near = nearest(*pair)
        if near < separation - 0.5:
            conflicts.append(
                f"{plan.drones[a].name} and {plan.drones[b].name} come within {near:.1f} m; asked"
                f" for are {separation:g} m."
            )
    for s in plan.sorties:
        drone = plan.drones[s.drone]
        if s.seconds > drone.usable_s + 1:
            conflicts.append(
                f"{drone.name}, sortie {s.number}, flies {s.seconds / 60:.1f} min and may"
                f" {drone.usable_s / 60:.1f} min."
            )
    visited = {w.point for s in plan.sorties for w in s.way}
    lost = sum(p.id not in visited for p in plan.points)
    if lost:
        conflicts.append(f"{lost} picture-points are on no route.")
    view = plan.drones[0].view
    proof = _proof(plan.site, view, xyz, yaw, terrain, asked) if len(xyz) else None
    return Verdict(photos=len(xyz), proof=proof, conflicts=tuple(conflicts))


def check_mission(
    mission: Mission,
    view: View | None,
    site: Site | None,
    terrain: Terrain,
    *,
    views: int,
    clearance: float,
) -> Verdict:
    """Checks a mission of another program; without areas, the outline of its photos counts."""
    crs = site.crs if site else utm_epsg(*mission.places.mean(axis=0)[::-1])
    places = in_zone(crs, mission.places)
    start = in_zone(crs, np.array([mission.home]))[0] if mission.home else places[0]
    zero = float(terrain.at(start[0], start[1])) if mission.relative else 0.0
    way = np.column_stack([places, mission.heights + zero])
    fences = [in_zone(crs, ring) for ring in mission.fence if len(ring) > 2]
    closed = [KeepOut(shape=Polygon(r)) for r in fences if Polygon(r).is_valid]
    closed += site.keep_out if site else ()
    conflicts = way_conflicts([way], closed, terrain, clearance)
    if not len(mission.photos):
        conflicts.append("no photo is taken.")
    if view is None or not len(mission.photos):
        return Verdict(photos=len(mission.photos), proof=None, conflicts=tuple(conflicts))
    xyz, yaw = photos_of(mission, way, crs)
    if site is None:
        hull = MultiPoint(xyz[:, :2]).convex_hull
        site = make_site(hull if hull.geom_type == "Polygon" else hull.buffer(1.0), (), crs)
    return Verdict(
        photos=len(xyz),
        proof=_proof(site, view, xyz, yaw, terrain, views),
        conflicts=tuple(conflicts),
    )


def photos_of(mission: Mission, way: Array, crs: str) -> tuple[Array, Array]:
    """Places (k, 3) and grid headings (k,) of a mission's photos; without a stated heading the
    picture's top points along the way.
    """
    at = np.arange(len(way))
    xyz = np.column_stack([np.interp(mission.photos, at, way[:, k]) for k in range(3)])
    after = np.minimum(mission.photos.astype(np.int64), len(way) - 2)
    if len(way) > 1:
        step = way[after + 1] - way[after]
        course = np.degrees(np.arctan2(step[:, 0], step[:, 1]))
    else:
        course = np.zeros(len(xyz))
    stated = mission.yaws[np.minimum(np.rint(mission.photos).astype(np.int64), len(way) - 1)]
    turned = stated - convergence(crs, xyz[:, :2])
    return xyz, np.where(np.isfinite(stated), turned, course)


def _proof(site: Site, view: View, xyz: Array, yaw: Array, terrain: Terrain, views: int) -> Proof:
    heights = xyz[:, 2] - terrain.at(xyz[:, 0], xyz[:, 1])
    if not (heights > 0.5).all():
        raise RefusedError(
            f"{int((heights <= 0.5).sum())} photos would be taken on or below the ground; give the"
            " terrain of the place, or a mission with other heights"
        )
    wide, short = sorted((view.along, view.across), reverse=True)
    finest = min(PER_FOOTPRINT, float(np.sqrt(MOST_SEEN / len(xyz) * short / wide)))
    high = float(np.median(heights))
    size = max(high * short / finest, float(np.sqrt(site.observe.area / 2e6)))
    cuts = _window_edges(view, xyz, yaw) if not terrain.known else ((), ())
    cells = make_cells(site.observe, float(yaw[0]), size, terrain, cuts)
    blocked = sight_may_be_blocked(view, terrain)
    seen = all_seen(cells, view, xyz, yaw, blocked=blocked)
    apart = np.abs((np.diff(yaw) + 90) % 180 - 90) > 20
    layout = Layout(xyz=xyz, yaw=yaw, run=np.concatenate([[0], np.cumsum(apart)]),
                    seen=tuple(seen))  # fmt: skip
    return proof_of(cells, view, layout, views, 0.0)


def _window_edges(view: View, xyz: Array, yaw: Array) -> Cuts:
    """Edges of what photos of the first one's heading see of flat ground: cells that end just
    inside them lose nothing.
    """
    same = np.abs((yaw - yaw[0] + 180) % 360 - 180) < 0.01
    (u, v), h = to_uv(xyz[same, :2], float(yaw[0])).T, xyz[same, 2]
    ends = [
        np.unique(np.round(np.concatenate([a, b]), 3))
        for a, b in (
            (u - view.down * h + INSIDE, u + view.up * h - INSIDE),
            (v - view.left * h + INSIDE, v + view.right * h - INSIDE),
        )
    ]
    return (
        (ends[0].tolist(), ends[1].tolist())
        if len(ends[0]) * len(ends[1]) < MOST_CUTS
        else ((), ())
    )


def way_conflicts(
    ways: Sequence[Array], closed: Sequence[KeepOut], terrain: Terrain, clearance: float
) -> list[str]:
    """Sentences on ways (n, 3) that meet keep-out areas or come too close to the surface."""
    found = []
    for number, place in enumerate(closed, 1):
        top = np.inf if place.ceiling_m is None else terrain.highest(place.shape) + place.ceiling_m
        met = sum(_enters(way, place, top) for way in ways)
        if met:
            name = place.name or f"keep-out area {number}"
            found.append(f"{met} way{'s' * (met > 1)} enter{'s' * (met == 1)} {name}.")
    if terrain.known:
        surface = Surface(terrain=terrain, low=(), clearance=0.0)
        least = min((_least_height(way, surface) for way in ways if len(way) > 1), default=np.inf)
        if least < clearance - 0.5:
            found.append(
                f"a way comes within {least:.1f} m of the surface; asked for are {clearance:g} m."
            )
    return found


def _enters(way: Array, place: KeepOut, top: float) -> bool:
    if len(way) < 2:
        return False
    for a, b in pairwise(way):
        if min(a[2], b[2]) < top and LineString([a[:2], b[:2]]).intersects(place.shape):
            if not np.isfinite(top):
                return True
            inside = LineString([a, b]).intersection(place.shape)
            heights = [c[2] for c in np.array(
                [p for g in getattr(inside, "geoms", [inside]) for p in g.coords]
            ).reshape(-1, 3)]  # fmt: skip
            if heights and min(heights) < top:
                return True
    return False


def _least_height(way: Array, surface: Surface) -> float:
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way[:, :2], axis=0).T))])
    at = np.unique(np.concatenate([np.linspace(0, s[-1], min(int(s[-1] / 2) + 2, 20_000)), s]))
    x, y, z = (np.interp(at, s, way[:, k]) for k in range(3))
    return float((z - surface.least(np.column_stack([x, y]))).min())
