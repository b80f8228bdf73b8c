"""What photos see of the terrain: outlines, overlap, ground size."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from shapely import area as area_of
from shapely import intersection, polygons

from skyquilt.planning.coverage import Cells, counted
from skyquilt.planning.records import Array, Proof, View
from skyquilt.planning.terrain import Terrain

ROUNDS = 30


class Seeing(Protocol):
    """Points with the cells that they see."""

    @property
    def xyz(self) -> Array:
        """(n, 3)."""

    @property
    def yaw(self) -> Array:
        """(n,)."""

    @property
    def run(self) -> NDArray[np.int64]:
        """(n,)."""

    @property
    def seen(self) -> Sequence[NDArray[np.int32]]:
        """n lists."""


def outlines(view: View, xyz: Array, yaw: Array, terrain: Terrain) -> Array:
    """Corners (n, 4, 2) of photos on the terrain: rays followed to the ground by fixed-point
    iteration, halved so that it converges on slopes too.
    """
    s, c = np.sin(np.radians(yaw)), np.cos(np.radians(yaw))
    corners = [
        (view.up, -view.left), (view.up, view.right), (-view.down, view.right),
        (-view.down, -view.left),
    ]  # fmt: skip
    ahead, aside = (np.array([k[i] for k in corners]) for i in (0, 1))
    x = s[:, None] * ahead + c[:, None] * aside
    y = c[:, None] * ahead - s[:, None] * aside
    depth = np.repeat((xyz[:, 2] - terrain.at(xyz[:, 0], xyz[:, 1]))[:, None], 4, axis=1)
    for _ in range(ROUNDS):
        ground = terrain.at(xyz[:, :1] + x * depth, xyz[:, 1:2] + y * depth)
        depth = 0.5 * depth + 0.5 * np.maximum(xyz[:, 2:3] - ground, 0.1)
    return np.stack([xyz[:, :1] + x * depth, xyz[:, 1:2] + y * depth], axis=-1)


def proof_of(cells: Cells, view: View, layout: Seeing, views: int, closed_m2: float) -> Proof:
    """What the points see of the cells."""
    counts = counted(cells, layout.seen)[cells.inside.ravel()]
    missing = float(cells.areas[cells.inside][counts < views].sum())
    depths = [
        (float(p[2] - z.max()), float(p[2] - z.min()))
        for p, s in zip(layout.xyz, layout.seen, strict=True)
        if len(s)
        for z in [cells.z.ravel()[s]]
    ]
    fine = min((d[0] for d in depths), default=0.0) / view.focal * 100
    coarse = max((d[1] for d in depths), default=0.0) / view.focal * 100
    return Proof(
        views=views,
        cell_m=cells.size,
        cells=len(counts),
        least=int(counts.min(initial=views)),
        median=float(np.median(counts)) if len(counts) else 0.0,
        missing_m2=missing,
        closed_m2=closed_m2,
        gsd_cm=(fine, coarse),
        overlap=_least_overlap(cells, view, layout),
    )


def _least_overlap(cells: Cells, view: View, layout: Seeing) -> float:
    """Of consecutive photos of a run; 1 where there are none."""
    if len(layout.xyz) < 2:
        return 1.0
    shapes = polygons(outlines(view, layout.xyz, layout.yaw, cells.terrain))
    pair = (layout.run[1:] == layout.run[:-1]) & (layout.run[1:] >= 0)
    # neighbours in a run between which a point was closed do not follow one another
    apart = np.linalg.norm(np.diff(layout.xyz[:, :2], axis=0), axis=1)
    usual = float(np.median(apart[pair])) if pair.any() else 0.0
    pair &= apart < 1.5 * usual + 1e-9
    if not pair.any():
        return 1.0
    a, b = shapes[:-1][pair], shapes[1:][pair]
    shared = area_of(intersection(a, b)) / np.minimum(area_of(a), area_of(b))
    return float(shared.min())
