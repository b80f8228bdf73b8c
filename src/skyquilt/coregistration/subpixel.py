"""Subpixel refinement of a transform: maximises the correlation coefficient of orientation fields.

Evangelidis and Psarakis (2008), ECC, forward compositional: a Gauss-Newton step derived from the
coefficient itself, which remains valid even if the correlation of the images is only 0.1.
Orientations rotate with the image, so the derivative of a rotation has an additional term.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.orientation import Fields, Orientation, channels, strength, warped
from skyquilt.model.registration import Matrix

Freedom = Literal["similarity", "affine", "homography"]
_TINY = 1e-9
_LARGEST_GAIN = 20.0
"""Largest scaling of a step; without a limit it would be unbounded where there is no
correlation.
"""
_STILL = 0.02
"""The search ends when a step is smaller than this, in px."""
_PARAMETERS = {"similarity": 4, "affine": 6, "homography": 8}
_LEAST = 50
"""Least overlap in px for a fit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A transform and how well it fits."""

    b_H_a: Matrix
    """(3, 3) in px of the resolution of the fields."""
    correlation: float
    """Coefficient over the overlap, in [-1, 1]."""
    overlap: float
    """Overlap in px of b."""
    freedom: Freedom = "similarity"
    """Type of the transform."""

    @property
    def score(self) -> float:
        """Correlation times the root of the overlap: comparable between different overlaps."""
        return self.correlation * float(np.sqrt(self.overlap))


@dataclass(frozen=True, kw_only=True)
class SubpixelRefinement:
    """Gauss-Newton steps, each accepted only if it increases the correlation."""

    freedom: Freedom = "similarity"
    """Type of the transform."""
    steps: int = 6
    """Largest number of steps."""
    version: ClassVar[int] = 2

    def __call__(self, a: Orientation, b: Orientation, b_H_a: Matrix) -> Fit:
        """The best transform near a given one; the given one itself if none is better."""
        frame = _Frame.of(b.shape)
        best, fields, valid = self._tried(a, b, b_H_a)
        for _ in range(self.steps):
            change = _change(fields, valid, b, frame, self.freedom)
            if change is None:
                break
            for share in (1.0, 0.5, 0.25):
                step = frame.applied(change * share, self.freedom)
                fit, moved, covered = self._tried(a, b, step @ best.b_H_a)
                if fit.correlation > best.correlation + 1e-5:
                    best, fields, valid = fit, moved, covered
                    break
            else:
                break
            if np.abs(change).max() < _STILL:
                break
        return best

    def _tried(
        self, a: Orientation, b: Orientation, b_H_a: Matrix
    ) -> tuple[Fit, Fields, NDArray[np.float32]]:
        b_H_a = b_H_a / b_H_a[2, 2]
        fields, valid = warped(a, b_H_a, b.shape)
        both = valid * b.valid
        product = float(np.vdot(fields, b.fields))
        energy_a = float(np.vdot(strength(fields), b.valid))
        energy_b = float(np.vdot(b.strength, valid))
        correlation = product / np.sqrt(energy_a * energy_b + _TINY)
        fit = Fit(
            b_H_a=b_H_a,
            correlation=float(correlation),
            overlap=float(both.sum()),
            freedom=self.freedom,
        )
        return fit, fields, valid


@dataclass(frozen=True, kw_only=True, eq=False)
class _Frame:
    """b's pixels relative to its middle in units of half its longer side, so that parameters have
    similar magnitudes.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    unit: float
    centre: Matrix

    @classmethod
    def of(cls, shape: tuple[int, int]) -> "_Frame":
        cx, cy = (shape[1] - 1) / 2, (shape[0] - 1) / 2
        unit = max(shape) / 2
        y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
        return cls(
            x=(x - np.float32(cx)) / np.float32(unit),
            y=(y - np.float32(cy)) / np.float32(unit),
            unit=unit,
            centre=np.array([[1, 0, cx], [0, 1, cy], [0, 0, 1.0]]),
        )

    def applied(self, p: NDArray[np.float64], freedom: Freedom) -> Matrix:
        """A small transform of b's frame from its parameters: shifts in px, at the middle or at
        unit distance.
        """
        q = np.zeros(6)
        if freedom == "similarity":
            q[:4] = np.array([p[2], -p[3], p[3], p[2]]) / self.unit
        else:
            q[:4] = p[2:6] / self.unit
        if freedom == "homography":
            q[4:] = -p[6:8] / self.unit**2
        small = np.array([[1 + q[0], q[1], p[0]], [q[2], 1 + q[3], p[1]], [q[4], q[5], 1.0]])
        return np.asarray(self.centre @ small @ np.linalg.inv(self.centre))


def _change(
    fields: Fields, valid: NDArray[np.float32], b: Orientation, frame: _Frame, freedom: Freedom
) -> NDArray[np.float64] | None:
    """The step's parameters; None if the overlap is too small or there is no correlation."""
    inside = ((valid * b.valid) > 0.5).astype(np.float32)
    if inside.sum() < _LEAST:
        return None
    moved = channels(fields) * inside
    J = _derivatives(channels(fields), moved, inside, frame, freedom)
    w, target = moved.ravel(), b.channels.ravel()
    H = (J @ J.T).astype(np.float64)
    H += 1e-4 * np.trace(H) / len(H) * np.eye(len(H))
    Jw, Jb = (J @ w).astype(np.float64), (J @ target).astype(np.float64)
    projected = np.linalg.solve(H, Jw)
    own, cross = float(w @ w - Jw @ projected), float(target @ w - Jb @ projected)
    if (
        cross <= 0
    ):  # only the shift explains it: second case of Evangelidis and Psarakis, simplified
        cross = float(target @ w)
    if cross <= 0:
        return None
    return np.asarray(np.linalg.solve(H, min(own / cross, _LARGEST_GAIN) * Jb - Jw))


def _derivatives(
    w: NDArray[np.float32],
    moved: NDArray[np.float32],
    inside: NDArray[np.float32],
    frame: _Frame,
    freedom: Freedom,
) -> NDArray[np.float32]:
    """Derivatives (parameters, 4 h w) of the warped fields w (4, h, w), 0 outside; `moved`: w, 0
    outside.
    """
    J = np.zeros((_PARAMETERS[freedom], *w.shape), np.float32)
    np.subtract(w[:, :, :-2], w[:, :, 2:], out=J[0, :, :, 1:-1])
    np.subtract(w[:, :-2], w[:, 2:], out=J[1, :, 1:-1])
    J[:2] *= inside / 2
    x, y = frame.x, frame.y
    # change of the fields by the rotation of orientations, per px of shift at unit distance
    turn = moved[[1, 0, 3, 2]] * (np.array([-1, 1, -2, 2], np.float32) / frame.unit)[:, None, None]
    if freedom == "similarity":
        J[2] = J[0] * x + J[1] * y
        J[3] = J[1] * x - J[0] * y + 2 * turn
        return J.reshape(4, -1)
    J[2], J[3], J[4], J[5] = J[0] * x, J[0] * y - turn, J[1] * x + turn, J[1] * y
    if freedom == "homography":
        along = J[0] * x + J[1] * y
        J[6], J[7] = along * x, along * y
    return J.reshape(len(J), -1)
