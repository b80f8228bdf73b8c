"""Registration of two height fields with an accuracy of a fraction of a cell.

Heights are independent of the spectral band, the time of day and, except for leaves, the season.
Shadows and shading do not bias the fit, as they do with images. Two adjusted blocks differ by a 3D
similarity. The slopes determine the shift that makes the heights of one field equal to those of the
other (least squares matching; for elevation models Rosenholm and Torlegard 1988). Steep walls and
objects that only one field contains are excluded.
"""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.model.registration import Matrix, RefusedRegistration
from skyquilt.model.surface import HeightField

Doubles = NDArray[np.float64]
_TILES = 4
"""Number of squares per side of the chess-board that divides the ground into two halves."""
_LEAST = 400
"""Fewest cells with heights in both fields."""
_TOO_LITTLE = RefusedRegistration(reason="too few cells have heights in both maps")


@dataclass(frozen=True, kw_only=True, eq=False)
class HeightFit:
    """Result of the registration of two height fields."""

    b_H_a: Matrix
    """(3, 3) similarity from a's ground coordinates in m to b's."""
    cells: int
    """Number of cells compared."""
    residual_m: float
    """Robust standard deviation of the height differences in m."""
    apart_m: float
    """RMS distance over the ground, in m, between the independent solutions of its two halves."""


@dataclass(frozen=True, kw_only=True)
class AlignHeights:
    """Gauss-Newton, coarse to fine. The unknowns are a similarity of the plane, and for the heights
    a factor and a curved surface of low order.
    """

    sigmas: tuple[float, ...] = (5.0, 2.5, 1.25, 0.75)
    """Standard deviations of the smoothing, in cells."""
    steepest: float = 2.5
    """Slope above which cells are excluded as walls."""
    scale: float = 1.0
    """Height difference in cells above which the weight of a cell decreases."""
    steps: int = 20
    """Largest number of steps at each smoothing."""
    furthest_apart: float = 2.0
    """Largest distance in cells between the solutions of the two halves of the ground."""
    likeness: float = 1.25
    """Largest ratio, in either direction, of the heights of relief between the two maps. For noise
    or unrelated ground the fitted factor is close to zero.
    """
    version: ClassVar[int] = 1

    def __call__(
        self, a: HeightField, b: HeightField, start: Matrix
    ) -> HeightFit | RefusedRegistration:
        """The registration of b to a near a start (3, 3), in ground coordinates in m, or why
        heights do not determine it.
        """
        cell = 2 * max(a.cell, b.cell)
        a, b = a.coarser(cell), b.coarser(cell)
        everything = np.ones(a.z.shape, bool)
        fit = self._fitted(a, b, _Fit.of(a, start), everything, self.sigmas)
        if fit is None:
            return _TOO_LITTLE
        if abs(np.log(max(fit.factor, 1e-3))) > np.log(self.likeness):
            return RefusedRegistration(
                reason=f"heights of one map are {fit.factor:.2f} times as high in the other:"
                " they are unrelated"
            )
        parts = [self._fitted(a, b, fit, half, self.sigmas[-2:]) for half in _halves(a.z.shape)]
        if parts[0] is None or parts[1] is None:
            return _TOO_LITTLE
        apart = float(np.sqrt((((parts[0].p - parts[1].p) @ fit.spread) ** 2).sum()))
        if apart > self.furthest_apart * cell:
            return RefusedRegistration(
                reason=f"solutions of two halves of the ground are {apart:.1f} m apart: its relief"
                " does not determine the position"
            )
        return HeightFit(b_H_a=fit.matrix, cells=fit.cells, residual_m=fit.residual, apart_m=apart)

    def _fitted(
        self,
        a: HeightField,
        b: HeightField,
        fit: "_Fit",
        part: NDArray[np.bool_],
        sigmas: tuple[float, ...],
    ) -> "_Fit | None":
        """The best fit from the cells of a in `part`; None if too few can be compared."""
        for sigma in sigmas:
            one, other = _smooth(a, sigma), _Slopes.of(_smooth(b, sigma), b, self.steepest)
            known = a.known & part
            for _ in range(self.steps):
                change = self._step(one, known, other, fit, a.cell)
                if change is None:
                    return None
                fit, moved = change
                if moved < 0.01 * a.cell:
                    break
        return fit

    def _step(
        self,
        one: NDArray[np.float32],
        known: NDArray[np.bool_],
        other: "_Slopes",
        fit: "_Fit",
        cell: float,
    ) -> "tuple[_Fit, float] | None":
        """One step, and the distance in m by which it moves the border of the ground."""
        z, gx, gy, both = other.at(*fit.there(one - np.median(one[known])))
        both &= known
        if both.sum() < _LEAST:
            return None
        z, gx, gy, u, v, wanted = z[both], gx[both], gy[both], fit.u[both], fit.v[both], one[both]
        heights = np.stack([z, np.ones_like(z), u, v, u * u, u * v, v * v], 1)
        place = np.stack([gx, gy, gx * u + gy * v, gy * u - gx * v], 1)
        found, lacking = _robust(np.concatenate([heights, place], 1), wanted, self.scale * cell)
        change = found[7:] / max(float(found[0]), 0.3)
        change *= min(1.0, 5 * cell / max(float(np.abs(change).max()), 1e-9))
        residual = 1.4826 * float(np.median(np.abs(lacking)))
        told = replace(
            fit,
            p=fit.p + change,
            tilt=found[2:4] / fit.unit,
            factor=float(found[0]),
            cells=int(both.sum()),
            residual=residual,
        )
        return told, float(np.abs(change).max())


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    """A similarity, parametrised by the shift in m of the ground's middle and border: x = x0 + p0 +
    p2 u - p3 v, and y accordingly.
    """

    u: Doubles
    v: Doubles
    """(rows, cols) positions of a's cells relative to its middle, in units of half its
    longer side.
    """
    middle: Doubles
    unit: float
    p: Doubles
    """(4,) position of the middle, and the image of the unit vector along x and y, all in m."""
    tilt: Doubles = field(default_factory=lambda: np.zeros(2))
    """(2,) slopes along x and y of a's heights minus b's: the tilt between the blocks."""
    factor: float = 1.0
    """Factor from b's heights to a's, apart from the general slope and curvature."""
    cells: int = 0
    residual: float = 0.0

    @classmethod
    def of(cls, a: HeightField, start: Matrix) -> "_Fit":
        rows, columns = a.z.shape
        middle = np.array([a.x0 + a.cell * (columns - 1) / 2, a.y0 + a.cell * (rows - 1) / 2])
        unit = a.cell * max(rows, columns) / 2
        v, u = (
            (np.mgrid[0:rows, 0:columns] - np.array([rows - 1, columns - 1])[:, None, None] / 2)
            * a.cell
            / unit
        )
        there = start @ np.array([[middle[0], middle[0] + unit], [middle[1], middle[1]], [1, 1]])
        there = there[:2] / there[2]
        return cls(
            u=u, v=v, middle=middle, unit=unit, p=np.r_[there[:, 0], there[:, 1] - there[:, 0]]
        )

    def there(self, lift: NDArray[Any]) -> tuple[Doubles, Doubles]:
        """(rows, cols) positions in b of the cells of a, `lift` m above the level for which the
        similarity holds.

        In a tilted block, roofs and tree crowns are displaced by the slope times their height.
        """
        x, y, c, s = self.p
        along, across = self.tilt
        return (
            x + c * self.u - s * self.v + along * lift,
            y + s * self.u + c * self.v + across * lift,
        )

    @property
    def matrix(self) -> Matrix:
        x, y, c, s = self.p
        linear = np.array([[c, -s], [s, c]]) / self.unit
        shift = np.array([x, y]) - linear @ self.middle
        return np.vstack([np.c_[linear, shift], [0, 0, 1]])

    @property
    def spread(self) -> Doubles:
        """(4, 4) matrix from a difference of parameters to RMS distances over the ground."""
        r2 = float((self.u**2 + self.v**2).mean())
        return np.diag(np.sqrt([1, 1, r2, r2]))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Slopes:
    """Heights and slopes of b for interpolation."""

    layers: NDArray[np.float32]
    """(rows, cols, 4): height, slope along x and y, 1 where all three are known and the cell is not
    a wall.
    """
    field: HeightField

    @classmethod
    def of(cls, smooth: NDArray[np.float32], b: HeightField, steepest: float) -> "_Slopes":
        gy, gx = np.gradient(smooth, b.cell)
        inner = cv2.erode(b.known.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        gentle = inner & (np.hypot(gx, gy) < steepest)
        return cls(layers=np.stack([smooth, gx, gy, gentle], -1).astype(np.float32), field=b)

    def at(self, x: Doubles, y: Doubles) -> tuple[Doubles, Doubles, Doubles, NDArray[np.bool_]]:
        """Height, slopes and whether they are known, each in the shape of x and y."""
        b = self.field
        column, row = (
            ((x - b.x0) / b.cell).astype(np.float32),
            ((y - b.y0) / b.cell).astype(np.float32),
        )
        found = cv2.remap(
            self.layers, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )
        z, gx, gy, known = np.moveaxis(np.asarray(found, np.float64), -1, 0)
        return z, gx, gy, known > 0.99


def _smooth(one: HeightField, sigma: float) -> NDArray[np.float32]:
    """Heights smoothed over the known cells."""
    weight = one.known.astype(np.float32)
    total = np.asarray(cv2.GaussianBlur(np.where(one.known, one.z, np.float32(0)), (0, 0), sigma))
    return np.asarray(total / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3), np.float32)


def _robust(A: Doubles, wanted: NDArray[Any], scale: float) -> tuple[Doubles, Doubles]:
    """Reweighted least squares (Geman and McClure): the solution and its residuals."""
    weight = np.ones(len(A))
    for _ in range(6):
        W = A * weight[:, None]
        found = np.linalg.solve(W.T @ A + 1e-9 * np.eye(A.shape[1]), W.T @ wanted)
        lacking = wanted - A @ found
        weight = 1 / (1 + (lacking / scale) ** 2) ** 2
    return np.asarray(found), np.asarray(lacking)


def _halves(shape: tuple[int, int]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The white and the black squares of a chess-board over the ground."""
    row, column = (np.arange(n) * _TILES // n for n in shape)
    white = (row[:, None] + column) % 2 == 0
    return white, ~white
