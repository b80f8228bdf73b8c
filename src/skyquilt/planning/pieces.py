"""Division of areas into pieces that have their own flight lines.

A concave area is cut along the extensions of the edges at its reflex corners, the cuts of an exact
cell decomposition (Choset 2000), as long as a cut saves photos; corridors are cut where they bend.
"""

from dataclasses import dataclass

import numpy as np
from shapely import LineString, Polygon
from shapely.ops import split

from skyquilt.planning.lattice import Steps, best
from skyquilt.planning.records import Area, Array

MOST_CUTS = 12
"""Largest number of reflex corners that are tried in a piece: those that turn most."""
DEEPEST = 5
"""Cuts in a row."""


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A part of the area with one lattice."""

    shape: Polygon
    """Its outline."""
    heading: float
    """Of its lines, degrees."""
    phase: float
    """Offset of its lines, in shares of their distance; 0 = evenly over the piece."""
    count: int
    """Points of its lattice."""


def pieces(area: Area, steps: Steps) -> list[Piece]:
    """The area divided so that its lattices have few points."""
    found = []
    for part in getattr(area, "geoms", [area]):
        found += _divided(_simple(part, steps), steps, DEEPEST)
    return found


def _simple(part: Polygon, steps: Steps) -> Polygon:
    """The outline without details that no lattice notices, never smaller than it was."""
    tolerance = 0.02 * min(steps.step, steps.spacing)
    if len(part.exterior.coords) + sum(len(r.coords) for r in part.interiors) < 60:
        return part
    grown = part.buffer(tolerance, join_style="mitre").simplify(tolerance)
    return grown if isinstance(grown, Polygon) and grown.is_valid else part


def _whole(part: Polygon, steps: Steps) -> Piece:
    number, heading, phase = best(part, steps)
    return Piece(shape=part, heading=heading, phase=phase, count=number)


def _divided(part: Polygon, steps: Steps, depth: int) -> list[Piece]:
    whole = _whole(part, steps)
    if depth == 0 or whole.count < 2 * steps.n * steps.m:
        return [whole]
    least, chosen = whole.count, None
    for halves in _cuts(part):
        pair = [_whole(h, steps) for h in halves]
        if sum(p.count for p in pair) < least:
            least, chosen = sum(p.count for p in pair), pair
    if chosen is None:
        return [whole]
    return [p for half in chosen for p in _divided(half.shape, steps, depth - 1)]


def _cuts(part: Polygon) -> list[list[Polygon]]:
    """The halves that each cut at a reflex corner gives."""
    found = []
    reach = 3 * float(np.hypot(*np.subtract(part.bounds[2:], part.bounds[:2])))
    for corner, ways in _reflex(part):
        for way in ways:
            cut = LineString([corner, corner + reach * way])
            inner = [g for g in getattr(cut.intersection(part), "geoms",
                                        [cut.intersection(part)])
                     if g.length > 0 and g.distance(cut.interpolate(0)) < 1e-6]  # fmt: skip
            if not inner:
                continue
            end = np.array(inner[0].coords[-1])
            line = LineString([corner - 1e-6 * reach * way, end + 1e-6 * reach * way])
            halves = [h for h in split(part, line).geoms if isinstance(h, Polygon)]
            if len(halves) == 2 and all(h.is_valid and h.area > 1e-3 for h in halves):
                found.append(halves)
    return found


def _reflex(part: Polygon) -> list[tuple[Array, list[Array]]]:
    """Corners where the outline turns outwards, most first, with the directions of cuts: both edges
    extended, and the line that halves the angle between them.
    """
    found = []
    for ring, sign in [(part.exterior, 1.0), *((r, -1.0) for r in part.interiors)]:
        xy = np.array(ring.coords)[:-1]
        if not ring.is_ccw:
            xy = xy[::-1]
        before, after = xy - np.roll(xy, 1, axis=0), np.roll(xy, -1, axis=0) - xy
        before = before / np.linalg.norm(before, axis=1, keepdims=True)
        after = after / np.linalg.norm(after, axis=1, keepdims=True)
        turn = sign * (before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])
        for k in np.flatnonzero(turn < -0.17):  # ten degrees
            ways = [before[k], -after[k]]
            middle = ways[0] + ways[1]
            if np.linalg.norm(middle) > 1e-6:
                ways.append(middle / np.linalg.norm(middle))
            found.append((float(turn[k]), xy[k], ways))
    found.sort(key=lambda f: f[0])
    return [(xy, ways) for _, xy, ways in found[:MOST_CUTS]]
