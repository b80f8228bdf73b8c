"""Painters of the land: parcels with their crops, borders, roads, ponds."""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.simulate import materials as m
from skyquilt.simulate.canvas import WARM_K, Canvas, Cells
from skyquilt.simulate.grid import Doubles, Floats
from skyquilt.simulate.layout import Layout, Parcel, Road
from skyquilt.simulate.terrain import WATER_M, Terrain, deck


@dataclass(frozen=True, kw_only=True)
class Cover:
    """Appearance of a land use."""

    material: m.Material
    """Its colour."""
    grain: float
    """Relative contrast from cell to cell."""
    fine: float
    """Contrast of tufts and clods."""
    patchy: float
    """Contrast of patches of metres."""
    spacing: float = 1.0
    """Distance of crop rows, m."""
    rows: float = 0.0
    """Contrast of crop rows."""
    height: float = 0.0
    """Height of the plants, m."""


COVERS = {
    "meadow": Cover(material=m.MEADOW, grain=0.05, fine=0.10, patchy=0.09),
    "yard": Cover(material=m.LAWN, grain=0.045, fine=0.06, patchy=0.07),
    "crop": Cover(
        material=m.CROP, grain=0.06, fine=0.08, patchy=0.06, spacing=0.75, rows=0.20, height=0.25
    ),
    "wood": Cover(material=m.WOOD_FLOOR, grain=0.09, fine=0.16, patchy=0.12),
    "wheat": Cover(
        material=m.WHEAT, grain=0.05, fine=0.05, patchy=0.06, spacing=2.4, rows=0.05, height=0.7
    ),
    "bare": Cover(material=m.BARE, grain=0.025, fine=0.03, patchy=0.035),
    "orchard": Cover(material=m.MEADOW, grain=0.05, fine=0.09, patchy=0.10, spacing=6.0, rows=0.07),
    "maize": Cover(
        material=m.MAIZE, grain=0.10, fine=0.10, patchy=0.06, spacing=0.8, rows=0.26, height=1.6
    ),
    "panels": Cover(material=m.MEADOW, grain=0.05, fine=0.08, patchy=0.08),
    "sand": Cover(
        material=m.SAND, grain=0.012, fine=0.010, patchy=0.012, spacing=0.9, rows=0.012, height=0.06
    ),
    "pond": Cover(material=m.MEADOW, grain=0.05, fine=0.11, patchy=0.12),
    "stubble": Cover(
        material=m.STUBBLE, grain=0.06, fine=0.07, patchy=0.06, spacing=1.6, rows=0.10, height=0.12
    ),
}


def paint_parcels(canvas: Canvas, layout: Layout) -> None:
    """Paints the ground of each parcel according to its use."""
    index = np.zeros(canvas.height.shape, dtype=np.int32)
    near = [p for p in layout.parcels if canvas.touches(p.outline, 1.0)]
    if not near:
        return
    for number, parcel in enumerate(near):
        cv2.fillPoly(index, [np.round(canvas.grid.pixels(parcel.outline)).astype(np.int32)], number)
    covers = [COVERS[p.kind] for p in near]
    texture = _texture(canvas, covers, index)
    colours = np.stack([_colour(c, p, canvas) for c, p in zip(covers, near, strict=True)])
    rows, height = _rows(canvas, near, covers, index)
    change = texture + rows
    for band in range(4):
        colour = colours[:, band][index]
        canvas.look[..., band] = colour * (1 + change) if band < 3 else colour + WARM_K * change
    canvas.height[...] += height


def _colour(cover: Cover, parcel: Parcel, canvas: Canvas) -> Floats:
    return cover.material.look(canvas.weather) * np.array(
        [parcel.shade] * 3 + [1.0], dtype=np.float32
    )


def _per_cell(values: list[float], index: NDArray[np.int32]) -> Floats:
    return np.array(values, dtype=np.float32)[index]


def _texture(canvas: Canvas, covers: list[Cover], index: NDArray[np.int32]) -> Floats:
    total = _per_cell([c.grain for c in covers], index) * canvas.grain
    total += _per_cell([c.fine for c in covers], index) * canvas.fine
    total += _per_cell([c.patchy for c in covers], index) * canvas.patchy
    return total + np.float32(0.045) * canvas.broad


def _rows(
    canvas: Canvas, parcels: list[Parcel], covers: list[Cover], index: NDArray[np.int32]
) -> tuple[Floats, Floats]:
    """Brightness and height of crop rows, with tractor tracks every 18 m."""
    angle = np.radians([p.rows_deg for p in parcels])
    x, y = canvas.grid.xs.astype(np.float32)[None, :], canvas.grid.ys.astype(np.float32)[:, None]
    across = _per_cell(list(-np.sin(angle)), index) * x + _per_cell(list(np.cos(angle)), index) * y
    across += np.float32(0.25) * canvas.broad
    contrast = _per_cell([c.rows for c in covers], index)
    wave = np.cos(across * _per_cell([2 * np.pi / c.spacing for c in covers], index))
    tall = _per_cell([c.height for c in covers], index)
    offset = np.abs(np.mod(across, 18.0) - np.float32(9.0))
    # ripples of sand have no tracks
    track = ((np.abs(offset - np.float32(0.9)) < 0.22) & (tall > 0.1)).astype(np.float32)
    gaps = np.clip(canvas.patchy - np.float32(1.9), 0, 1) * (contrast > 0.15)
    height = tall * (1 - track) * (0.75 + 0.25 * wave) + 0.12 * tall * canvas.fine
    return contrast * wave * (1 - track) + track * np.float32(0.16) + gaps * np.float32(
        0.35
    ), np.maximum(height, 0)


def paint_borders(canvas: Canvas, layout: Layout) -> None:
    """Paints irregular strips of grass between parcels."""
    for parcel in layout.parcels:
        if parcel.kind not in ("yard", "sand") and canvas.touches(parcel.outline, 2.0):
            strip = cv2.GaussianBlur(
                canvas.line(parcel.outline, 1.5), (0, 0), 0.25 / canvas.grid.res
            )
            cells = canvas.cells(strip > 0.02)
            share = np.clip((strip[cells.at] - 0.5 + 0.16 * cells.patchy) * 6 + 0.5, 0, 1)
            cells.lay(m.MEADOW, share, 0.08 * cells.fine + 0.05 * cells.grain + 0.08 * cells.patchy)
            cells.flatten(share)


def paint_roads(canvas: Canvas, layout: Layout) -> None:
    """Paints gravel tracks with a green middle, then asphalt: all shoulders, all lanes, all
    markings.
    """
    near = [road for road in layout.roads if canvas.touches(road.line, road.width)]
    for road in near:
        if not road.paved:
            _track(canvas, road)
    for layer in (_shoulder, _lanes, _marks):
        for road in near:
            if road.paved:
                layer(canvas, road)


def _shoulder(canvas: Canvas, road: Road) -> None:
    cells, share = _strip(canvas, canvas.line(road.line, road.width + 1.2))
    cells.lay(m.GRAVEL, share * 0.7, 0.10 * cells.fine + 0.08 * cells.grain)
    cells.flatten(share)


def _lanes(canvas: Canvas, road: Road) -> None:
    cells, share = _strip(canvas, canvas.line(road.line, road.width))
    texture = 0.018 * cells.grain + 0.02 * cells.fine + 0.035 * cells.patchy + 0.03 * cells.broad
    cells.lay(m.ASPHALT, share, texture)


def _marks(canvas: Canvas, road: Road) -> None:
    dashes = [dash for dash in _dashes(road.line)[1:-1] if canvas.touches(dash, 1.0)]
    if dashes:
        cells, share = _strip(canvas, canvas.line(dashes, 0.16))
        cells.lay(m.PAINT, share, 0.04 * cells.fine)


def _dashes(line: Doubles) -> list[Doubles]:
    """Segments of 2 m every 4 m along a line with a vertex every 4 m."""
    return [np.stack([a, a + 0.5 * (b - a)]) for a, b in pairwise(line)]


def _track(canvas: Canvas, road: Road) -> None:
    cells, share = _strip(canvas, canvas.line(road.line, road.width))
    cells.flatten(share)
    cells.lay(m.GRAVEL, share, 0.08 * cells.fine + 0.06 * cells.grain + 0.09 * cells.patchy)
    middle = cv2.GaussianBlur(canvas.line(road.line, 0.7), (0, 0), 0.12 / canvas.grid.res)
    cells, share = _strip(canvas, np.asarray(middle))
    share = np.clip(share * (0.8 + 0.5 * cells.patchy), 0, 1)
    cells.lay(m.MEADOW, share, 0.1 * cells.fine)


def _strip(canvas: Canvas, cover: Floats) -> tuple[Cells, Floats]:
    """The cells that a strip touches, and the shares (n,) that it covers of them."""
    cells = canvas.cells(cover > 0)
    return cells, np.asarray(cover[cells.at])


def paint_ponds(canvas: Canvas, layout: Layout) -> None:
    """Paints level, dark, nearly featureless water in a ring of reed."""
    for shore in layout.ponds:
        if not canvas.touches(shore, 3.0):
            continue
        cells, reed = _strip(canvas, canvas.line(np.vstack([shore, shore[:1]]), 2.2))
        reed = reed * (cells.patchy > -0.3)
        cells.lay(m.REED, reed, 0.2 * cells.fine + 0.12 * cells.grain)
        canvas.height[cells.at] += reed * np.clip(0.8 + 0.4 * cells.fine, 0, 2)
        cells, water = _strip(canvas, canvas.polygon(shore))
        cells.lay(m.WATER, water, 0.05 * cells.broad + 0.012 * cells.patchy)
        cells.flatten(water)


def paint_shape(canvas: Canvas, kind: Terrain) -> None:
    """Paints the lake of a shore, or the deck of a bridge."""
    if kind == "shore":
        water = canvas.ground <= WATER_M
        canvas.lay(m.WATER, water, 0.05 * canvas.broad + 0.012 * canvas.patchy)
        canvas.height[water] = WATER_M
    elif kind == "bridge":
        road = deck(canvas.grid)
        canvas.lay(m.ASPHALT, road, 0.018 * canvas.grain + 0.02 * canvas.fine)
        canvas.height[road] = canvas.ground[road]
