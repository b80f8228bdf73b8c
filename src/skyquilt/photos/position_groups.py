"""Groups of positions that lie far apart: a wrong position, or a second site."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.photo import Photo

FAR_M = 5_000.0
FAR_STEPS = 20.0
"""A gap is longer than FAR_M and longer than so many times the way from a photo to the nearest."""
_EARTH_M = 111_320.0 * 180 / np.pi
Array = NDArray[np.float64]


def groups(photos: Sequence[Photo]) -> list[list[int]]:
    """Indices of the photos with positions, in groups with a gap around each; the largest first,
    of equal ones the one that began first.
    """
    placed = [i for i, p in enumerate(photos) if p.position]
    if not placed:
        return []
    xyz = on_sphere(photos)
    limit = max(FAR_M, FAR_STEPS * _usual_step(xyz))
    rest, found = np.arange(len(placed)), list[list[int]]()
    while len(rest):
        reached, rest, done = [int(rest[0])], rest[1:], 0
        while done < len(reached) and len(rest):
            near = np.linalg.norm(xyz[rest] - xyz[reached[done]], axis=1) <= limit
            reached += rest[near].tolist()
            rest, done = rest[~near], done + 1
        found.append(sorted(placed[k] for k in reached))
    return sorted(found, key=lambda g: (-len(g), g[0]))


def on_sphere(photos: Sequence[Photo]) -> Array:
    """Positions (n, 3) in m on a sphere, of those photos that have one: distances between them
    do not depend on the pole or on the meridian of 180 degrees.
    """
    places = [(p.position.latitude_deg, p.position.longitude_deg) for p in photos if p.position]
    north, east = np.radians(np.array(places, np.float64).reshape(-1, 2)).T
    flat = np.cos(north)
    return _EARTH_M * np.stack([flat * np.cos(east), flat * np.sin(east), np.sin(north)], 1)


def _usual_step(xyz: Array) -> float:
    """Median distance in m from a position to the nearest of some neighbours in capture order."""
    reach = range(1, min(len(xyz), 4))
    steps = np.full((len(xyz), 2 * len(reach)), np.inf)
    for k in reach:
        apart = np.linalg.norm(xyz[k:] - xyz[:-k], axis=1)
        steps[k:, 2 * k - 2], steps[:-k, 2 * k - 1] = apart, apart
    return float(np.median(steps.min(1))) if len(xyz) > 1 else 0.0


def spread_m(photos: Sequence[Photo]) -> float:
    """Largest distance in m of positions to their middle."""
    return float(distances_to_median(photos).max())


def distances_to_median(photos: Sequence[Photo]) -> Array:
    """Distances (n,) in m of placed photos to the median of their positions."""
    xyz = on_sphere(photos)
    return np.asarray(np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1))
