"""Registration of two blocks by pairs of photos [Yahyanejad 2013, 5.2.3, (5.7)].

Pairs of a visual and a thermal photo of the same ground are registered. Each photo is first
orthorectified with the pose and the surface of its own block, so that relief causes no differences.
The registration is refined by colours: shadows shift a refinement by brightness in the same
direction in all pairs, which an adjustment would not detect. The correspondences are then known in
both maps, and one transform is fitted to all of them with balanced weights.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.methods import registration_method
from skyquilt.coregistration.propagation import PairPoints, Propagate
from skyquilt.coregistration.refine_registration import RefineRegistration
from skyquilt.geometry.transforms import transfer
from skyquilt.imaging.nodes import View
from skyquilt.model.raster import Grid, Window
from skyquilt.model.registration import Guess, Picture, RefusedRegistration, Registration
from skyquilt.ortho.blend import First
from skyquilt.ortho.compose import Composer
from skyquilt.workflows.flow import Scene

MOST_PAIRS = 24
"""Largest number of pairs registered, distributed over the map; each takes a third of a second of
CPU time.
"""
LEAST_OVERLAP = 0.4
"""Least share of the thermal footprint that the visual one must cover."""
_REACH_M = 6.0
"""Largest offset in m between the positions of two flights."""
REFINE = RefineRegistration()
"""Refinement of an accepted pair. The model is as rigid as the difference between two adjusted
blocks; a model with more parameters would fit shadows.
"""
_SIDE_PX = 1000
"""Longest side in px of the images in which a pair is registered; less if a thermal pixel is
larger.
"""
_GRID = 6
"""Points per side of the grid that represents a pair's transform."""


def by_pairs(visual: Scene, thermal: Scene) -> Registration | RefusedRegistration:
    """The transform from px of the visual map to those of the thermal map, or the reason why there
    is none.
    """
    asked = overlapping(visual, thermal)
    told = [r for a, b in asked if (r := _registered(visual, thermal, a, b)) is not None]
    found = [p for p, _ in told]
    if len(found) < 3:
        return RefusedRegistration(
            reason=f"{len(found)} of {len(asked)} overlapping pairs of photos could be registered"
        )
    there = {p.a: np.eye(3) for p in found}, {p.b: np.eye(3) for p in found}
    outcome = Propagate(model="similarity")(found, *there)
    if isinstance(outcome, RefusedRegistration):
        return outcome
    counts = {
        "pairs_tried": float(len(asked)),
        "pairs_registered": float(len(found)),
        "pairs_by_colour": float(sum(by_colour for _, by_colour in told)),
    }
    return replace(outcome, evidence={**outcome.evidence, **counts})


def overlapping(visual: Scene, thermal: Scene) -> list[tuple[View, View]]:
    """For thermal photos distributed over the map, the visual photo that covers most of each."""
    views = [v for v in thermal.ground.views if v.photo in thermal.aligned.alignment.held]
    spread = sorted(
        {int(k) for k in np.linspace(0, len(views) - 1, MOST_PAIRS)} if views else set()
    )
    found = []
    for view in (views[k] for k in spread):
        there = view.footprint + _shift(visual, thermal)
        shares = [_share(v.footprint, there) for v in visual.ground.views]
        if shares and max(shares) > LEAST_OVERLAP:
            found.append((visual.ground.views[int(np.argmax(shares))], view))
    return found


def _shift(visual: Scene, thermal: Scene) -> NDArray[np.float64]:
    """(2,) shift in m from the thermal block's frame to the visual one's."""
    ours, theirs = visual.aligned.alignment.frame, thermal.aligned.alignment.frame
    return np.asarray(np.subtract(theirs.origin, ours.origin))


def _share(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Share of outline b that outline a covers; both are nearly convex."""
    hulls = [cv2.convexHull((o - b.mean(0)).astype(np.float32)) for o in (a, b)]
    return float(cv2.intersectConvexConvex(*hulls)[0] / max(cv2.contourArea(hulls[1]), 1e-9))


def _registered(visual: Scene, thermal: Scene, a: View, b: View) -> tuple[PairPoints, bool] | None:
    """Correspondences of one pair in px of both maps, and whether it was refined by colours; None
    if it cannot be registered.
    """
    low, high = b.footprint.min(0) - _REACH_M, b.footprint.max(0) + _REACH_M
    gsd = max(float((high - low).max()) / _SIDE_PX, thermal.ground.grid.gsd)
    width, height = (int(n) for n in np.ceil((high - low) / gsd))
    grid_b = Grid(west=float(low[0]), north=float(high[1]), gsd=gsd, width=width, height=height)
    shift = _shift(visual, thermal)
    grid_a = replace(
        grid_b, west=grid_b.west + float(shift[0]), north=grid_b.north + float(shift[1])
    )
    flat = _flat(visual, a, grid_a), _flat(thermal, b, grid_b)
    if any(p.valid is None or p.valid.mean() < 0.1 for p in flat):
        return None
    guess = Guess(
        b_H_a=np.eye(3),
        reach=_REACH_M / gsd / max(width, height),
        rotation_deg=3,
        scale=1.06,
        source="the adjustments of both flights",
    )
    outcome = registration_method("auto")(*flat, guess)
    if not isinstance(outcome, Registration):
        return None
    refined = REFINE(*flat, outcome)
    px_a, px_b = _points(flat, refined)
    points = PairPoints(
        a=a.photo,
        b=b.photo,
        px_a=_on_map(visual, grid_a, px_a),
        px_b=_on_map(thermal, grid_b, px_b),
    )
    return points, refined.evidence.get("by_colour", 0.0) > 0


def _flat(scene: Scene, view: View, grid: Grid) -> Picture:
    """One photo orthorectified to a grid, with its pose and its block's surface."""
    photo = scene.aligned.photos[view.photo]
    compose = Composer(
        grid=grid,
        views=[view],
        surface=scene.ground.surface,
        blend=First(),
        pixels=scene.aligned.pixels,
        bands=photo.channels,
        dtype=np.dtype(photo.dtype),
    )
    composed = compose(Window(row=0, column=0, height=grid.height, width=grid.width))
    values = composed.pixels[..., 0] if photo.channels == 1 else composed.pixels
    return Picture(values=values, valid=composed.photo >= 0)


def _points(
    flat: tuple[Picture, Picture], outcome: Registration
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n, 2) px of a and of b, distributed over the area that both cover."""
    a, b = (np.asarray(p.valid) for p in flat)
    x, y = (np.linspace(0, n - 1, 3 * _GRID) for n in (b.shape[1], b.shape[0]))
    px_b = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2).astype(np.float64)
    px_a = transfer(np.asarray(np.linalg.inv(outcome.b_H_a), np.float64), px_b)
    inside = ((px_a > 0) & (px_a < [a.shape[1] - 1, a.shape[0] - 1])).all(1)
    px_a, px_b = px_a[inside], px_b[inside]
    both = (
        a[tuple(np.round(px_a[:, ::-1]).astype(int).T)]
        & b[tuple(np.round(px_b[:, ::-1]).astype(int).T)]
    )
    return px_a[both], px_b[both]


def _on_map(scene: Scene, grid: Grid, px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels of a grid in px of the block's map."""
    return np.stack(scene.ground.grid.pixel(grid.x(px[:, 0]), grid.y(px[:, 1])), 1)
