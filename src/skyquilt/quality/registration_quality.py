"""How well single images are registered [Yahyanejad 2013, (4.7), (6.2), (6.3)]."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray


def four_lengths(corners: ArrayLike) -> NDArray[np.float64]:
    """Width, height and both diagonals (4,) of a quadrilateral (4, 2), its corners in order around
    it.

    Where opposite sides differ, their mean is the width and the height.
    """
    a, b, c, d = np.asarray(corners, np.float64)
    sides = [np.linalg.norm(q - p) for p, q in ((a, b), (b, c), (c, d), (d, a), (a, c), (b, d))]
    return np.array([(sides[0] + sides[2]) / 2, (sides[1] + sides[3]) / 2, sides[4], sides[5]])


def eta(lengths: ArrayLike, reference: ArrayLike) -> float:
    """(4.7): orthorectification quality, 4 / sum of max(l, l') / min(l, l'), in (0, 1], 1 =
    undeformed.

    Both (4,): width, height and both diagonals of a target in the map and in reality.
    """
    found, true = np.asarray(lengths, np.float64), np.asarray(reference, np.float64)
    if found.shape != (4,) or true.shape != (4,) or not (found > 0).all() or not (true > 0).all():
        raise ValueError(f"four positive lengths of each expected, got {found} and {true}")
    return float(4 / np.sum(np.maximum(found, true) / np.minimum(found, true)))


def mean_squared_error(estimated: ArrayLike, points: ArrayLike) -> float:
    """(6.2): mean squared distance in px^2 between points (n, 2) and their estimates (n, 2)."""
    difference = np.asarray(estimated, np.float64) - np.asarray(points, np.float64)
    return float((difference**2).sum(-1).mean()) if len(difference) else float("nan")


def spread_quality(inliers: ArrayLike, width: int, height: int, *, delta: float) -> float:
    """Q of (6.3): share of the image that is nearer than `delta` px to an inlier, times the largest
    distance between two inliers over the image's diagonal; in [0, 1], 0 for fewer than two.

    `inliers` (n, 2) in px, centres at integers; the diagonal runs between the corner pixels'
    centres, so that 1 can be reached. Only pixels inside the image count as covered.
    """
    px = np.asarray(inliers, np.float64).reshape(-1, 2)
    if len(px) < 2:
        return 0.0
    covered = np.zeros((height, width), bool)
    for x, y in px:
        _cover(covered, float(x), float(y), delta)
    hull = cv2.convexHull(px.astype(np.float32))[:, 0].astype(np.float64)
    farthest = np.linalg.norm(hull[:, None] - hull[None], axis=-1).max()
    return float(covered.mean() * farthest / np.hypot(width - 1, height - 1))


def _cover(covered: NDArray[np.bool_], x: float, y: float, delta: float) -> None:
    """Marks the pixels nearer than delta to (x, y)."""
    rows = np.arange(max(0, int(np.ceil(y - delta))), min(covered.shape[0], int(y + delta) + 1))
    columns = np.arange(max(0, int(np.ceil(x - delta))), min(covered.shape[1], int(x + delta) + 1))
    if rows.size and columns.size:
        near = (rows[:, None] - y) ** 2 + (columns[None, :] - x) ** 2 < delta**2
        covered[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] |= near
