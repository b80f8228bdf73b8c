"""Assigns columns and rows of a grid to neighbouring blobs."""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from skyquilt.calibration.blobs import Blobs

Array = NDArray[np.float64]
STEPS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
"""Steps in column and row to the neighbour on each side, clockwise."""
_NEAR = 0.35
_FEWEST = 6
_OFF = 0.2


@dataclass(frozen=True, kw_only=True, eq=False)
class Lattice:
    """Squares on one grid; their position on the board is not known yet."""

    px_H_grid: Array
    """(3, 3): from (column, row), centres at integers, to px."""
    cells: NDArray[np.int_]
    """(n, 2) column and row of each square."""
    white_even: bool
    """Whether squares with an even sum of column and row are the white ones."""


def lattices(found: Blobs) -> list[Lattice]:
    """Grids of at least six squares, the largest first."""
    links = _links(found)
    seen: set[int] = set()
    grids = []
    for start in range(len(found)):
        if start not in seen:
            cells = _counted(start, links)
            seen |= cells.keys()
            if len(cells) >= _FEWEST and (grid := _fitted(found, cells)):
                grids.append(grid)
    return sorted(grids, key=lambda g: -len(g.cells))


def _links(found: Blobs) -> dict[int, list[tuple[int, int, int]]]:
    """Blob -> (its side, neighbour, the neighbour's side): neighbours have opposite colours and
    facing sides.
    """
    links: dict[int, list[tuple[int, int, int]]] = {i: [] for i in range(len(found))}
    if len(found) < _FEWEST:
        return links
    aim = found.centre[:, None] + 2 * found.sides
    reach = 2 * np.linalg.norm(found.sides, axis=2)
    trees = {white: cKDTree(found.centre[found.white == white]) for white in (True, False)}
    index = {white: np.flatnonzero(found.white == white) for white in (True, False)}
    to = np.full((len(found), 4), -1)
    for white in (True, False):
        mine, others = index[white], index[not white]
        if len(mine) and len(others):
            distance, at = trees[not white].query(aim[mine])
            near = distance < _NEAR * reach[mine]
            to[mine] = np.where(near, others[np.minimum(at, len(others) - 1)], -1)
    for a, side in zip(*np.nonzero(to >= 0), strict=True):
        b = int(to[a, side])
        back = np.flatnonzero(to[b] == a)
        if len(back) == 1:
            links[int(a)].append((int(side), b, int(back[0])))
    return links


def _counted(
    start: int, links: dict[int, list[tuple[int, int, int]]]
) -> dict[int, tuple[int, int]]:
    """Blob -> (column, row), walking from neighbour to neighbour."""
    cell, turn = {start: (0, 0)}, {start: 0}
    queue = deque([start])
    while queue:
        a = queue.popleft()
        for side, b, back in links[a]:
            if b not in cell:
                way = (side + turn[a]) % 4
                step = STEPS[way]
                cell[b] = (cell[a][0] + int(step[0]), cell[a][1] + int(step[1]))
                turn[b] = (way + 2 - back) % 4
                queue.append(b)
    return cell


def _fitted(found: Blobs, cells: dict[int, tuple[int, int]]) -> Lattice | None:
    """The grid's homography, without squares that got a wrong column or row."""
    index = np.array(list(cells))
    grid = np.array([cells[i] for i in index])
    side = 2 * np.median(np.linalg.norm(found.sides[index], axis=2))
    px = found.centre[index]
    H, kept = cv2.findHomography(grid.astype(np.float64), px, cv2.RANSAC, _OFF * side, maxIters=500)
    if H is None or kept.sum() < _FEWEST:
        return None
    inside = kept[:, 0] > 0
    even = (grid[inside].sum(1) % 2 == 0) == found.white[index[inside]]
    return Lattice(
        px_H_grid=np.asarray(H, np.float64), cells=grid[inside], white_even=bool(even.mean() > 0.5)
    )
