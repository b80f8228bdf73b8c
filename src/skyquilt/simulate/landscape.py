"""Generates the landscape: divides it into parcels, and adds roads, buildings and trees."""

from dataclasses import replace

import numpy as np

from skyquilt.simulate.grid import Doubles
from skyquilt.simulate.layout import (
    KINDS,
    Car,
    Frame,
    House,
    Layout,
    Lot,
    Parcel,
    Road,
    Tree,
    dense,
    divide,
    rectangle,
)
from skyquilt.simulate.terrain import Terrain

_ESTATE_M = 400.0
"""Large areas are first divided into estates of this size, so that each estate has all land
uses.
"""


_USES = {
    "bare": ("bare", "stubble"),
    "town": ("yard", "yard", "yard", "meadow", "yard", "orchard"),
    "orchard": ("orchard",),
    "crops": ("crop", "maize"),
    "solar": ("panels",),
    "dunes": ("sand",),
}
"""Land uses of kinds of terrain that have others than `KINDS`."""


def landscape(
    bounds: tuple[float, float, float, float], seed: int, terrain: Terrain = "landscape"
) -> Layout:
    """The layout over map bounds (x0, y0, x1, y1) in m."""
    rng = np.random.default_rng([seed, 11])
    frame = Frame(angle=float(np.radians(rng.uniform(8, 28))))
    cuts: list[tuple[Doubles, float]] = []
    lots = [lot for estate in _estates(bounds) for lot in _shuffled(divide(estate, rng, cuts), rng)]
    uses = _USES.get(terrain, KINDS)
    kinds = [uses[i % len(uses)] for i in range(len(lots))]
    parcels = tuple(_parcel(lot, kind, frame, rng) for lot, kind in zip(lots, kinds, strict=True))
    houses, trees, cars = _furnish(lots, kinds, frame, rng)
    if terrain == "town":
        houses = [_block(house, rng) for house in houses]
    roads = () if terrain in ("dunes", "solar") else _roads(cuts, frame)
    trees += _avenue(roads, rng)
    ponds = tuple(
        _shore(lot, frame, rng) for lot, kind in zip(lots, kinds, strict=True) if kind == "pond"
    )
    return Layout(
        parcels=parcels,
        roads=roads,
        houses=tuple(houses),
        trees=tuple(trees),
        cars=tuple(cars),
        ponds=ponds,
    )


def _estates(bounds: tuple[float, float, float, float]) -> list[tuple[float, float, float, float]]:
    """Rectangles of the plan that cover the bounds after rotation."""
    x0, y0, x1, y1 = bounds
    reach = 0.5 * float(np.hypot(x1 - x0, y1 - y0)) + max(abs(x0 + x1), abs(y0 + y1)) / 2 + 20
    n = max(1, round(2 * reach / _ESTATE_M))
    side = 2 * reach / n
    return [
        (-reach + i * side, -reach + j * side, -reach + (i + 1) * side, -reach + (j + 1) * side)
        for j in range(n)
        for i in range(n)
    ]


def _shuffled(lots: list[Lot], rng: np.random.Generator) -> list[Lot]:
    """Lots in random order, but central ones first, so that small sites contain every land use."""
    middle = np.mean([lot.box for lot in lots], axis=0)
    far = [
        float(
            np.hypot(
                *(np.mean([lot.box[:2], lot.box[2:]], axis=0) - middle[:2] / 2 - middle[2:] / 2)
            )
        )
        for lot in lots
    ]
    order = np.argsort(np.array(far) + rng.uniform(0, 30, len(lots)))
    return [lots[i] for i in order]


def _parcel(lot: Lot, kind: str, frame: Frame, rng: np.random.Generator) -> Parcel:
    a0, b0, a1, b1 = lot.box
    along = 0.0 if a1 - a0 >= b1 - b0 else 90.0
    return Parcel(
        kind=kind,
        outline=frame.place(dense(rectangle(a0, b0, a1, b1))),
        rows_deg=float(np.degrees(frame.angle)) + along + rng.normal(0, 2),
        shade=float(rng.uniform(0.88, 1.1)),
    )


def _roads(cuts: list[tuple[Doubles, float]], frame: Frame) -> tuple[Road, ...]:
    """The longest cuts are roads, the next ones tracks."""
    roads = []
    for line, side in cuts:
        if side > 95:
            paved = side > 190
            roads.append(
                Road(line=frame.place(dense(line)), width=5.6 if paved else 3.0, paved=paved)
            )
    return tuple(sorted(roads, key=lambda road: road.paved))


def _furnish(
    lots: list[Lot], kinds: list[str], frame: Frame, rng: np.random.Generator
) -> tuple[list[House], list[Tree], list[Car]]:
    houses: list[House] = []
    trees: list[Tree] = []
    cars: list[Car] = []
    for lot, kind in zip(lots, kinds, strict=True):
        if kind == "yard":
            built, planted, parked = _yard(lot, frame, rng)
            houses, trees, cars = houses + built, trees + planted, cars + parked
        elif kind == "wood":
            trees += _grove(
                lot, frame, rng, spacing=4.2, jitter=1.6, radius=(1.8, 3.6), height=(7, 13)
            )
        elif kind == "orchard":
            trees += _grove(
                lot, frame, rng, spacing=6.0, jitter=0.25, radius=(1.5, 2.1), height=(3, 4.5)
            )
        elif kind in ("meadow", "pond"):
            trees += _scatter(lot, frame, rng, count=5)
    return houses, trees, cars


def _yard(
    lot: Lot, frame: Frame, rng: np.random.Generator
) -> tuple[list[House], list[Tree], list[Car]]:
    """Houses in an irregular row, each with a car and garden trees."""
    a0, b0, a1, b1 = lot.box
    houses, trees, cars = [], [], []
    for a in np.arange(a0 + 14, a1 - 10, 22):
        for b in np.arange(b0 + 13, b1 - 9, 21):
            x, y = _spot(frame, a + rng.uniform(-2, 2), b + rng.uniform(-2, 2))
            angle = float(np.degrees(frame.angle) + rng.choice([0, 90]) + rng.normal(0, 3))
            houses.append(_house(x, y, angle, rng))
            side = np.radians(angle + 90)
            away = houses[-1].depth / 2 + 2.6
            cx, cy = x + away * np.cos(side), y + away * np.sin(side)
            cars.append(
                Car(x=cx, y=cy, angle_deg=angle + rng.normal(0, 4), paint=int(rng.integers(5)))
            )
            for _ in range(rng.integers(1, 4)):
                tx, ty = _spot(frame, a + 10.5 * rng.choice([-1, 1]), b + rng.uniform(-9, 9))
                trees.append(_tree(tx, ty, rng, radius=(0.9, 2.4), height=(2, 6)))
    return houses, trees, cars


def _house(x: float, y: float, angle: float, rng: np.random.Generator) -> House:
    flat = rng.random() < 0.25
    return House(
        x=x,
        y=y,
        angle_deg=angle,
        length=float(rng.uniform(9, 14)),
        depth=float(rng.uniform(7, 9.5)),
        eave=float(rng.uniform(3, 5.5)),
        rise=0.0 if flat else float(rng.uniform(1.6, 2.8)),
        roof=4 if flat else int(rng.integers(4)),
    )


def _block(house: House, rng: np.random.Generator) -> House:
    """A block of flats or offices in place of a house; most have flat roofs."""
    flat = rng.random() < 0.6
    return replace(
        house,
        eave=float(rng.uniform(10, 32)),
        length=1.3 * house.length,
        depth=1.2 * house.depth,
        rise=0.0 if flat else max(house.rise, 1.6),
        roof=4 if flat else house.roof,
    )


def _grove(
    lot: Lot,
    frame: Frame,
    rng: np.random.Generator,
    *,
    spacing: float,
    jitter: float,
    radius: tuple[float, float],
    height: tuple[float, float],
) -> list[Tree]:
    """Trees on a grid with random offsets."""
    a0, b0, a1, b1 = lot.box
    margin = 4.0
    a, b = np.meshgrid(
        np.arange(a0 + margin, a1 - margin, spacing), np.arange(b0 + margin, b1 - margin, spacing)
    )
    plan = np.stack([a.ravel(), b.ravel()], axis=1)
    places = frame.place(plan + rng.normal(0, jitter, plan.shape))
    return [_tree(x, y, rng, radius=radius, height=height) for x, y in places]


def _scatter(lot: Lot, frame: Frame, rng: np.random.Generator, *, count: int) -> list[Tree]:
    """Single trees, mostly near the borders."""
    a0, b0, a1, b1 = lot.box
    trees = []
    for _ in range(count):
        a = rng.choice([a0 + 3, a1 - 3, rng.uniform(a0 + 4, a1 - 4)])
        x, y = _spot(frame, a, rng.uniform(b0 + 4, b1 - 4))
        trees.append(_tree(x, y, rng, radius=(1.2, 4.0), height=(3, 11)))
    return trees


def _avenue(roads: tuple[Road, ...], rng: np.random.Generator) -> list[Tree]:
    """Bushes and trees along tracks, with gaps."""
    trees = []
    for road in roads:
        if road.paved:
            continue
        direction = np.gradient(road.line, axis=0)
        normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        for x, y in (road.line + 4.2 * normal)[::2]:
            if rng.random() < 0.3:
                trees.append(_tree(x, y, rng, radius=(0.9, 2.6), height=(1.5, 8)))
    return trees


def _tree(
    x: float,
    y: float,
    rng: np.random.Generator,
    *,
    radius: tuple[float, float],
    height: tuple[float, float],
) -> Tree:
    size = rng.random()
    return Tree(
        x=float(x),
        y=float(y),
        radius=radius[0] + size * (radius[1] - radius[0]),
        height=height[0] + (0.7 * size + 0.3 * rng.random()) * (height[1] - height[0]),
        conifer=bool(rng.random() < 0.25 and height[1] > 6),
        tint=float(rng.uniform(0.8, 1.25)),
    )


def _shore(lot: Lot, frame: Frame, rng: np.random.Generator) -> Doubles:
    """Outline of a rounded pond in the middle of a lot."""
    a0, b0, a1, b1 = lot.box
    angle = np.linspace(0, 2 * np.pi, 90)
    phase = rng.uniform(0, 6, 3)
    wave = (
        1
        + 0.10 * np.sin(2 * angle + phase[0])
        + 0.08 * np.sin(3 * angle + phase[1])
        + 0.04 * np.sin(5 * angle)
    )
    half = 0.34 * np.array([a1 - a0, b1 - b0])
    ring = np.stack([half[0] * np.cos(angle), half[1] * np.sin(angle)], axis=1) * wave[:, None]
    return frame.place(ring + np.array([(a0 + a1) / 2, (b0 + b1) / 2]))


def _spot(frame: Frame, a: float, b: float) -> tuple[float, float]:
    x, y = frame.place(np.array([[a, b]]))[0]
    return float(x), float(y)
