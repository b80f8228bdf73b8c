"""Two blocks joined by their pairs [Yahyanejad 2013, 5.2.3, (5.7)].

Visual and thermal photos whose footprints overlap most are registered one by one; their correspondences are carried
into both maps by the poses and surfaces of their own blocks, and one transform is fitted to all, in balance.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import project
from skyquilt.geometry.transforms import fit
from skyquilt.imaging.views import View, on_ground
from skyquilt.model.photo import RejectedPhoto
from skyquilt.model.registration import Guess, RefusedRegistration, Registration
from skyquilt.pipelines.pictures import open_picture
from skyquilt.pipelines.register import outcome_of
from skyquilt.pipelines.scene import Scene
from skyquilt.spectral.propagation import PairPoints, Propagate

MOST_PAIRS = 24
"""Pairs that are registered, spread over the map: each costs one to three seconds."""
LEAST_OVERLAP = 0.4
"""Share of the thermal footprint that the visual one must show."""
_REACH_M = 6.0
"""By how much the positions of two flights may differ."""
_GRID = 5
"""Points per side by which a pair's transform is carried."""


def by_pairs(visual: Scene, thermal: Scene) -> Registration | RefusedRegistration:
    """The transform from px of the visual map to those of the thermal map, or why there is none."""
    asked = overlapping(visual, thermal)
    found = [p for a, b in asked if (p := _registered(visual, thermal, a, b)) is not None]
    if len(found) < 3:
        return RefusedRegistration(
            reason=f"{len(found)} of {len(asked)} overlapping pairs of photos could be registered"
        )
    # correspondences are in px of the maps already: poses and surfaces carry them better than a homography would
    there = {p.a: np.eye(3) for p in found}, {p.b: np.eye(3) for p in found}
    outcome = Propagate(model="affine")(found, *there)
    if isinstance(outcome, RefusedRegistration):
        return outcome
    told = {"pairs_tried": float(len(asked)), "pairs_registered": float(len(found))}
    return replace(outcome, evidence={**outcome.evidence, **told})


def overlapping(visual: Scene, thermal: Scene) -> list[tuple[View, View]]:
    """For thermal photos spread over the map, the visual photo that shows most of each."""
    views = [v for v in thermal.ground.views if v.photo in thermal.alignment.held]
    chosen = (
        [views[k] for k in np.unique(np.linspace(0, len(views) - 1, MOST_PAIRS).astype(int))] if views else []
    )
    shift = np.subtract(thermal.alignment.frame.origin, visual.alignment.frame.origin)
    found = []
    for view in chosen:
        shares = [_share(v.footprint, view.footprint + shift) for v in visual.ground.views]
        if shares and max(shares) > LEAST_OVERLAP:
            found.append((visual.ground.views[int(np.argmax(shares))], view))
    return found


def _share(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Share of outline b that outline a covers; both nearly convex."""
    hulls = [cv2.convexHull((o - b.mean(0)).astype(np.float32)) for o in (a, b)]
    return float(cv2.intersectConvexConvex(*hulls)[0] / max(cv2.contourArea(hulls[1]), 1e-9))


def _registered(visual: Scene, thermal: Scene, a: View, b: View) -> PairPoints | None:
    """Correspondences of one pair in px of both maps; None where it cannot be registered."""
    one, other = (
        open_picture(s.taken.photos[v.photo].path) for s, v in ((visual, a), (thermal, b))
    )  # fmt: skip
    if isinstance(one, RejectedPhoto) or isinstance(other, RejectedPhoto):
        return None
    guess = _guess(visual, thermal, a, b)
    if guess is None:
        return None
    small = np.linalg.inv(other.full_S_picture) @ guess.b_H_a @ one.full_S_picture
    outcome = outcome_of(one, other, "auto", replace(guess, b_H_a=small / small[2, 2]))
    if not isinstance(outcome, Registration):
        return None
    return PairPoints(
        a=a.photo, b=b.photo, px_a=_on_map(visual, a, outcome.px_a), px_b=_on_map(thermal, b, outcome.px_b)
    )


def _guess(visual: Scene, thermal: Scene, a: View, b: View) -> Guess | None:
    """Where the adjustments of both blocks, each placed by its own positions, put the pair."""
    px_b = _grid(b)
    ground = on_ground(b, px_b, thermal.ground.surface)
    ground[:, :2] += np.subtract(thermal.alignment.frame.origin, visual.alignment.frame.origin)
    ground[:, 2] = visual.ground.surface.at(ground[:, 0], ground[:, 1])
    px_a = project(a.camera, a.pose.to_camera(ground))
    known = np.isfinite(px_a).all(1)
    matrix = fit("similarity", px_a[known], px_b[known]) if known.sum() > 3 else None
    if matrix is None:
        return None
    reach = _REACH_M * b.camera.focal / max(float(b.pose.map_C[2] - np.median(thermal.ground.surface.z)), 1.0)
    return Guess(
        b_H_a=matrix, reach=min(0.5, reach / max(b.camera.width, b.camera.height)),
        source="the adjustments of both flights",
    )  # fmt: skip


def _grid(view: View) -> NDArray[np.float64]:
    x, y = (np.linspace(0.1, 0.9, _GRID) * n for n in (view.camera.width, view.camera.height))
    gx, gy = np.meshgrid(x, y)
    return np.column_stack([gx.ravel(), gy.ravel()]).astype(np.float64)


def _on_map(scene: Scene, view: View, px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels of a photo in px of its own map."""
    ground = on_ground(view, px, scene.ground.surface)
    return np.stack(scene.ground.grid.pixel(ground[:, 0], ground[:, 1]), 1)
