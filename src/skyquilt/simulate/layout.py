"""The plan of the terrain as vectors: parcels, roads, and objects."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from skyquilt.simulate.grid import Doubles

KINDS = (
    "meadow",
    "yard",
    "crop",
    "wood",
    "wheat",
    "yard",
    "bare",
    "orchard",
    "maize",
    "pond",
    "stubble",
    "yard",
    "crop",
    "meadow",
    "wood",
    "wheat",
)
"""Land uses of parcels, in the order in which they are assigned to the shuffled parcels."""

_SMALL_M2 = 2600.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Parcel:
    """A piece of land with one use."""

    kind: str
    """One of `KINDS`."""
    outline: Doubles
    """(n, 2) map polygon, m."""
    rows_deg: float
    """Direction of crop rows, degrees from map x."""
    shade: float
    """Brightness of this parcel, about 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Road:
    """A road along parcel borders."""

    line: Doubles
    """(n, 2) map polyline, m."""
    width: float
    """m."""
    paved: bool
    """Asphalt, else gravel."""


@dataclass(frozen=True, kw_only=True)
class House:
    """A building."""

    x: float
    """Map x of the centre, m."""
    y: float
    """Map y, m."""
    angle_deg: float
    """Direction of the long side, degrees from map x."""
    length: float
    """m."""
    depth: float
    """m."""
    eave: float
    """Height of the eaves above ground, m."""
    rise: float
    """Height of the ridge above the eaves, m; 0 is a flat roof."""
    roof: int
    """Index of the roof covering."""


@dataclass(frozen=True, kw_only=True)
class Tree:
    """A tree or a bush."""

    x: float
    """Map x, m."""
    y: float
    """Map y, m."""
    radius: float
    """Radius of the crown, m."""
    height: float
    """m."""
    conifer: bool
    """True for a cone, False for a dome."""
    tint: float
    """Brightness of the leaves, about 1."""


@dataclass(frozen=True, kw_only=True)
class Car:
    """A parked car."""

    x: float
    """Map x, m."""
    y: float
    """Map y, m."""
    angle_deg: float
    """Degrees from map x."""
    paint: int
    """Index of the colour."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """All objects on the ground."""

    parcels: tuple[Parcel, ...] = ()
    """Parcels; they cover the whole area."""
    roads: tuple[Road, ...] = ()
    """Roads; paved ones last, so that they are painted over tracks."""
    houses: tuple[House, ...] = ()
    """Buildings."""
    trees: tuple[Tree, ...] = ()
    """Trees and bushes."""
    cars: tuple[Car, ...] = ()
    """Cars."""
    ponds: tuple[Doubles, ...] = field(default=())
    """Outlines of the ponds, (n, 2) map polygons."""

    def on(self, stands: Callable[[float, float], bool]) -> "Layout":
        """With those houses, trees and cars only for whose place (x, y) `stands` is true, and the
        ponds all of whose shore it is true for.
        """
        return replace(
            self,
            houses=tuple(h for h in self.houses if stands(h.x, h.y)),
            trees=tuple(t for t in self.trees if stands(t.x, t.y)),
            cars=tuple(c for c in self.cars if stands(c.x, c.y)),
            ponds=tuple(p for p in self.ponds if all(stands(float(x), float(y)) for x, y in p)),
        )


@dataclass(frozen=True, kw_only=True)
class Frame:
    """The direction of parcels, slightly bent so that no border is exactly straight."""

    angle: float
    """Rotation, rad."""
    bend: float = 5.0
    """Amplitude of the bend, m."""

    def place(self, points: Doubles) -> Doubles:
        """Converts plan coordinates (n, 2) to map coordinates (n, 2)."""
        a, b = points[:, 0], points[:, 1]
        a = a + self.bend * np.sin(b / 61.0 + 0.7) + 0.4 * self.bend * np.sin(b / 23.0)
        b = b + self.bend * np.sin(a / 71.0 + 2.1) + 0.4 * self.bend * np.sin(a / 27.0 + 1)
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.stack([c * a - s * b, s * a + c * b], axis=1)


def dense(points: Doubles, step: float = 4.0) -> Doubles:
    """The polyline (n, 2) with a vertex every `step` m."""
    parts = []
    for start, end in pairwise(points):
        n = max(int(np.hypot(*(end - start)) / step), 1)
        parts.append(start + (end - start) * (np.arange(n) / n)[:, None])
    return np.concatenate([*parts, points[-1:]])


def rectangle(a0: float, b0: float, a1: float, b1: float) -> Doubles:
    """A closed outline (5, 2)."""
    return np.array([[a0, b0], [a1, b0], [a1, b1], [a0, b1], [a0, b0]])


@dataclass(frozen=True, kw_only=True, eq=False)
class Lot:
    """A rectangle of the plan before the transformation to the map."""

    box: tuple[float, float, float, float]
    """a0, b0, a1, b1, m."""


def divide(
    box: tuple[float, float, float, float],
    rng: np.random.Generator,
    cuts: list[tuple[Doubles, float]],
) -> list[Lot]:
    """Divides a box repeatedly until its parts have the size of fields; appends each cut to `cuts`
    with the length of the divided side.
    """
    a0, b0, a1, b1 = box
    long_, short = max(a1 - a0, b1 - b0), min(a1 - a0, b1 - b0)
    if long_ * short < _SMALL_M2 * rng.uniform(0.8, 1.8):
        return [Lot(box=box)]
    share = rng.uniform(0.38, 0.62)
    if a1 - a0 >= b1 - b0:
        a = a0 + share * (a1 - a0)
        halves, line = ((a0, b0, a, b1), (a, b0, a1, b1)), np.array([[a, b0], [a, b1]])
    else:
        b = b0 + share * (b1 - b0)
        halves, line = ((a0, b0, a1, b), (a0, b, a1, b1)), np.array([[a0, b], [a1, b]])
    cuts.append((line, long_))
    return divide(halves[0], rng, cuts) + divide(halves[1], rng, cuts)
