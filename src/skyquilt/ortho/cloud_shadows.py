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

Float = NDArray[np.float32]

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
    photos = len(free)
    terms = _bilinear(place)
    found = np.zeros((photos, NODES, NODES))
    several = np.bincount(point)[point] > 1
    weight = several.astype(float)
    first = row.astype(np.int64) * NODES**2
    for step in range(ROUNDS):
        now = level + _at(found, terms, first)
        mass = np.maximum(np.bincount(point, weight), 1e-9)
        lacking = (np.bincount(point, weight * now) / mass)[point] - now
        lacking[~several] = 0
        scale = WIDE
        if step >= WHOLE:
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
    number, whole, rest = (np.zeros(photos) for _ in range(3))
    for known in (point % 2 == 0, point % 2 == 1):
        if not known.any() or known.all():
            continue
        free = np.ones(photos, bool)
        found = shades(point[known], row[known], place[known], level[known], free)
        p, r, y = point[~known], row[~known], level[~known]
        before, several = _off(p, y)
        after, _ = _off(p, y + shade(found, r, place[~known]))
        for total, part in ((number, several), (whole, before), (rest, after)):
            total += np.bincount(r, part, photos)
    differ = (number >= FEWEST) & (whole > DIFFERENT * number)
    return np.where(differ, 1 - rest / np.maximum(whole, 1e-9), 0.0)


def shade(found: NDArray[Any], row: NDArray[np.integer[Any]], place: NDArray[Any]) -> Float:
    """(N,) shades of photos `row` (N,) at places (N, 2)."""
    return np.asarray(_at(found, _bilinear(place), row.astype(np.int64) * NODES**2), np.float32)


def over(found: Float, x: NDArray[Any], y: NDArray[Any]) -> Float:
    """(h, w) one photo's shades (`NODES`, `NODES`) at places x, y (h, w)."""
    u, v = (((p + REACH) * ((NODES - 1) / (2 * REACH))).astype(np.float32) for p in (x, y))
    return np.asarray(cv2.remap(found, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


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


def _bilinear(place: NDArray[Any]) -> list[tuple[NDArray[np.int32], Float]]:
    """Node and weight (N,) of each of the four nodes around places (N, 2)."""
    at = np.clip((place + REACH) * ((NODES - 1) / (2 * REACH)), 0, NODES - 1.001)
    base = at.astype(np.int32)
    x, y = (at - base).astype(np.float32).T
    node = base[:, 1] * NODES + base[:, 0]
    return [
        (node, (1 - x) * (1 - y)),
        (node + 1, x * (1 - y)),
        (node + NODES, (1 - x) * y),
        (node + NODES + 1, x * y),
    ]


def _at(
    found: NDArray[Any], terms: list[tuple[NDArray[np.int32], Float]], first: NDArray[np.int64]
) -> NDArray[np.float64]:
    flat = found.ravel()
    return np.asarray(sum(flat[first + node] * weight for node, weight in terms))


def _soft(sums: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Sums at nodes, of each photo averaged with those around."""
    grids = np.asarray(sums).reshape(shape)
    none = cv2.BORDER_CONSTANT
    return np.stack([cv2.GaussianBlur(g, (0, 0), SOFT, borderType=none) for g in grids])
