"""Planning of a map window before any pixel is read: which photos can be visible where."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.nodes import (
    STEP,
    Nodes,
    View,
    least_scores,
    node_places,
    overlapping,
    project_all,
)
from skyquilt.model.raster import Grid, Window
from skyquilt.model.surface import Surface
from skyquilt.ortho.blend import Blend
from skyquilt.ortho.labels import Labels
from skyquilt.ortho.smears import badly_shown, yielding

TOGETHER = 6
"""Number of photos projected at a time."""
STILL = 0.5
"""A changed height is ignored if it shifts a photo by less than this number of map pixels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """Plan of a map window."""

    window: Window
    """Part of the map."""
    margin: int
    """Pixels beyond it that the blending method needs."""
    nodes: Sequence[Nodes]
    """The nodes in image coordinates of each photo that covers any of them."""
    near: Sequence[NDArray[np.bool_]]
    """(r, c) per photo, for the cells around the nodes: whether the photo can be visible there."""
    z: NDArray[Any]
    """(r, c) heights in m of the nodes."""
    projected: Mapping[int, Nodes]
    """The nodes of all photos examined, by photo."""

    @property
    def shown(self) -> list[int]:
        """Photos that can be visible."""
        return list(self.showing())

    def showing(self) -> dict[int, NDArray[np.bool_]]:
        """The photos that can be visible, and where: (r, c) for the cells around the nodes."""
        return {n.view.photo: m for n, m in zip(self.nodes, self.near, strict=True) if m.any()}


def planned(
    window: Window,
    grid: Grid,
    views: Sequence[View],
    surface: Surface,
    blend: Blend,
    *,
    counted: bool,
    earlier: Plan | None,
    labels: Labels | None = None,
) -> Plan:
    """A plan of a window of a grid; `counted` and `earlier` as for `Composer.plan`. `labels`: the
    photo of each place, where it is not the one of the lowest rank.
    """
    margin = -(-blend.margin // STEP) * STEP
    x, y, z = node_places(grid, surface, window.grown(margin))
    known: Mapping[int, Nodes] = {}
    if earlier is not None:
        z, same = _kept_heights(z, earlier, grid.gsd)
        known = earlier.projected if same else known
    views = overlapping(views, x, y)
    if labels is not None:
        shown = labels.near(window.grown(margin), blend.seam_px or 0.0)
        asked = views if counted else [v for v in views if v.photo in shown]
        seen = [n for n in project_all(asked, x, y, z) if n.seen.any()]
        nowhere = np.zeros(x.shape, np.bool_)
        return Plan(
            window=window,
            margin=margin,
            nodes=seen,
            near=[shown.get(n.view.photo, nowhere) for n in seen],
            z=z,
            projected={n.view.photo: n for n in seen},
        )
    low = blend.rank(np.arange(len(views)), least_scores(views, x, y, z))
    height = min((float(v.pose.map_C[2]) for v in views), default=1.0) - float(np.median(z))
    slack = blend.reach(grid.gsd) / max(height, 1e-3)
    # between nodes, ranks lie between those of the nodes: a photo whose lowest rank exceeds the
    # highest rank of another cannot be visible there
    around, best = np.ones((3, 3), np.uint8), np.full(x.shape, np.float32(np.inf))
    found: dict[int, tuple[Nodes, NDArray[Any]]] = {}
    smears: dict[int, NDArray[np.bool_]] = {}
    ready = {
        k: n for k, v in enumerate(views) if (n := known.get(v.photo)) is not None and n.view is v
    }
    order = np.argsort(low, kind="stable").tolist()
    for at, k in enumerate(order):
        if not counted and low[k] > best.max() + slack:
            break
        if k not in ready:
            some = [j for j in order[at:] if j not in ready][:TOGETHER]
            ready.update(zip(some, project_all([views[j] for j in some], x, y, z), strict=True))
        nodes = ready[k]
        if nodes.seen.any():
            rank = blend.rank(k, np.where(nodes.seen, nodes.score, np.float32(np.inf)))
            found[k] = nodes, cv2.erode(rank, around)
            if (smear := badly_shown(nodes, grid.gsd)).any():
                smears[k] = smear
                rank = np.where(smear, np.float32(np.inf), rank)  # it hides no other photo there
            best = np.minimum(best, cv2.dilate(rank, around))
    whole = {k: nodes for k, (nodes, _) in found.items()}
    for k, smear in smears.items():
        others = [(nodes, smears.get(j)) for j, nodes in whole.items() if j != k]
        nodes = yielding(whole[k], smear, others)
        rank = blend.rank(k, np.where(nodes.seen, nodes.score, np.float32(np.inf)))
        found[k] = nodes, cv2.erode(rank, around)
    kept = [found[k] for k in sorted(found)]
    return Plan(
        window=window,
        margin=margin,
        nodes=[nodes for nodes, _ in kept],
        near=[np.isfinite(least) & (least <= best + slack) for _, least in kept],
        z=z,
        projected={n.view.photo: n for n in ready.values()},
    )


def _kept_heights(z: NDArray[Any], earlier: Plan, gsd: float) -> tuple[NDArray[Any], bool]:
    """Heights (r, c): the earlier ones except where the new ones shift a photo visibly; and whether
    there is no such place.
    """
    aside = max(
        (
            float(n.score[m].max())
            for n, m in zip(earlier.nodes, earlier.near, strict=True)
            if m.any()
        ),
        default=0.0,
    )
    moved = np.abs(z - earlier.z) * np.sqrt(aside) > STILL * gsd
    if not moved.any():
        return earlier.z, True
    around = cv2.dilate(moved.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.where(around, z, earlier.z), False


def stale(plan: Plan, earlier: Plan) -> NDArray[np.bool_]:
    """(r, c) for the cells around the nodes: whether they differ from the result of an earlier
    plan.
    """
    now, before = plan.showing(), earlier.showing()
    lifted = cv2.dilate((plan.z != earlier.z).view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    nowhere = np.zeros(plan.z.shape, np.bool_)
    found = nowhere.copy()
    for photo in {*now, *before}:
        a, b = now.get(photo, nowhere), before.get(photo, nowhere)
        new, old = plan.projected.get(photo), earlier.projected.get(photo)
        if new is not None and old is not None and new.view is old.view:
            found |= (a != b) | ((a | b) & lifted)
        else:
            found |= a | b
    return found
