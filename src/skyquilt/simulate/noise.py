"""Unbounded seeded noise: a place has the same value in every window."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from skyquilt.simulate.grid import Doubles, Floats, Grid

_LATTICE = 256
_TILE = 1024
_FEW = 64  # cells: as many are computed without matrices
_SPREAD = 0.48  # standard deviation of cubic B-spline noise over a unit lattice


@lru_cache(maxsize=64)
def _lattice(seed: int, key: int, size: int) -> Floats:
    rng = np.random.default_rng([seed, key, size])
    return rng.standard_normal((size, size), dtype=np.float32)


def _weights(t: Any) -> list[Any]:
    """Cubic B-spline weights, float32, of four neighbours at `t` (0 to 1), a number or (n,) of
    them, between the middle two.
    """
    weights = (1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3
    return [np.float32(w / 6) for w in weights]


def _spline(positions: Doubles) -> tuple[sparse.csr_matrix, NDArray[np.int64]]:
    """Cubic B-spline weights as a sparse matrix, and the lattice indices of its columns."""
    base = np.floor(positions).astype(np.int64)
    weights = np.stack(_weights(positions - base), axis=1)
    first = int(base.min()) - 1
    columns = base[:, None] - 1 - first + np.arange(4)
    rows = np.arange(len(base) + 1) * 4
    shape = (len(base), int(base.max()) + 2 - first + 1)
    matrix = sparse.csr_matrix((weights.ravel(), columns.ravel(), rows), shape=shape)
    return matrix, np.arange(first, first + shape[1], dtype=np.int64)


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Smooth random fields from a seed."""

    seed: int
    """Equal seeds give equal fields."""

    def smooth(self, grid: Grid, wavelength: float, key: int) -> Floats:
        """A field (height, width) with zero mean, unit standard deviation and no features below the
        wavelength (m).
        """
        if grid.width == grid.height == 1:
            return self._at_point(grid.xs[0] / wavelength, grid.ys[0] / wavelength, key)
        if grid.width * grid.height <= _FEW:
            return self._at_few(grid.xs / wavelength, grid.ys / wavelength, key)
        down, rows = _spline(grid.ys / wavelength)
        across, cols = _spline(grid.xs / wavelength)
        lattice = _lattice(self.seed, key, _LATTICE)[np.ix_(rows % _LATTICE, cols % _LATTICE)]
        field = across @ (down @ lattice).T
        return np.asarray(cv2.transpose(field) * np.float32(1 / _SPREAD))

    def _at_point(self, u: float, v: float, key: int) -> Floats:
        """The field (1, 1) at one place of the lattice; the same number, without matrices."""
        columns, rows = int(np.floor(u)), int(np.floor(v))
        lattice = _lattice(self.seed, key, _LATTICE)
        down, across = _weights(v - rows), _weights(u - columns)
        total = np.float32(0)
        for k in range(4):
            column = np.float32(0)
            for j in range(4):
                place = (rows - 1 + j) % _LATTICE, (columns - 1 + k) % _LATTICE
                column += down[j] * lattice[place]
            total += across[k] * column
        return np.array([[total * np.float32(1 / _SPREAD)]])

    def _at_few(self, u: Doubles, v: Doubles, key: int) -> Floats:
        """The field (h, w) at columns u (w,) and rows v (h,) of the lattice; the same numbers, for
        less than matrices of few rows cost.
        """
        columns, rows = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
        down = np.stack(_weights(v - rows))
        across = np.stack(_weights(u - columns))
        around = np.arange(-1, 3)[:, None]
        lattice = _lattice(self.seed, key, _LATTICE)[
            ((rows + around) % _LATTICE)[:, :, None, None], (columns + around) % _LATTICE
        ]  # (4, h, 4, w)
        taken = np.zeros(lattice.shape[1:], np.float32)
        for j in range(4):
            taken += down[j][:, None, None] * lattice[j]
        field = np.zeros((len(v), len(u)), np.float32)
        for k in range(4):
            field += across[k] * taken[:, k]
        return np.asarray(field * np.float32(1 / _SPREAD))

    def fractal(self, grid: Grid, longest: float, shortest: float, gain: float, key: int) -> Floats:
        """Sum of octaves from the longest wavelength down to the shortest (m), each with `gain`
        times the amplitude of the one before.
        """
        total = np.zeros((grid.height, grid.width), dtype=np.float32)
        weight, wavelength, power, octave = 1.0, longest, 0.0, 0
        while wavelength >= shortest:
            total += np.float32(weight) * self.smooth(grid, wavelength, key * 100 + octave)
            power += weight**2
            weight, wavelength, octave = weight * gain, wavelength / 2, octave + 1
        return total / np.float32(np.sqrt(power))

    def grain(self, grid: Grid, key: int) -> Floats:
        """White noise per cell of the unbounded raster, unit standard deviation."""
        tile = _lattice(self.seed, key, _TILE)
        rows = (grid.row + np.arange(grid.height)) % _TILE
        cols = (grid.col + np.arange(grid.width)) % _TILE
        return tile[np.ix_(rows, cols)]

    def at(self, x: float, y: float, wavelength: float, key: int) -> float:
        """The value of `smooth` at one point of the map."""
        point = Grid(left=x - 0.5, top=y + 0.5, res=1.0, width=1, height=1)
        return float(self.smooth(point, wavelength, key)[0, 0])
