"""Picture-points on parallel lines over one area: how many, and where.

A place on the ground has to lie in `n` consecutive photos of a line and in photos of `m`
neighbouring lines. On flat ground a photo sees a window of length L along the line and of width W
across it. With points at most d = min((1 - overlap) L, L / n) apart, an interval of length A is
seen n times everywhere, its ends included, by

    N(A) = max(1, ceil(A / d)) + n - 1

points: the fewest, since the windows of any n - 1 of them that do not reach an end leave it short.
They exceed the interval by the margin L / 2 - d at both ends. Across the lines the same holds with
W, m and e = min((1 - sidelap) W, W / m).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from shapely import Polygon, clip_by_rect
from shapely.affinity import affine_transform
from shapely.geometry.base import BaseGeometry

from skyquilt.planning.records import Array

TINY = 1e-9


@dataclass(frozen=True, kw_only=True)
class Steps:
    """Windows and distances of a lattice in m."""

    along: float
    """Length L of the window."""
    across: float
    """Width W of the window."""
    step: float
    """Largest distance d of points on a line."""
    spacing: float
    """Largest distance e of lines."""
    n: int
    """Views along a line."""
    m: int
    """Lines that see a place."""


def steps_of(
    along: float, across: float, overlap: float, sidelap: float, views: int | None
) -> Steps:
    """The widest lattice with these overlaps (percent) that gives the number of views."""
    f, s = 1 - overlap / 100, 1 - sidelap / 100
    n, m = math.floor(1 / f + 1e-6), math.floor(1 / s + 1e-6)
    while views is not None and n * m < views:
        # the direction whose distance shrinks less
        if min(f, 1 / (n + 1)) / min(f, 1 / n) >= min(s, 1 / (m + 1)) / min(s, 1 / m):
            n += 1
        else:
            m += 1
    return Steps(
        along=along,
        across=across,
        step=min(f * along, along / n),
        spacing=min(s * across, across / m),
        n=n,
        m=m,
    )


def needed(length: float, step: float, n: int) -> int:
    """Number of points N(A) that see an interval n times."""
    return max(1, math.ceil(length / step - 1e-6)) + n - 1


def placed(low: float, high: float, step: float, n: int, window: float) -> Array:
    """The points (N,) of an interval, evenly, as close to it as its n views allow."""
    length = max(high - low, 0.0)
    count = needed(length, step, n)
    gaps = count - n + 1
    even = length / gaps
    if length < step:  # one gap: the points may lie further apart than the interval is long
        even = min(step, (window - length) / max(n - 1, 1)) if n > 1 else step
    middle = (low + high) / 2
    return np.asarray(middle + (np.arange(count) - (count - 1) / 2) * even)


def turned(shape: BaseGeometry, heading: float) -> BaseGeometry:
    """A shape with u along a heading (degrees from north) and v to its right."""
    s, c = math.sin(math.radians(heading)), math.cos(math.radians(heading))
    return affine_transform(shape, [s, c, c, -s, 0, 0])


def to_uv(xy: Array, heading: float) -> Array:
    """Places (n, 2) along (u) and to the right of (v) a heading; its own inverse."""
    s, c = np.sin(np.radians(heading)), np.cos(np.radians(heading))
    return np.asarray(xy @ np.array([[s, c], [c, -s]]))


def _bands(area: BaseGeometry, steps: Steps, phase: float) -> Iterator[tuple[float, float, float]]:
    """Each line's v and the u intervals that it has to see; `area` in the lattice's frame."""
    left, low, right, high = area.bounds
    lines = placed(low, high, steps.spacing, steps.m, steps.across)
    if phase:
        count = len(lines) + 1
        lines = (low + high) / 2 + (np.arange(count) - (count - 1) / 2) * steps.spacing
        lines = lines + (phase - 0.5) * steps.spacing
    for v in lines.tolist():
        half = steps.across / 2
        band = clip_by_rect(area, left - 1, v - half, right + 1, v + half)
        for a, b in _intervals(band, steps):
            yield v, a, b


def _intervals(band: BaseGeometry, steps: Steps) -> list[tuple[float, float]]:
    """The u intervals of the parts of a band; those are joined between which a gap saves no
    photo.
    """
    parts = [p.bounds for p in getattr(band, "geoms", [band]) if not p.is_empty]
    spans = sorted((b[0], b[2]) for b in parts)
    joined: list[tuple[float, float]] = []
    for a, b in spans:
        if joined:
            last = joined[-1]
            whole = max(last[1], b)
            apart = needed(last[1] - last[0], steps.step, steps.n) + needed(
                b - a, steps.step, steps.n
            )
            if a <= last[1] or needed(whole - last[0], steps.step, steps.n) <= apart:
                joined[-1] = (last[0], whole)
                continue
        joined.append((a, b))
    return joined


def count(area: Polygon, heading: float, steps: Steps, phase: float = 0.0) -> int:
    """Number of points that an area needs at a heading."""
    bands = _bands(turned(area, heading), steps, phase)
    return sum(needed(b - a, steps.step, steps.n) for _, a, b in bands)


def runs(area: Polygon, heading: float, steps: Steps, phase: float = 0.0) -> list[Array]:
    """The points of each run of a line, (k, 2) in the zone."""
    return [
        to_uv(np.column_stack([u, np.full(len(u), v)]), heading)
        for v, a, b in _bands(turned(area, heading), steps, phase)
        for u in [placed(a, b, steps.step, steps.n, steps.along)]
    ]


def headings(area: Polygon) -> list[float]:
    """Headings worth trying, 0 to 180 degrees: of the edges of the convex hull, of the smallest
    rectangle, and every ten degrees.
    """
    hull = np.array(area.convex_hull.exterior.coords)
    rectangle = np.array(area.minimum_rotated_rectangle.exterior.coords)
    found = set(np.arange(0.0, 180.0, 10.0).tolist())
    for ring in (hull, rectangle):
        edges = np.diff(ring, axis=0)
        edges = edges[np.argsort(-np.linalg.norm(edges, axis=1))[:12]]
        found |= set(np.round(np.degrees(np.arctan2(edges[:, 0], edges[:, 1])) % 180, 3).tolist())
    found |= {round((h + 90) % 180, 3) for h in list(found)}
    return sorted(found)


def best(area: Polygon, steps: Steps) -> tuple[int, float, float]:
    """The fewest points of one lattice over an area, with its heading and phase."""
    tried = [(count(area, h, steps), h, 0.0) for h in headings(area)]
    fine = min(tried)[1]
    tried += [(count(area, (fine + d) % 180, steps), (fine + d) % 180, 0.0)
              for d in (-5, -2, 2, 5)]  # fmt: skip
    leading = [h for _, h, _ in sorted(tried)[:4]]
    tried += [(count(area, h, steps, p), h, p) for h in leading for p in (0.25, 0.5, 0.75, 1.0)]
    return min(tried, key=lambda t: (t[0], t[2], t[1]))
