"""Photos of one camera that are enlarged by other factors than their metadata tell: digital zooms,
crops. Taken for one camera's, they look like lower flights, and relief bends the map.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.photo import Photo, Zoom
from skyquilt.model.poses import Alignment, Prior

FEWEST = 3
"""Photos of a group at least."""
APART = 1.1
"""Factor between groups at least: less is the accuracy of heights."""
CALM = 0.25
"""Scatter within each group, as a share of the logarithm of that factor, at most; evenly spread
heights have 0.29.
"""
CONTRADICTED = 5.0
"""Means of heights told that differ by so many of their deviations from those of the adjustment
contradict these.
"""
MOST_GROUPS, GAPS = 4, 12
"""Groups of a camera at most, and the largest gaps between its heights that may divide them."""
BETTER = 0.98
"""Groups are calibrated by themselves where the mean residual falls below this share, and no tie
points are lost: over level ground, or of flights at several heights, it hardly changes.
"""
SIGMA = 0.05
"""Deviation of a group's focal length, as a share, beside what is stated of the camera's."""
NAMED = "enlarged"
"""In the name of a group's camera."""


def heights_above_ground(
    found: Alignment, priors: Sequence[Prior]
) -> tuple[dict[int, float], dict[int, float]]:
    """Heights in m of connected photos (index) above the median tie point: by the adjustment, and
    as reported, of those that report theirs, less what these are off in the median. There must be
    tie points.
    """
    ground = float(np.median(found.ties.xyz[:, 2]))
    C = {i: found.poses[i].map_C[2] for i in found.held}
    told = {i: priors[i].map_C[2] for i in found.held if np.isfinite(priors[i].map_C[2])}
    shift = float(np.median([C[i] - z for i, z in told.items()] or [0.0]))
    return {i: z - ground for i, z in C.items()}, {i: z + shift - ground for i, z in told.items()}


def enlarged_photos(
    found: Alignment, cameras: Sequence[str], priors: Sequence[Prior]
) -> dict[int, float]:
    """The factor by which each photo (index) looks enlarged against the least enlarged ones of its
    camera; only of those that do. Heights by the adjustment fall into groups then that those told
    contradict, where most photos tell theirs, or those over these do. `cameras`: names, of each
    photo.
    """
    if not len(found.ties.xyz):
        return {}
    height, told = heights_above_ground(found, priors)
    factors = dict[int, float]()
    for name in dict.fromkeys(cameras[i] for i in height):
        own = [i for i in height if cameras[i] == name and height[i] > 0]
        if 2 * len([i for i in own if i in told]) > len(own):
            own = [i for i in own if told.get(i, 0.0) > 0]
            ratio = np.array([height[i] / told[i] for i in own])
        else:
            ratio = np.array([height[i] for i in own])
        if len(own) < 2 * FEWEST or any(found.camera(i).fisheye for i in own):
            continue
        alone = np.log([height[i] for i in own])
        group = _told_alike(np.log(ratio), _groups(alone))
        group = group if group.any() else _groups(np.log(ratio))
        if _loose(alone, group):
            continue
        middle = [float(np.median(ratio[group == k])) for k in range(group.max() + 1)]
        factors |= {i: middle[-1] / middle[k] for i, k in zip(own, group.tolist(), strict=True)}
    return {i: f for i, f in factors.items() if f > 1}


def as_enlarged(photos: Sequence[Photo], factors: Mapping[int, float]) -> list[Photo]:
    """The photos, those that are enlarged as of a camera of their own."""
    out = list(photos)
    for i, factor in factors.items():
        focal, before = photos[i].focal, photos[i].zoom
        known = before or Zoom(camera=photos[i].camera_key, factor=1.0)
        px = focal.px * factor
        sigma = float(np.hypot(focal.sigma_px * factor, SIGMA * px))
        out[i] = replace(
            photos[i],
            camera_key=f"{photos[i].camera_key} {NAMED} {factor:.2f}",
            focal=replace(focal, px=px, sigma_px=sigma),
            zoom=replace(known, factor=known.factor * factor, sigma=SIGMA),
            calibration=None,
            shown_lens=None,
        )
    return out


def misfit_px(found: Alignment) -> float:
    """Mean distance in px between where photos show tie points and where they project; infinite
    without any tie point: photos of one place.
    """
    if not len(found.ties.residual_px):
        return np.inf
    return float(np.linalg.norm(found.ties.residual_px, axis=1).mean())


def fits_better(
    other: Alignment, found: Alignment, *, kept: float = 1.0, share: float = BETTER
) -> bool:
    """Whether an alignment fits the pictures clearly better than another, by a mean residual below
    this share, with no fewer photos and at least the share `kept` of the observations.
    """
    whole = len(other.held) >= len(found.held)
    whole &= len(other.ties.photo) >= kept * len(found.ties.photo)
    return whole and misfit_px(other) < share * misfit_px(found)


def enlarged_note(factors: Mapping[int, float], cameras: Sequence[str]) -> str:
    """What the user is told."""
    groups = dict[tuple[str, float], int]()
    for i, factor in factors.items():
        groups[cameras[i], factor] = groups.get((cameras[i], factor), 0) + 1
    listed = "; ".join(
        f"{n} of {name} by {factor:.2f}" for (name, factor), n in sorted(groups.items())
    )
    return (
        "Some photos show the ground larger than others of their camera, and their metadata do not"
        f" tell why (a digital zoom or a crop): {listed}. They are calibrated by themselves."
    )


def _groups(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """The group of each of some values (n,), ascending with them; all 0 where they form none."""
    order = np.argsort(values)
    rising = values[order]
    gaps = np.diff(rising)
    inner = np.arange(FEWEST - 1, len(gaps) - FEWEST + 1)
    widest = np.sort(inner[np.argsort(-gaps[inner], kind="stable")[:GAPS]])
    for count in range(2, MOST_GROUPS + 1):
        best = min(
            (c for c in combinations(widest.tolist(), count - 1)),
            key=lambda c: _scatter(rising, c),
            default=None,
        )
        if best is not None and _scatter(rising, best) <= CALM:
            group = np.empty(len(values), np.int64)
            group[order] = np.searchsorted(best, np.arange(len(values)), side="left")
            return group
    return np.zeros(len(values), np.int64)


def _told_alike(ratios: NDArray[np.float64], group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Groups of heights by the adjustment, where those told contradict each step from one to the
    next (`ratios`: logarithms of one over the other): they scatter too much to form groups
    themselves, but their means do not. All 0 otherwise: flights at several heights.
    """
    parts = [ratios[group == k] for k in range(int(group.max()) + 1)]
    for low, high in pairwise(parts):
        error = np.hypot(low.std(ddof=1) / len(low) ** 0.5, high.std(ddof=1) / len(high) ** 0.5)
        if not high.mean() - low.mean() > max(np.log(APART), CONTRADICTED * error):
            return np.zeros_like(group)
    return group


def _loose(values: NDArray[np.float64], group: NDArray[np.int64]) -> bool:
    """Whether heights by the adjustment alone are not grouped that way: then those told are."""
    order = np.argsort(group, kind="stable")
    last = np.flatnonzero(np.diff(group[order]))
    return bool(len(last)) and _scatter(values[order], last.tolist()) > 2 * CALM


def _scatter(rising: NDArray[np.float64], last: Sequence[int]) -> float:
    """Largest scatter within a group over the least distance of their means; infinite where groups
    are too small or too close. `last`: the last value of each group but the highest.
    """
    parts = np.split(rising, np.array(last, np.int64) + 1)
    apart = float(np.diff([p.mean() for p in parts]).min())
    if min(map(len, parts)) < FEWEST or apart < np.log(APART):
        return float(np.inf)
    return float(max(p.std() for p in parts)) / apart
