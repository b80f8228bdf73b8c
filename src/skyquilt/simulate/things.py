"""Painters of objects: houses, trees, cars."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.simulate import materials as m
from skyquilt.simulate.canvas import Canvas
from skyquilt.simulate.grid import Floats
from skyquilt.simulate.ground import Ground
from skyquilt.simulate.layout import Car, House, Layout, Tree

Thing = TypeVar("Thing", Car, House, Tree)


def paint_things(canvas: Canvas, layout: Layout, ground: Ground) -> None:
    """Paints everything that rises above the ground, in the order cars, houses, trees."""
    for car in _near(canvas, layout.cars, 4.0):
        _car(canvas.part(car.x, car.y, 4.0), car, ground)
    for house in _near(canvas, layout.houses, 14.0):
        _house(canvas.part(house.x, house.y, 14.0), house, ground)
    largest = max((1.3 * tree.radius for tree in layout.trees), default=0.0)
    for tree in _near(canvas, layout.trees, largest):
        _tree(canvas.part(tree.x, tree.y, 1.3 * tree.radius), tree, ground)


def _near(canvas: Canvas, things: Sequence[Thing], reach: float) -> list[Thing]:
    places = np.array([(t.x, t.y) for t in things]).reshape(-1, 2)
    return [things[int(i)] for i in np.flatnonzero(canvas.near(places, reach))]


def _empty(canvas: Canvas) -> bool:
    return canvas.grid.width == 0 or canvas.grid.height == 0


def _raise(canvas: Canvas, cover: NDArray[np.bool_], height: Floats | float) -> None:
    canvas.height[...] = np.where(cover, np.maximum(canvas.height, height), canvas.height)


def _car(canvas: Canvas, car: Car, ground: Ground) -> None:
    if _empty(canvas):
        return
    a, b = canvas.local(car.x, car.y, car.angle_deg)
    level = ground.at(car.x, car.y)
    drive = (np.abs(a) < 3.4) & (np.abs(b) < 1.7)
    canvas.lay(m.PAVING, drive, 0.06 * canvas.fine + 0.03 * canvas.grain)
    canvas.height[drive] = canvas.ground[drive]
    body = (np.abs(a) < 2.15) & (np.abs(b) < 0.9)
    cabin = (a > -1.5) & (a < 0.8) & (np.abs(b) < 0.78)
    canvas.lay(m.CARS[car.paint], body, 0.02 * canvas.grain)
    canvas.lay(m.CARS[2], cabin & ~((a > -1.1) & (a < 0.4)))
    _raise(canvas, body, level + 0.9)
    _raise(canvas, cabin, level + 1.45)


def _house(canvas: Canvas, house: House, ground: Ground) -> None:
    if _empty(canvas):
        return
    a, b = canvas.local(house.x, house.y, house.angle_deg)
    half_a, half_b = house.length / 2, house.depth / 2
    out_a, out_b = np.abs(a) - half_a, np.abs(b) - half_b
    outside = np.maximum(out_a, out_b)
    terrace = (outside < 2.2) & (b > 0) & (np.abs(a) < half_a)
    canvas.lay(m.PAVING, terrace, 0.05 * canvas.fine + 0.03 * canvas.grain)
    canvas.height[terrace] = canvas.ground[terrace]
    canvas.lay(m.WALL, outside < 1.3 * canvas.grid.res, 0.03 * canvas.grain)
    roof = outside < 0
    tiles = 0.045 * np.sign(np.cos(b * (2 * np.pi / 0.36))) + 0.02 * np.cos(a * (2 * np.pi / 0.24))
    texture = (
        (tiles if house.rise else 0.0)
        + 0.035 * canvas.fine
        + 0.03 * canvas.grain
        + 0.05 * canvas.patchy
    )
    canvas.lay(m.ROOFS[house.roof], roof, texture)
    canvas.lay(m.GUTTER, roof & (outside > -0.12))
    top = ground.at(house.x, house.y) + house.eave + house.rise * (1 - np.abs(b) / half_b)
    _raise(canvas, roof, top)
    _details(canvas, house, a, b, top)


def _details(canvas: Canvas, house: House, a: Floats, b: Floats, top: Floats) -> None:
    """Ridge, chimney, and either solar panels or skylights."""
    half_a, half_b = house.length / 2, house.depth / 2
    if house.rise:
        canvas.lay(m.GUTTER, (np.abs(b) < 0.12) & (np.abs(a) < half_a), 0.05 * canvas.grain)
    chimney = (np.abs(a - 0.3 * half_a) < 0.4) & (np.abs(b - 0.35 * half_b) < 0.35)
    canvas.lay(m.ROOFS[1], chimney, 0.08 * canvas.grain)
    _raise(canvas, chimney, top + 1.0)
    if int(house.length * 100) % 3 == 0:
        panel = (np.abs(a + 0.2 * half_a) < 0.6 * half_a) & (
            np.abs(b + 0.5 * half_b) < 0.33 * half_b
        )
        seam = (np.mod(a, 1.0) < 0.06) | (np.mod(b, 1.65) < 0.06)
        canvas.lay(m.ROOFS[3], panel, np.where(seam, 0.7, -0.45).astype(np.float32))
    else:
        for where in (-0.5, 0.1):
            glass = (np.abs(a - where * half_a) < 0.4) & (np.abs(b + 0.5 * half_b) < 0.55)
            canvas.lay(m.CARS[2], glass, 0.3)


def _tree(canvas: Canvas, tree: Tree, ground: Ground) -> None:
    """A crown with an irregular edge and leaves in clumps."""
    if _empty(canvas):
        return
    a, b = canvas.local(tree.x, tree.y, 0.0)
    edge = tree.radius * (1 + 0.10 * canvas.patchy + 0.05 * canvas.fine)
    d = np.sqrt(a * a + b * b) / np.maximum(edge, 0.2)
    form = np.clip(1 - d, 0, 1) ** 0.85 if tree.conifer else np.sqrt(np.clip(1 - d * d, 0, 1))
    base = 0.15 if tree.conifer else 0.42
    clumps = (0.20 * canvas.fine + 0.06 * canvas.grain) * min(1.0, tree.height / 5)
    level = ground.at(tree.x, tree.y)
    height = level + tree.height * (base + (1 - base) * form) + clumps
    bare = canvas.weather.season == "winter" and not tree.conifer
    crown = (
        (d < 1) & (height > canvas.height) & ((canvas.fine + canvas.grain > 0.5) if bare else True)
    )
    texture = tree.tint * (0.62 + 0.42 * form) * (1 + 0.20 * canvas.fine + 0.10 * canvas.grain) - 1
    canvas.lay(
        m.CONIFER if tree.conifer else (m.TREE if tree.height > 3 else m.BUSH), crown, texture
    )
    _raise(canvas, crown, height)
