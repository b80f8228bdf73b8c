"""'Fly what is missing here': the part of a finished run or a live map that too few photos see."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import Transformer
from rasterio.features import shapes
from shapely import transform, union_all
from shapely.geometry import shape as from_geojson
from shapely.geometry.base import BaseGeometry

from skyquilt.alignment.priors import utm_epsg
from skyquilt.errors import RefusedError, SideFileError
from skyquilt.outside import read_bounded
from skyquilt.planning.ground_cover import OUTSIDE, Cover, cover_of, to_mercator
from skyquilt.planning.plan_file import read_plan
from skyquilt.planning.points import is_shut
from skyquilt.planning.records import Plan, Site
from skyquilt.planning.site import geographic, make_site, read_keep_out
from skyquilt.planning.terrain import FLAT
from skyquilt.raster.drivers import GEOTIFF, why_unreadable

VIEWS = "views.tif"
COVERAGE = "coverage.tif"
"""Written by a live map: the number of sharp photos of each cell, over the area of its plan."""
PLAN, STATE = "plan.json", "plan_state.json"
"""What a live map flies, and which points have no sharp photo yet."""
MOST_CELLS = 1_500
"""Largest side of the raster that is looked at."""
LEAST_M2 = 1.0


def is_run(path: Path) -> bool:
    """Whether a path is a folder with a raster of views."""
    return Path(path).is_dir()


@dataclass(frozen=True, kw_only=True, eq=False)
class FlownMission:
    """A plan and what has been flown of it."""

    plan: Plan
    """The plan."""
    cover: Cover
    """Cells of its area."""
    counts: NDArray[np.int32]
    """(rows, columns) sharp photos of each."""
    again: frozenset[int]
    """Points without a sharp photo."""

    def at(self, xy: NDArray[np.float64]) -> NDArray[np.int32]:
        """Photos that see places (n, 2) in the plan's zone."""
        places = to_mercator(xy, self.plan.site.crs)
        column = ((places[:, 0] - self.cover.west) / self.cover.cell).astype(np.int64)
        row = ((self.cover.north - places[:, 1]) / self.cover.cell).astype(np.int64)
        rows, columns = self.counts.shape
        known = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        found = np.zeros(len(xy), np.int32)
        found[known] = self.counts[row[known], column[known]]
        return found


def is_mission(folder: Path) -> bool:
    """Whether a folder is a live map that knows its plan."""
    return all((Path(folder) / n).is_file() for n in (PLAN, STATE, COVERAGE))


def read_mission_state(folder: Path) -> FlownMission:
    """What a live map has written of its plan; raises SideFileError where a file is damaged."""
    folder = Path(folder)
    plan = read_plan(folder / PLAN)
    try:
        record = json.loads(read_bounded(folder / STATE).decode("utf-8"))
        again = frozenset(int(k) for k in record["again"])
        with rasterio.open(folder / COVERAGE, driver=GEOTIFF) as raster:
            values = raster.read(1)
            affine = raster.transform
    except rasterio.errors.RasterioError as error:
        raise SideFileError(
            f"{folder / COVERAGE} cannot be read: {why_unreadable(error)}"
        ) from error
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise SideFileError(f"{folder / STATE} is damaged: {error}") from error
    like = planned_cover(plan)
    inside = values != OUTSIDE
    if inside.shape != like.inside.shape:
        raise SideFileError(f"{folder}: {COVERAGE} does not belong to {PLAN}")
    cover = Cover(west=affine.c, north=affine.f, cell=affine.a, inside=inside,
                  ground_m=like.ground_m)  # fmt: skip
    return FlownMission(
        plan=plan, cover=cover, counts=np.where(inside, values, 0).astype(np.int32), again=again
    )


def planned_cover(plan: Plan) -> Cover:
    """The cells of a plan's area, without closed places."""
    height = float(np.median([p.z - p.ground for p in plan.points])) if plan.points else 0.0
    clearance = float(plan.options.get("clearance_m") or 0.0)
    shut = [k.shape for k in plan.site.keep_out if is_shut(k, FLAT, height, clearance)]
    return cover_of(plan.site.observe.difference(union_all(shut)), plan.site.crs)


def missing_site(folder: Path, views: int, *, keep_out: Path | None = None) -> Site:
    """What a run's raster of views shows under the number asked for: holes inside the convex hull
    of what it shows, or, in a live folder with a plan, anything in the plan's area.

    Raises:
        SideFileError: the folder is no run, or its map is not georeferenced.
        RefusedError: nothing is missing.
    """
    folder = Path(folder)
    name = next((n for n in (COVERAGE, VIEWS) if (folder / n).is_file()), None)
    if name is None:
        raise SideFileError(
            f"{folder} is no finished run and no live folder: it holds no {VIEWS}; give a file with"
            " areas"
        )
    try:
        with rasterio.open(folder / name, driver=GEOTIFF) as raster:
            if raster.crs is None:
                raise SideFileError(f"{folder / name} is not georeferenced; give a file with areas")
            scale = max(1.0, max(raster.shape) / MOST_CELLS)
            form = tuple(max(1, round(n / scale)) for n in raster.shape)
            counts = raster.read(1, out_shape=form, resampling=rasterio.enums.Resampling.nearest)
            affine = raster.transform @ raster.transform.scale(
                raster.width / form[1], raster.height / form[0]
            )
            crs = raster.crs.to_string()
            outside = raster.nodata if name == COVERAGE else None
    except rasterio.errors.RasterioError as error:
        raise SideFileError(f"{folder / name} cannot be read: {why_unreadable(error)}") from error
    asked = counts != outside if outside is not None else _hull(counts > 0)
    short = asked & (counts < views)
    pieces = [
        from_geojson(geometry)
        for geometry, value in shapes(short.astype(np.uint8), mask=short, transform=affine)
        if value
    ]
    cell = abs(affine.a)
    area = union_all([p for p in pieces if p.area > LEAST_M2]).buffer(cell).simplify(cell)
    if area.is_empty:
        raise RefusedError(
            f"nothing is missing: every cell of {folder / name} has {views}"
            f" view{'s' * (views != 1)}"
        )
    return _placed(area, crs, keep_out)


def _placed(area: BaseGeometry, crs: str, keep_out: Path | None) -> Site:
    """The site of an area in any projection."""
    middle = geographic(crs, np.array([area.centroid.coords[0]]))[0]
    zone = utm_epsg(*middle[::-1])
    turned = Transformer.from_crs(crs, zone, always_xy=True)
    moved = transform(area, lambda xy: np.column_stack(turned.transform(xy[:, 0], xy[:, 1])))
    return make_site(moved.buffer(0), read_keep_out(keep_out, zone) if keep_out else (), zone)


def _hull(shown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(rows, columns), True inside the convex hull of what is shown."""
    rows, columns = np.nonzero(shown)
    if len(rows) < 3:
        return shown
    hull = cv2.convexHull(np.column_stack([columns, rows]).astype(np.int32))
    drawn = np.zeros(shown.shape, np.uint8)
    cv2.fillConvexPoly(drawn, hull, 1)
    return drawn > 0
