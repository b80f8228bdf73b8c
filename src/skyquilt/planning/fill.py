"""A follow-up plan: the fewest points that close what a flight has left open."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree
from shapely import contains_xy, prepare, union_all
from shapely.geometry.base import BaseGeometry

from skyquilt.errors import RefusedError
from skyquilt.planning.footprints import outlines
from skyquilt.planning.ground_cover import Cover, to_mercator
from skyquilt.planning.points import is_shut
from skyquilt.planning.records import Array, PicturePoint, Plan, View
from skyquilt.planning.repair import added
from skyquilt.planning.routes import plan_routes
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.terrain import FLAT, Terrain

SURE = 0.9
"""Share of its picture that a new photo is counted on for: drones miss their places a little."""
MOST_CANDIDATES = 6000
MOST_ROWS = 400
"""Of the ground that is interpolated between the points of a plan."""
CLOSER = 0.35
"""Distance of further candidates, in shares of a footprint."""


def settings_of(plan: Plan) -> PlanSettings:
    """The options that a plan was made with."""
    names = PlanSettings.__dataclass_fields__
    return PlanSettings(**{k: v for k, v in plan.options.items() if k in names})  # type: ignore[arg-type]


def follow_up(
    plan: Plan,
    cover: Cover,
    counts: NDArray[np.int32],
    again: Collection[int],
    terrain: Terrain | None = None,
) -> Plan:
    """A plan for the cells with too few views; `again`: ids of points that gave no sharp photo,
    which are flown first.

    Raises:
        RefusedError: nothing is missing. Others as for `plan_routes`.
    """
    views = plan.proof.views if plan.proof else 1
    lack = np.where(cover.inside, np.maximum(views - counts, 0), 0).ravel().astype(np.int32)
    if not lack.any():
        raise RefusedError(f"nothing is missing: every cell has {views} views")
    settings, ground = settings_of(plan), terrain or FLAT
    if plan.terrain and not ground.known:
        ground = terrain_below(plan)
    height = float(np.median([p.z - p.ground for p in plan.points]))
    lost = [p for p in plan.points if p.id in set(again)]
    more = _around(plan, cover, lack, height, ground, settings)
    chosen = _chosen(plan, cover, lack, [*lost, *more], ground)
    points = tuple(replace(p, id=k) for k, p in enumerate(chosen, 1))
    routes = plan_routes(plan.site, points, plan.drones, settings, ground, height)
    left = _left(plan, cover, lack, chosen, ground)
    missing = float((left > 0).sum()) * cover.ground_m**2
    total = counts.ravel()[cover.inside.ravel()]
    proof = plan.proof
    if proof is not None:
        least = int(total.min(initial=views)) if missing else views
        proof = replace(proof, missing_m2=missing, least=least)
    told = () if not missing else (f"{missing:.0f} m2 cannot be closed from open places.",)
    return replace(
        plan, points=points, sorties=routes.sorties, bound_s=routes.bound_s,
        proof=proof, warnings=(*routes.warnings, *told),
    )  # fmt: skip


def _around(
    plan: Plan,
    cover: Cover,
    lack: NDArray[np.int32],
    height: float,
    terrain: Terrain,
    settings: PlanSettings,
) -> list[PicturePoint]:
    """Places around cells that lack views, where no keep-out area is near."""
    view = plan.drones[0].view
    rows, columns = np.divmod(np.flatnonzero(lack), cover.inside.shape[1])
    back = Transformer.from_crs("EPSG:3857", plan.site.crs, always_xy=True)
    x, y = back.transform(
        cover.west + (columns + 0.5) * cover.cell, cover.north - (rows + 0.5) * cover.cell
    )
    step = CLOSER * height * min(view.along, view.across)
    near = np.unique(np.round(np.column_stack([x, y]) / step), axis=0)
    a, b = np.meshgrid([-1, 0, 1], [-1, 0, 1])
    around = np.column_stack([a.ravel(), b.ravel()])
    while len(near) * 9 > MOST_CANDIDATES:
        near = near[::2]
    xy = np.unique((near[:, None] + around[None]).reshape(-1, 2), axis=0) * step
    shut = [k for k in plan.site.keep_out if is_shut(k, terrain, height, settings.clearance_m)]
    closed: BaseGeometry = union_all([k.shape.buffer(settings.clearance_m + 0.1) for k in shut])
    prepare(closed)
    xy = xy[~contains_xy(closed, xy[:, 0], xy[:, 1])]
    ground = terrain.at(xy[:, 0], xy[:, 1])
    yaw = plan.points[0].yaw
    return [
        PicturePoint(id=0, x=float(px), y=float(py), z=float(g) + height, ground=float(g), yaw=yaw)
        for (px, py), g in zip(xy, ground, strict=True)
    ]


def terrain_below(plan: Plan) -> Terrain:
    """The ground below the points of a plan, interpolated between them: for where the file of the
    heights is not at hand. Beyond them it goes on as between the nearest.
    """
    xy = np.array([(p.x, p.y) for p in plan.points])
    z = np.array([p.ground for p in plan.points])
    apart = float(np.median(cKDTree(xy).query(xy, k=2)[0][:, 1])) if len(xy) > 1 else 20.0
    margin = 4 * apart
    (west, south), (east, north) = xy.min(axis=0) - margin, xy.max(axis=0) + margin
    cell = max(apart / 4, max(east - west, north - south) / MOST_ROWS)
    x = west + cell * (np.arange(int((east - west) / cell) + 2) + 0.5)
    y = north - cell * (np.arange(int((north - south) / cell) + 2) + 0.5)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    kernel = "thin_plate_spline" if len(xy) > 3 else "linear"
    smooth = RBFInterpolator(xy, z, neighbors=min(len(xy), 40), kernel=kernel,
                             degree=1 if len(xy) > 3 else 0)  # fmt: skip
    try:
        heights = smooth(places)
    except np.linalg.LinAlgError:  # all points on one line
        heights = z[cKDTree(xy).query(places)[1]]
    heights = np.clip(heights, z.min() - margin, z.max() + margin)
    return Terrain(heights=heights.reshape(len(y), len(x)).astype(np.float32), west=float(west),
                   north=float(north), cell=cell, known=True)  # fmt: skip


def _prints(plan: Plan, points: list[PicturePoint], terrain: Terrain) -> Array:
    """Footprints (n, 4, 2) in the zone, on the terrain."""
    view = plan.drones[0].view
    sure = View(**{**vars(view), **{k: SURE * getattr(view, k)
                                    for k in ("left", "right", "up", "down")}})  # fmt: skip
    above = 0.0 if terrain.known else 1.0
    xyz = np.array([(p.x, p.y, p.z - above * p.ground) for p in points])
    return outlines(sure, xyz, np.array([p.yaw for p in points]), terrain)


def _chosen(
    plan: Plan,
    cover: Cover,
    lack: NDArray[np.int32],
    candidates: list[PicturePoint],
    terrain: Terrain,
) -> list[PicturePoint]:
    """The candidates that close most; points of the plan win where both are as good."""
    rings = _prints(plan, candidates, terrain)
    seen = [cover.seen(to_mercator(ring, plan.site.crs)) for ring in rings]
    take = added(seen, lack)
    return [p for p, t in zip(candidates, take, strict=True) if t]


def _left(
    plan: Plan, cover: Cover, lack: NDArray[np.int32], points: list[PicturePoint], terrain: Terrain
) -> NDArray[np.int32]:
    """Views that cells will lack after the follow-up."""
    left = lack.copy()
    for ring in _prints(plan, points, terrain):
        left[cover.seen(to_mercator(ring, plan.site.crs))] -= 1
    return left
