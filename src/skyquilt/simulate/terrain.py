"""Shapes of land other than hills: mountain sides, cliffs, quarries, bridges, lake shores."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from skyquilt.simulate.grid import Floats, Grid

Terrain = Literal[
    "landscape",
    "bare",
    "slope",
    "cliff",
    "quarry",
    "bridge",
    "town",
    "shore",
    "orchard",
    "crops",
    "solar",
    "dunes",
    "chessboard",
]
"""Kinds of terrain. `landscape`: farmland over hills. The others have the same hills, and besides:
`bare`: only fields without crops; `slope`: a mountain side of 30 degrees that falls to the north by
80 m; `cliff`: a wall of 45 m that faces east; `quarry`: a pit with four benches of 9 m; `bridge`: a
ravine 22 m deep and a road across it at its rim's height; `town`: blocks of houses of 10 to 32 m;
`shore`: a lake in the west, whose waves move from photo to photo; `orchard`: alike trees in rows
everywhere; `crops`: rows of plants everywhere; `solar`: rows of panels that are all alike; `dunes`:
sand or snow with faint ripples. `chessboard`: a level board.
"""
WATER_M = -2.0
"""Level of the lake of `shore`, m above the base."""
DECK_M = 4.5
"""Half the width of the deck of `bridge`."""
_BENCHES_M = (55.0, 43.0, 31.0, 20.0)
_DEPTH_M = {"slope": 40.0, "cliff": 45.0, "quarry": 36.0, "bridge": 22.0, "shore": 0.0}
_HEIGHT_M = {"slope": 40.0, "town": 35.0, "shore": 12.0}
_STEEPEST_M = 5.0


def depth(kind: Terrain) -> float:
    """By how many metres the shape reaches below the hills at most."""
    return _DEPTH_M.get(kind, 0.0)


def height(kind: Terrain) -> float:
    """By how many metres the shape or its houses reach above the lowest place of the shape."""
    return _HEIGHT_M.get(kind, 0.0) + depth(kind)


def shaped(kind: Terrain, hills: Floats, grid: Grid) -> Floats:
    """Heights (h, w) of the bare ground, m above the base, from those of the hills (h, w)."""
    x, y = grid.xs[None, :], grid.ys[:, None]
    match kind:
        case "slope":
            added = -40.0 * np.tanh(y / 70.0) + 0.0 * x
        case "cliff":
            added = -45.0 * np.clip((x + 6.0 * np.sin(y / 15.0)) / 3.0, 0.0, 1.0)
        case "quarry":
            away = np.hypot(x, y) + 4.0 * np.sin(3.0 * np.arctan2(y, x))
            benches = [np.clip((rim - away) / 2.0, 0.0, 1.0) for rim in _BENCHES_M]
            added = -9.0 * np.sum(benches, axis=0)
        case "bridge":
            ravine = -22.0 * np.exp(-(((x + 5.0 * np.sin(y / 20.0)) / 25.0) ** 2))
            added = np.where(deck(grid), 0.0, ravine)
        case "shore":
            inland = 12.0 * np.tanh((x + 9.0 * np.sin(y / 17.0)) / 40.0)
            return np.maximum(hills + inland, WATER_M).astype(np.float32)
        case _:
            return hills
    return (hills + added).astype(np.float32)


def deck(grid: Grid) -> NDArray[np.bool_]:
    """Cells (h, w) of the bridge's deck: a road along the map's x axis."""
    return (np.abs(grid.ys) < DECK_M)[:, None] & (np.abs(grid.xs) < 45.0)[None, :]


def stands_anywhere(kind: Terrain) -> bool:
    """Whether houses, trees and targets can stand everywhere, whatever the heights."""
    return kind not in ("slope", "cliff", "quarry", "bridge", "shore")


def stands(kind: Terrain, heights: Floats, grid: Grid) -> bool:
    """Whether houses, trees and targets can stand on cells whose ground has these heights (h, w),
    m: not in a lake, on a bridge or on a cliff.
    """
    match kind:
        case _ if stands_anywhere(kind):
            return True
        case "shore" if float(heights.min()) <= WATER_M:
            return False
        case "bridge" if deck(grid).any():
            return False
        case _:
            return float(np.ptp(heights)) < _STEEPEST_M
