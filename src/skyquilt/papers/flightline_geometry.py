"""Flight lines from positions, and pairs across neighbouring lines (A 2.1, 2.2, 2.4)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BINS = 9
"""Intervals of the histogram of shooting distances."""
BELOW, ABOVE = 2, 5
"""Number of interval widths below and above the most frequent distance that belong to a line
(A 2).
"""
TURN_DEG = 45.0
"""Change of course that ends a line, for the extension by heading."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shooting:
    """Distances between photos taken one after the other."""

    distance_m: Array
    """(n - 1,) in m."""
    commonest_m: float
    """Mean of the interval with the most of them, in m."""
    width_m: float
    """Width of an interval in m (A 1)."""

    @property
    def range_m(self) -> tuple[float, float]:
        """Distances within one line in m (A 2)."""
        return self.commonest_m - BELOW * self.width_m, self.commonest_m + ABOVE * self.width_m


def shooting_distances(xy: Array) -> Shooting:
    """The histogram of distances of photos (n, 2) m in order of capture (A 2.1)."""
    d = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    width = float(d.max() - d.min()) / BINS
    if width < 1e-6 * d.max():  # all distances equal, except for rounding: no histogram
        return Shooting(distance_m=d, commonest_m=float(d[0]), width_m=0.0)
    count, edges = np.histogram(d, bins=BINS)
    k = int(np.argmax(count))
    inside = (d >= edges[k]) & ((d < edges[k + 1]) | (k == BINS - 1))
    return Shooting(distance_m=d, commonest_m=float(d[inside].mean()), width_m=width)


def by_distance(xy: Array) -> list[list[int]]:
    """Lines of photos (n, 2) m in order of capture: a new one wherever a distance lies out of
    range.
    """
    shooting = shooting_distances(xy)
    low, high = shooting.range_m
    slack = 1e-9 * max(high, 1.0)
    breaks = (shooting.distance_m < low - slack) | (shooting.distance_m > high + slack)
    return _cut(len(xy), np.flatnonzero(breaks) + 1)


def by_heading(xy: Array) -> list[list[int]]:
    """Lines where the course must stay within 45 degrees of the line's: an extension of the method.

    A step belongs to a line if it is not longer than A's range and follows the direction of the
    line so far. A lower limit is not applied: positions have errors of metres, and a step back is
    detected by the course. At a turn, the photo that ends one line does not start the next one;
    that starts with the end of the step.
    """
    shooting = shooting_distances(xy)
    # if all distances are equal, their range is no wider than the noise of positions
    high = max(shooting.range_m[1], 1.5 * shooting.commonest_m)
    step = np.diff(xy, axis=0)
    lines: list[list[int]] = [[0]]
    for k, s in enumerate(step):
        line = lines[-1]
        within = bool(shooting.distance_m[k] <= high + 1e-9)
        if len(line) > 1 and within:
            course = xy[line[-1]] - xy[line[max(0, len(line) - 7)]]
            within = float(course @ s) > np.cos(np.radians(TURN_DEG)) * np.linalg.norm(
                course
            ) * np.linalg.norm(s)
        if within:
            line.append(k + 1)
        else:
            lines.append([k + 1])
    return lines


def _cut(count: int, starts: NDArray[Any]) -> list[list[int]]:
    return [part.tolist() for part in np.split(np.arange(count), starts)]


def reversals(xy: Array, line: Sequence[int]) -> int:
    """How often the course along a line turns by more than a right angle, which distances alone do
    not show.
    """
    step = np.diff(xy[list(line)], axis=0)
    return int(((step[1:] * step[:-1]).sum(1) < 0).sum())


def pairs_across(xy: Array, lines: Sequence[Sequence[int]]) -> list[tuple[int, int]]:
    """Pairs of photos (i < j) of different lines: edges of the Delaunay triangulation, those of
    triangles with an obtuse angle removed (A 2.2).

    An edge is removed if any of its triangles is obtuse, as printed in A.
    """
    from scipy.spatial import Delaunay, QhullError  # imported here, since only flight lines need it

    line_of = {i: k for k, line in enumerate(lines) for i in line}
    used = np.array(sorted(line_of))
    try:
        triangles = used[Delaunay(xy[used]).simplices]
    except QhullError:
        return []
    kept: set[tuple[int, ...]] = set()
    gone: set[tuple[int, ...]] = set()
    for triangle in triangles:
        edges = {
            tuple(sorted((int(triangle[a]), int(triangle[b])))) for a, b in ((0, 1), (1, 2), (0, 2))
        }
        (gone if _obtuse(xy[triangle]) else kept).update(edges)
    return sorted((e[0], e[1]) for e in kept - gone if line_of[e[0]] != line_of[e[1]])


def _obtuse(corners: Array) -> bool:
    """Whether a triangle (3, 2) has an angle above 90 degrees."""
    for k in range(3):
        a, b = corners[(k + 1) % 3] - corners[k], corners[(k + 2) % 3] - corners[k]
        if float(a @ b) < -1e-9 * np.linalg.norm(a) * np.linalg.norm(b):
            return True
    return False


def middle_out(items: Sequence[int]) -> list[int]:
    """The middle one first, then its neighbours, alternating between both directions (A 2.4, Fig.
    6b).
    """
    middle = (len(items) - 1) // 2
    order = [items[middle]]
    for k in range(1, len(items)):
        order += [items[m] for m in (middle + k, middle - k) if 0 <= m < len(items)]
    return order
