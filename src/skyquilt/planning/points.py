"""Picture-points that cover an area (thesis 2.4): lattices of its pieces, points added where ground
or keep-outs leave too few views, and points taken away that no cell needs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from shapely import contains_xy, prepare, union_all
from shapely.geometry.base import BaseGeometry

from skyquilt.errors import RefusedError, UsageError
from skyquilt.planning.coverage import (
    Cells,
    Cuts,
    all_seen,
    counted,
    make_cells,
    sight_may_be_blocked,
)
from skyquilt.planning.footprints import proof_of
from skyquilt.planning.lattice import Steps, runs, steps_of, to_uv
from skyquilt.planning.pieces import Piece, pieces
from skyquilt.planning.records import Area, Array, KeepOut, PicturePoint, Proof, Site, View
from skyquilt.planning.repair import added, needless
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.site import make_site
from skyquilt.planning.terrain import Terrain

MOST_POINTS = 20_000
"""Largest number of points of a plan."""
PER_FOOTPRINT = (24, 72)
"""Least and largest number of cells along the shorter side of a footprint."""
MOST_SEEN = 30e6
"""Number of pairs of a photo and a cell that are kept in memory."""
HIGHER = 1.001
"""Height flown over height asked for: windows that only just meet then overlap by centimetres."""
MOST_CUTS = 40_000
"""Largest number of photos' rows times columns whose edges become edges of cells."""
CLOSER = (0.0, 0.04, 0.08, 0.14, 0.2)
"""By which shares the lattice is tried closer where the ground is not flat."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Points with the cells that they see."""

    xyz: Array
    """(n, 3) places."""
    yaw: Array
    """(n,) degrees."""
    run: NDArray[np.int64]
    """(n,) number of the line's run; -1 for points added singly."""
    seen: tuple[NDArray[np.int32], ...]
    """Cells of each."""

    def without(self, gone: NDArray[np.bool_]) -> "Layout":
        """The layout less some points (n,)."""
        keep = ~gone
        return Layout(
            xyz=self.xyz[keep],
            yaw=self.yaw[keep],
            run=self.run[keep],
            seen=tuple(s for s, k in zip(self.seen, keep, strict=True) if k),
        )

    def joined(self, other: "Layout") -> "Layout":
        """Both."""
        return Layout(
            xyz=np.concatenate([self.xyz, other.xyz]),
            yaw=np.concatenate([self.yaw, other.yaw]),
            run=np.concatenate([self.run, other.run]),
            seen=self.seen + other.seen,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """What all steps need."""

    view: View
    """The camera."""
    height: float
    """Above the ground in m."""
    clearance: float
    """Above the surface in m."""
    terrain: Terrain
    """The ground."""
    closed: BaseGeometry
    """Where no point may be."""
    cells: Cells
    """The ground to be seen."""
    views: int
    """By so many photos."""
    blocked: bool
    """Whether slopes may hide ground."""

    def layout(self, xy: Array, yaw: Array, run: NDArray[np.int64]) -> Layout:
        """Points (n, 2) at their height, without those in closed places or that see nothing."""
        if len(xy):
            prepare(self.closed)
            open_ = ~contains_xy(self.closed, xy[:, 0], xy[:, 1])
            xy, yaw, run = xy[open_], yaw[open_], run[open_]
        ground = self.terrain.at(xy[:, 0], xy[:, 1])
        top = self.terrain.around(xy[:, 0], xy[:, 1], self.clearance) if len(xy) else ground
        xyz = np.column_stack([xy, np.maximum(ground + self.height, top + self.clearance)])
        seen = all_seen(self.cells, self.view, xyz, yaw, blocked=self.blocked)
        whole = Layout(xyz=xyz, yaw=yaw, run=run, seen=tuple(seen))
        return whole.without(np.array([len(s) == 0 for s in seen], bool))


def height_of(settings: PlanSettings, view: View) -> float:
    """Height above the ground in m."""
    if settings.height_m is not None:
        return settings.height_m
    height = float(settings.gsd_cm or 0) / 100 * view.focal
    if not 2 <= height <= 10_000:
        raise UsageError(
            f"--gsd {settings.gsd_cm:g} cm with {view.name} means flying {height:.4g} m above the"
            " ground; 2 to 10000 m can be flown"
        )
    return height


def place_points(
    site: Site, view: View, settings: PlanSettings, terrain: Terrain
) -> tuple[tuple[PicturePoint, ...], Proof, tuple[str, ...], Cells]:
    """The points of a site with the proof of their coverage, warnings, and the cells.

    Raises:
        RefusedError: keep-outs close the whole area, or it would take too many points.
    """
    height = height_of(settings, view)
    shut = [k for k in site.keep_out if is_shut(k, terrain, height, settings.clearance_m)]
    area = open_area(site, shut)
    closed = union_all(
        [k.shape.buffer(settings.clearance_m, join_style="mitre", mitre_limit=2) for k in shut]
    )
    steps = steps_of(
        view.along * height, view.across * height, settings.overlap, settings.sidelap,
        settings.views,
    )  # fmt: skip
    guess = area.area / (steps.step * steps.spacing)
    if guess > MOST_POINTS:
        raise RefusedError(
            f"the area needs about {guess:.0f} photos, and {MOST_POINTS} are the most of one plan;"
            " divide it, or fly higher"
        )
    found = pieces(area, steps)
    size = cell_size(steps, sum(p.count for p in found))
    main = max(found, key=lambda p: p.count)
    cuts = _window_edges(found, main.heading, steps) if not terrain.known else ((), ())
    cells = make_cells(area, main.heading, size, terrain, cuts)
    task = Task(
        view=view,
        height=height * HIGHER,
        clearance=settings.clearance_m,
        terrain=terrain,
        closed=closed,
        cells=cells,
        views=settings.views or steps.n * steps.m,
        blocked=sight_may_be_blocked(view, terrain),
    )
    flat = not terrain.known or bool(np.ptp(cells.z[cells.inside]) < 0.01 * height)
    tries = [_attempt(task, found, steps, k) for k in (CLOSER[:1] if flat else CLOSER)]
    layout = min(tries, key=lambda t: (_short(task, t), len(t.xyz)))
    points = numbered(layout, terrain)
    hidden = site.observe.area - area.area
    proof = proof_of(cells, view, layout, task.views, hidden)
    return points, proof, tuple(_warnings(proof)), cells


def is_shut(place: KeepOut, terrain: Terrain, height: float, clearance: float) -> bool:
    """Whether a keep-out closes the height at which photos are taken."""
    if place.ceiling_m is None:
        return True
    top = terrain.highest(place.shape) + place.ceiling_m + clearance
    west, south, east, north = place.shape.bounds
    x, y = np.meshgrid(np.linspace(west, east, 40), np.linspace(south, north, 40))
    return bool(terrain.at(x, y).min() + height < top)


def open_area(site: Site, shut: Sequence[KeepOut]) -> Area:
    """The area less closed places; raises RefusedError where nothing is left."""
    rest = site.observe.difference(union_all([k.shape for k in shut])) if shut else site.observe
    if rest.area < 1e-6 * site.observe.area:
        raise RefusedError("keep-out areas close the whole area; there is nothing to observe")
    return make_site(rest, (), site.crs).observe


def cell_size(steps: Steps, points: int) -> float:
    """Side of the cells in m: as fine as memory allows."""
    short = min(steps.along, steps.across)
    ratio = steps.along * steps.across / short**2
    per = np.clip(np.sqrt(MOST_SEEN / max(points, 1) / ratio), *PER_FOOTPRINT)
    return float(short / per)


def _attempt(task: Task, found: Sequence[Piece], steps: Steps, closer: float) -> Layout:
    """The lattices of all pieces, mended and thinned."""
    xy, yaw, run = [np.empty((0, 2))], [np.empty(0)], [np.empty(0, np.int64)]
    tight = []
    for piece in found:
        own = tighter(steps, task.cells, piece.heading, closer)
        tight.append(own)
        for line in runs(piece.shape, piece.heading, own, piece.phase):
            xy.append(shifted(line, task.view, task.height, piece.heading))
            yaw.append(np.full(len(line), piece.heading))
            run.append(np.full(len(line), len(run)))
    layout = task.layout(np.concatenate(xy), np.concatenate(yaw), np.concatenate(run))
    for share in (0.5, 0.25):
        short = np.flatnonzero(_lack(task, layout) > 0)
        if not len(short):
            break
        more = _candidates(task, found, tight, short, share)
        chosen = added(more.seen, _lack(task, layout))
        layout = layout.joined(more.without(~chosen))
    return layout.without(needless(layout.seen, layout.run, _counts(task, layout), task.views))


def _window_edges(found: Sequence[Piece], heading: float, steps: Steps) -> Cuts:
    """Edges (along, to the right) of what the photos of one heading see: cells that end there are
    seen whole or not at all, so flat ground needs no point more than its lattice.
    """
    lines = [
        to_uv(line, heading)
        for p in found
        if p.heading == heading
        for line in runs(p.shape, heading, steps, p.phase)
    ]
    uv = np.concatenate(lines)
    u, v = (np.unique(np.round(uv[:, k], 3)) for k in (0, 1))
    if len(u) * len(v) > MOST_CUTS:
        return (), ()
    half = steps.along / 2, steps.across / 2
    return (
        np.concatenate([u - half[0], u + half[0]]).tolist(),
        np.concatenate([v - half[1], v + half[1]]).tolist(),
    )


def tighter(steps: Steps, cells: Cells, heading: float, closer: float) -> Steps:
    """The steps for windows that see whole cells, and closer by a share."""
    if heading == cells.heading and not cells.terrain.known:
        return steps
    turn = np.radians(heading - cells.heading)
    lost = cells.size * float(abs(np.sin(turn)) + abs(np.cos(turn)))
    along, across = steps.along * (1 - closer) - lost, steps.across * (1 - closer) - lost
    return replace(
        steps,
        along=along,
        across=across,
        step=min(steps.step * (1 - closer), along / steps.n),
        spacing=min(steps.spacing * (1 - closer), across / steps.m),
    )


def shifted(middles: Array, view: View, height: float, heading: float) -> Array:
    """Where the camera has to be (n, 2) to see windows with these middles: beside them, where its
    axis does not lie in the middle of the picture.
    """
    s, c = np.sin(np.radians(heading)), np.cos(np.radians(heading))
    ahead, right = np.array([s, c]), np.array([c, -s])
    off = (view.up - view.down) / 2 * ahead + (view.right - view.left) / 2 * right
    return np.asarray(middles - height * off)


def _counts(task: Task, layout: Layout) -> NDArray[np.int32]:
    return counted(task.cells, layout.seen)


def _lack(task: Task, layout: Layout) -> NDArray[np.int32]:
    """Views that each cell lacks, flat."""
    missing = np.maximum(task.views - _counts(task, layout), 0)
    return np.asarray(np.where(task.cells.inside.ravel(), missing, 0), np.int32)


def _short(task: Task, layout: Layout) -> int:
    return int((_lack(task, layout) > 0).sum())


def _candidates(
    task: Task,
    found: Sequence[Piece],
    tight: Sequence[Steps],
    short: NDArray[np.int64],
    share: float,
) -> Layout:
    """Places around cells that lack views, on lattices closer by a factor."""
    places = task.cells.centres(short)[:, :2]
    whole: list[Array] = []
    yaws: list[Array] = []
    for piece, steps in zip(found, tight, strict=True):
        s, c = np.sin(np.radians(piece.heading)), np.cos(np.radians(piece.heading))
        turn = np.array([[s, c], [c, -s]])
        uv = places @ turn
        if len(found) > 1:
            uv = uv[contains_xy(piece.shape.buffer(task.cells.size), places[:, 0], places[:, 1])]
        du, dv = steps.step * share, steps.spacing * share
        k, m = int(np.ceil(0.5 * steps.along / du)), int(np.ceil(0.5 * steps.across / dv))
        near = np.unique(np.round(uv / [du, dv]).astype(np.int64), axis=0)
        a, b = np.meshgrid(np.arange(-k, k + 1), np.arange(-m, m + 1))
        around = np.column_stack([a.ravel(), b.ravel()])
        if len(near) * len(around) > 3_000_000:
            near = near[:: -(-len(near) * len(around) // 3_000_000)]
        keys = np.unique((near[:, None] + around[None]).reshape(-1, 2), axis=0)
        whole.append(shifted((keys * [du, dv]) @ turn, task.view, task.height, piece.heading))
        yaws.append(np.full(len(keys), piece.heading))
    xy = np.concatenate(whole)
    return task.layout(xy, np.concatenate(yaws), np.full(len(xy), -1))


def numbered(layout: Layout, terrain: Terrain) -> tuple[PicturePoint, ...]:
    """Records of the points, numbered from 1."""
    ground = terrain.at(layout.xyz[:, 0], layout.xyz[:, 1])
    return tuple(
        PicturePoint(id=k + 1, x=x, y=y, z=z, ground=g, yaw=a % 360)
        for k, ((x, y, z), g, a) in enumerate(
            zip(layout.xyz.tolist(), ground.tolist(), layout.yaw.tolist(), strict=True)
        )
    )


def _warnings(proof: Proof) -> list[str]:
    if proof.missing_m2 <= 0:
        return []
    return [
        f"{proof.missing_m2:.0f} m2 cannot be seen in {proof.views} photos from outside the"
        f" keep-out areas; the least is {proof.least}."
    ]
