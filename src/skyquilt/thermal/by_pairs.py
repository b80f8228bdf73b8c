"""Registration of two blocks by pairs of photos [Yahyanejad 2013, 5.2.3, (5.7)].

Pairs of a visual and a thermal photo of the same ground are registered. Each photo is first
orthorectified with the pose and the surface of its own block, so that relief causes no differences.
The registration is refined by colours: shadows shift a refinement by brightness in the same
direction in all pairs, which an adjustment would not detect. The correspondences are then known in
both maps, and one transform is fitted to all of them with balanced weights.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.methods import near_guess, registration_method
from skyquilt.coregistration.propagation import PairPoints, Propagate
from skyquilt.coregistration.refine_registration import RefineRegistration
from skyquilt.errors import PhotoFailedError
from skyquilt.geometry.transforms import fit, transfer
from skyquilt.imaging.nodes import View
from skyquilt.imaging.views import on_ground
from skyquilt.model.raster import Grid, Window
from skyquilt.model.registration import (
    Guess,
    Matrix,
    Picture,
    RefusedRegistration,
    Registers,
    Registration,
)
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
_LEAST_PAIRS = 3
"""Fewest pairs that must be registered, and agree."""
_SAMPLED = 8
"""Pairs that are sought anywhere if too few lie where positions say; a search takes seconds."""
T = TypeVar("T", bound=tuple[Any, ...])
Told = tuple[PairPoints, bool]
"""Correspondences of a pair, and whether they were refined by colours."""
_PROPAGATE = Propagate(model="similarity", least_pairs=_LEAST_PAIRS, least_share=2 / 3)


def by_pairs(visual: Scene, thermal: Scene) -> Registration | RefusedRegistration:
    """The transform from px of the visual map to those of the thermal map, or the reason why there
    is none.
    """
    asked = overlapping(visual, thermal)
    told = registered_of(
        asked,
        lambda a, b: _registered(visual, thermal, a, b, near_guess()),
        lambda a, b: _registered(visual, thermal, a, b, registration_method("auto")),
    )
    found = [p for p, _ in told]
    if len(found) < _LEAST_PAIRS:
        return RefusedRegistration(
            reason=f"{len(found)} of {len(asked)} overlapping pairs of photos could be registered"
        )
    there = {p.a: np.eye(3) for p in found}, {p.b: np.eye(3) for p in found}
    outcome = _PROPAGATE(found, *there)
    if isinstance(outcome, RefusedRegistration):
        return outcome
    counts = {
        "pairs_tried": float(len(asked)),
        "pairs_registered": float(len(found)),
        "pairs_by_colour": float(sum(by_colour for _, by_colour in told)),
    }
    return replace(outcome, evidence={**outcome.evidence, **counts})


def registered_of(
    asked: Sequence[T], near: Callable[..., Told | None], anywhere: Callable[..., Told | None]
) -> list[Told]:
    """What is registered of pairs, in their order. `near`, ten times as fast, compares a pair where
    the positions of both flights say. All pairs lie in one place: if it finds enough of them, the
    others are not sought elsewhere; otherwise some are, and the rest if one of these is found.
    """
    found: list[Told | None] = [near(*pair) for pair in asked]
    count = sum(one is not None for one in found)
    if count >= _LEAST_PAIRS:
        return [one for one in found if one is not None]
    rest = [k for k, one in enumerate(found) if one is None]
    some = {rest[int(k)] for k in np.linspace(0, len(rest) - 1, _SAMPLED)} if rest else set()
    for k in sorted(some):
        found[k] = anywhere(*asked[k])
    if any(found[k] is not None for k in some):
        for k in rest:
            if k not in some:
                found[k] = anywhere(*asked[k])
    return [one for one in found if one is not None]


def by_homographies(visual: Scene, thermal: Scene) -> Registration | RefusedRegistration:
    """The same as (5.7) is written: photos are registered as they are, their points carried by one
    homography per photo (of level ground) and weighted equally, and a homography is fitted. One
    registered pair is enough.
    """
    asked = overlapping(visual, thermal)
    there = ({v.photo: _homography(s, v) for v in s.ground.views} for s in (visual, thermal))
    on_a, on_b = there
    found = [
        pair
        for a, b in asked
        if (pair := _as_they_are(visual, thermal, (a, on_a[a.photo]), (b, on_b[b.photo])))
    ]
    if not found:
        return RefusedRegistration(
            reason=f"none of {len(asked)} overlapping pairs of photos could be registered"
        )
    outcome = Propagate(model="homography", balanced=False)(found, on_a, on_b)
    if isinstance(outcome, RefusedRegistration):
        return outcome
    counts = {"pairs_tried": float(len(asked)), "pairs_registered": float(len(found))}
    return replace(outcome, evidence={**outcome.evidence, **counts})


def _homography(scene: Scene, view: View) -> Matrix:
    """(3, 3) from the pixels of a photo to those of its map, over level ground at the block's
    median height; the lens's distortion is left out.
    """
    surface = scene.ground.surface
    level = replace(surface, z=np.full_like(surface.z, np.nanmedian(surface.z)))
    photo = scene.aligned.photos[view.photo]
    ends = np.linspace(0, 1, _GRID)
    x, y = np.meshgrid(ends * (photo.width - 1), ends * (photo.height - 1))
    px = np.c_[x.ravel(), y.ravel()]
    ground = on_ground(view, px, level)
    found = fit("homography", px, np.stack(scene.ground.grid.pixel(*ground[:, :2].T), 1))
    assert found is not None  # a grid determines it
    return found


def _as_they_are(
    visual: Scene, thermal: Scene, a: tuple[View, Matrix], b: tuple[View, Matrix]
) -> PairPoints | None:
    """Points of two photos in their own pixels; None if they cannot be registered."""
    try:
        pictures = [
            Picture(values=np.ascontiguousarray(s.aligned.pixels(v.photo)))
            for s, v in ((visual, a[0]), (thermal, b[0]))
        ]
    except PhotoFailedError:  # both maps are drawn: it is lost for this pair alone
        return None
    ours, theirs = visual.ground.grid, thermal.ground.grid
    shift = _shift(visual, thermal)
    corners = np.array([[0.0, 0], [ours.width, 0], [0, ours.height], [ours.width, ours.height]])
    east, north = ours.x(corners[:, 0]) - shift[0], ours.y(corners[:, 1]) - shift[1]
    between = fit("similarity", corners, np.stack(theirs.pixel(east, north), 1))
    assert between is not None
    start = np.linalg.inv(b[1]) @ between @ a[1]
    guess = Guess(b_H_a=start / start[2, 2], source="the adjustments of both flights")
    outcome = registration_method("auto")(pictures[0], pictures[1], guess)
    if not isinstance(outcome, Registration):
        return None
    return PairPoints(a=a[0].photo, b=b[0].photo, px_a=outcome.px_a, px_b=outcome.px_b)


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


def _registered(
    visual: Scene, thermal: Scene, a: View, b: View, method: Registers
) -> tuple[PairPoints, bool] | None:
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
    try:
        flat = _flat(visual, a, grid_a), _flat(thermal, b, grid_b)
    except PhotoFailedError:  # both maps are drawn: it is lost for this pair alone
        return None
    if any(p.valid is None or p.valid.mean() < 0.1 for p in flat):
        return None
    guess = Guess(
        b_H_a=np.eye(3),
        reach=_REACH_M / gsd / max(width, height),
        rotation_deg=3,
        scale=1.06,
        source="the adjustments of both flights",
    )
    outcome = method(*flat, guess)
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
