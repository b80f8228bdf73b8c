"""Objective of `hybrid`: lambda = alpha lambda_spat + (1 - alpha) lambda_corr of a photo on the map
(Y 4.6).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.plane import Overview, Patch

Array = NDArray[np.float64]
LEAST_OVERLAP = 0.02
"""Least overlap of a photo with the map so far for a correlation, as a share of the photo."""
STEPS = 3
"""Levels of the pyramid, each twice as coarse as the one before."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Distances:
    """Positions of the new photo's neighbours, as measured and on the map."""

    reported: Array
    """(n,) measured distances in m from the new nadir to those of its neighbours."""
    placed: Array
    """(n, 2) the neighbours' nadirs on the map in m."""
    weight: Array
    """(n,) 1, or 0 where the distance is too short for a relative comparison."""

    def quality(self, nadir: Array) -> Array:
        """lambda_spat (6.1) of nadirs (..., 2) in m: mean of 1 / (1 + |relative error|); 1 without
        neighbours.
        """
        if not self.weight.any():
            return np.ones(np.shape(nadir)[:-1])
        d = np.linalg.norm(np.asarray(nadir)[..., None, :] - self.placed, axis=-1)
        error = np.abs(d - self.reported) / np.maximum(self.reported, 1e-9)
        return np.asarray((self.weight / (1 + error)).sum(-1) / self.weight.sum())


@dataclass(frozen=True, kw_only=True, eq=False)
class Level:
    """One level of the pyramid."""

    gsd: float
    """Ground size in m of its pixels."""
    patch: NDArray[np.float32]
    """(h, w) the photo as placed by its metadata."""
    shown: NDArray[np.float32]
    """(h, w) 1 where the photo is valid, 0 elsewhere."""
    pivot: Array
    """(2,) column and row of the photo's nadir in the patch."""
    window: NDArray[np.float32]
    """(H, W) the map so far around it."""
    filled: NDArray[np.float32]
    """(H, W) 1 where the map so far is valid."""
    offset: Array
    """(2,) column and row of the patch's first pixel in the window, as placed by metadata."""

    def correlation(self, move: Array) -> float:
        """CC (6.1) of photo and map in their overlap for a move (east m, north m, degrees); NaN
        without one.
        """
        place = self._placement(move)
        h, w = self.window.shape
        warped = cv2.warpAffine(self.patch, place, (w, h), flags=cv2.INTER_LINEAR)
        mask = cv2.warpAffine(self.shown, place, (w, h), flags=cv2.INTER_LINEAR) > 0.99
        mask &= self.filled > 0
        count = int(np.count_nonzero(mask))
        if count < LEAST_OVERLAP * self.patch.size:
            return float("nan")
        x, y = warped[mask], self.window[mask]
        x, y = x - x.mean(), y - y.mean()
        norm = float(np.sqrt((x @ x) * (y @ y)))
        return float(x @ y) / norm if norm > 0 else float("nan")

    def _placement(self, move: Array) -> Array:
        """(2, 3) patch pixels to window pixels."""
        turn = np.radians(
            move[2]
        )  # rows point south: clockwise on the ground is clockwise in the image
        c, s = np.cos(turn), np.sin(turn)
        R = np.array([[c, -s], [s, c]])
        target = self.pivot + self.offset + np.array([move[0], -move[1]]) / self.gsd
        return np.column_stack([R, target - R @ self.pivot])


@dataclass(frozen=True, kw_only=True, eq=False)
class Objective:
    """lambda of one photo, on every level of its pyramid, finest first."""

    levels: Sequence[Level]
    """The pyramid."""
    distances: Distances
    """Its neighbours."""
    nadir: Array
    """(2,) nadir by metadata in m."""
    alpha: float
    """Weight of distances against looks."""

    def __call__(self, move: Array, level: int) -> float:
        """lambda for a move (east m, north m, clockwise degrees); without overlap, only distances
        are used.
        """
        cc = self.levels[level].correlation(move)
        looks = (1 + cc) / 2 if np.isfinite(cc) else 0.0
        return (
            self.alpha * float(self.distances.quality(self.nadir + move[:2]))
            + (1 - self.alpha) * looks
        )


def pyramid(
    patch: Patch, overview: Overview, gsd: float, reach_m: float, nadir_px: Array
) -> list[Level]:
    """Levels of a photo (on the overview's grid) and of the overview around it, as far as it may
    move.

    `nadir_px` (2,): column and row of its nadir on the grid.
    """
    h, w = patch.shown.shape
    margin = int(np.ceil(reach_m / gsd)) + 2
    margin += int(0.1 * max(h, w))  # margin for rotation
    row, column = patch.row - margin, patch.column - margin
    window, filled = overview.window(row, column, h + 2 * margin, w + 2 * margin)
    levels = []
    photo, seen = patch.pixels, patch.shown.astype(np.float32)
    pivot = nadir_px - (patch.column, patch.row)
    offset, known = np.full(2, float(margin)), filled.astype(np.float32)
    for k in range(STEPS):
        if k:
            (photo, seen), (window, known) = _halved(photo, seen), _halved(window, known)
            pivot, offset, gsd = (pivot + 0.5) / 2 - 0.5, offset / 2, 2 * gsd
        levels.append(
            Level(
                gsd=gsd,
                patch=photo,
                shown=(seen > 0.99).astype(np.float32),
                pivot=pivot,
                window=window,
                filled=(known > 0.99).astype(np.float32),
                offset=offset,
            )
        )
    return levels


def _halved(
    pixels: NDArray[np.float32], seen: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Averages of 2 x 2 pixels, of valid ones only."""
    size = (-(-pixels.shape[1] // 2), -(-pixels.shape[0] // 2))
    even = [(0, s % 2) for s in pixels.shape]
    p, m = np.pad(pixels * seen, even), np.pad(seen, even)
    share = cv2.resize(m, size, interpolation=cv2.INTER_AREA)
    value = cv2.resize(p, size, interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-6)
    return np.asarray(value, np.float32), np.asarray(share, np.float32)
