"""Shadows of clouds that move: how each photo's brightness must change over its picture so that it
shows the ground as other photos do.

A photo's shades are values in log odds at `NODES` x `NODES` places of its picture, smooth between.
They follow what the photo's samples lack to the mean of their ground points, round by round, so
where photos disagree each moves by its part, and where none can tell nothing changes.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging import node_grid
from skyquilt.imaging.node_grid import nodes_around

Float = NDArray[np.float32]
Terms = list[tuple[NDArray[np.int32], Float]]

NODES = 14
"""Nodes along either side of a square about the picture: at 1.1 of the half diagonal at its sides.
"""
REACH = 1.1
"""x and y of the outer nodes, in half diagonals of the picture."""
SOFT = 0.8
"""Standard deviation over which nodes are averaged with one another, in nodes."""
PULL = 0.1
"""Weight of the prior of no change, in samples."""
ROUNDS, WHOLE = 20, 3
"""Rounds, and how many of the first take shadows for what they are, not for outliers."""
WIDE, CLOSE, LEAST = 0.5, 2.0, 0.1
"""Residual in log odds at which a sample counts half, in the first rounds; later in medians of the
residuals, and at least.
"""
DIFFERENT, FEWEST = 0.025, 20
"""Mean difference of a photo's samples from the mean of their point, in log odds, and number of
such samples, below which no shadows are sought in it.
"""
EXPLAINED, SURELY = 0.25, 0.33
"""Share of these differences that shades must explain at points they were not found from: of few
samples, and of `DENSE` ones.
"""
TOGETHER = 2
"""Photos with shadows, at least: one alone differs by something else."""
DENSE, MOST = 1200, 2_400_000
"""Samples of a photo for the shades that are used, and of all photos together."""


def shades(
    point: NDArray[np.integer[Any]],
    row: NDArray[np.integer[Any]],
    place: Float,
    level: NDArray[Any],
    free: NDArray[np.bool_],
) -> Float:
    """(n, `NODES`, `NODES`) what is to be added to samples of points (N,) in photos `row` (N,) at
    places (N, 2), as of `exposure.image_place`, so that levels (N,) of each point are alike; zero
    for photos that are not `free` (n,).
    """
    terms = _terms(place)
    found = np.zeros((len(free), NODES, NODES))
    several = np.bincount(point)[point] > 1
    weight = several.astype(float)
    first = row.astype(np.int64) * NODES**2
    for step in range(ROUNDS):
        now = level + _at(found, terms, first)
        mass = np.maximum(np.bincount(point, weight), 1e-9)
        lacking = (np.bincount(point, weight * now) / mass)[point] - now
        lacking[~several] = 0
        scale = WIDE
        if step >= WHOLE and several.any():
            scale = max(CLOSE * float(np.median(np.abs(lacking[several]))), LEAST)
        weight = several / (1 + (lacking / scale) ** 2)
        total, share = (
            _soft(sum(np.bincount(first + at, f * w, found.size) for at, f in terms), found.shape)
            for w in (weight * lacking, weight)
        )
        found[free] += (total / (share + PULL))[free]
    return found.astype(np.float32)


def explained(
    point: NDArray[np.integer[Any]],
    row: NDArray[np.integer[Any]],
    place: Float,
    level: NDArray[Any],
    photos: int,
) -> NDArray[np.float64]:
    """(photos,) share of the mean difference of a photo's samples from the mean of their point that
    shades explain which were found from every other point; 0 where they hardly differ. Arguments as
    of `shades`.
    """
    before, several = _off(point, level)
    number, whole = (np.bincount(row, of, photos) for of in (several, before))
    differ = (number >= FEWEST) & (whole > DIFFERENT * number)
    even = point % 2 == 0
    if not differ.any() or even.all() or not even.any():
        return np.zeros(photos)
    rest, free = np.zeros(photos), np.ones(photos, bool)
    for known in (even, ~even):
        found = shades(point[known], row[known], place[known], level[known], free)
        p, r = point[~known], row[~known]
        after, _ = _off(p, level[~known] + shade(found, r, place[~known]))
        rest += np.bincount(r, after, photos)
    return np.where(differ, 1 - rest / np.maximum(whole, 1e-9), 0.0)


def shade(found: NDArray[Any], row: NDArray[np.integer[Any]], place: NDArray[Any]) -> Float:
    """(N,) shades of photos `row` (N,) at places (N, 2)."""
    return np.asarray(_at(found, _terms(place), row.astype(np.int64) * NODES**2), np.float32)


def over(found: Float, x: NDArray[Any], y: NDArray[Any]) -> Float:
    """(h, w) one photo's shades (`NODES`, `NODES`) at places x, y (h, w)."""
    return node_grid.over(found, _shares(x), _shares(y))


def apart(point: NDArray[np.integer[Any]], level: NDArray[Any]) -> float:
    """Median difference of samples (N,) from the mean of their point (N,)."""
    off, several = _off(point, level)
    return float(np.median(off[several])) if several.any() else 0.0


def _off(
    point: NDArray[np.integer[Any]], level: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(N,) how far samples are from the mean of their point, 0 for its only one, and (N,) which
    are not the only ones.
    """
    number = np.bincount(point)
    mean = np.bincount(point, level) / np.maximum(number, 1)
    several = number[point] > 1
    return np.where(several, np.abs(level - mean[point]), 0.0), several


def _shares(place: NDArray[Any]) -> NDArray[Any]:
    """Places in shares of the sides of the square of nodes."""
    return np.asarray((place + REACH) / (2 * REACH))


def _terms(place: NDArray[Any]) -> Terms:
    """Node and weight (N,) of each of the four nodes around places (N, 2)."""
    around = nodes_around(_shares(place), (NODES, NODES))
    return [(node.astype(np.int32), weight.astype(np.float32)) for node, weight in around]


def _at(found: NDArray[Any], terms: Terms, first: NDArray[np.int64]) -> NDArray[np.float64]:
    """(N,) values of grids (n, `NODES`, `NODES`), of samples whose grids begin at `first` (N,)."""
    flat = found.ravel()
    return np.asarray(sum(flat[first + node] * weight for node, weight in terms))


def _soft(sums: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Sums at nodes, of each photo averaged with those around."""
    grids = np.asarray(sums).reshape(shape)
    none = cv2.BORDER_CONSTANT
    return np.stack([cv2.GaussianBlur(g, (0, 0), SOFT, borderType=none) for g in grids])
