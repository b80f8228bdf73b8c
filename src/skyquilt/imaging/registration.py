"""Sub-pixel translation between patches that show the same ground under different light.

The weighted normalised correlation of two complex gradient images, ga and gb (gx + i gy), for a
shift d:

    ncc(d) = Re sum W conj(ga(x)) gb(x + d) / sqrt(sum W |ga(x)|^2 * sum W |gb(x + d)|^2)
    W = w(x) w(x + d)

By Cauchy-Schwarz it is 1 at the true shift of equal patches and less elsewhere, so the window does
not bias the shift towards zero. Gradients remove the offset, the norm removes the gain. Exchanging
the patches negates the shift. All sums are correlations, computed by FFT; the peak is found by
Newton's method on their Fourier series.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.gradients import Spectra, Stack, gradients, window


def fft2(stack: NDArray[Any]) -> Spectra:
    """The transform of each patch of a stack (n, h, w)."""
    return _each(stack, 0)


def ifft2(stack: NDArray[Any]) -> Spectra:
    """The inverse transform of each spectrum of a stack (n, h, w)."""
    return _each(stack, cv2.DFT_INVERSE | cv2.DFT_SCALE)


def _each(stack: NDArray[Any], flags: int) -> Spectra:
    source = np.ascontiguousarray(stack, np.complex64)
    out = np.empty_like(source)
    pairs, into = (x.view(np.float32).reshape(*x.shape, 2) for x in (source, out))
    for k in range(len(pairs)):
        cv2.dft(pairs[k], into[k], flags)
    return out


RADIUS = 8
"""Largest shift in px searched along each axis."""
MIN_PEAK = 0.35
"""Correlation below which a peak is weak: 3000 pairs of unrelated real patches stay below."""
BROAD_PEAK = 0.7
"""Correlation below which a broad peak is weak: smooth patches have few details, which can match by
chance.
"""
APART = 4
"""If the correlation this many px from the peak is still above MAX_RATIO of it, the peak is
broad.
"""
MAX_RATIO = 0.8
"""Ratio of second to first peak above which the shift is ambiguous."""


@dataclass(frozen=True, kw_only=True)
class Shift:
    """Shift of a second patch's content against the first's: b(x + dx, y + dy) shows what a(x, y)
    shows.
    """

    dx: float
    """Px along columns, rightwards."""
    dy: float
    """Px along rows, downwards."""
    peak: float
    """Correlation at the peak, at most 1."""
    second: float
    """Correlation at the next highest peak; 0 if there is no other."""
    reason: str = ""
    """Why it is not reliable; empty if it is."""

    @property
    def ok(self) -> bool:
        """Whether the shift is reliable."""
        return not self.reason

    def __bool__(self) -> bool:
        return self.ok


def shift_between(a: NDArray[Any], b: NDArray[Any], *, radius: int = RADIUS) -> Shift:
    """The shift between two patches (S, S); see `shifts_between`."""
    return shifts_between(np.asarray(a)[None], np.asarray(b)[None], radius=radius)[0]


def shifts_between(a: NDArray[Any], b: NDArray[Any], *, radius: int = RADIUS) -> list[Shift]:
    """The shift of each of n pairs of patches, a and b both (n, S, S), any unit, without gaps.

    Shifts reach `radius` px along each axis, S must be at least four times that.
    """
    if a.shape != b.shape or a.ndim != 3 or a.shape[1] != a.shape[2]:
        raise ValueError(f"two equal stacks (n, S, S) expected, got {a.shape} and {b.shape}")
    if a.shape[1] < 4 * radius:
        raise ValueError(
            f"patches of at least {4 * radius} px expected for a radius of {radius}, got"
            f" {a.shape[1]}"
        )
    shifts = []
    # so that the arrays of a block stay within the processor's cache
    for k in range(0, len(a), 32):
        shifts += _block(gradients(a[k : k + 32]), gradients(b[k : k + 32]), radius)
    return shifts


def _block(ga: Spectra, gb: Spectra, radius: int) -> list[Shift]:
    """Shifts from gradients."""
    w = window(ga.shape[1])
    cross = np.conj(fft2(ga * w)) * fft2(gb * w)
    energy = _energies(ga, gb, w, radius + 1)
    field = (_near(ifft2(cross).real, radius + 1) / np.sqrt(energy)).astype(np.float32)
    inner = field[:, 1:-1, 1:-1]
    top = inner.reshape(len(inner), -1).argmax(1)
    row, column = top // inner.shape[2], top % inner.shape[2]
    start = np.stack([row, column], 1) - radius
    slope = _slope(np.log(energy), row + 1, column + 1) / 2
    summit, steep = _summit(cross, start, slope)
    peak = inner[np.arange(len(inner)), row, column]
    weak = np.where(_farther(inner, start) > MAX_RATIO * peak, BROAD_PEAK, MIN_PEAK)
    second = _second(field, row, column)
    rules = {
        "peak at the edge of the search": np.abs(start).max(1) == radius,
        "no clear peak": ~steep,
        "weak peak": peak < weak,
        "ambiguous": second > MAX_RATIO * peak,
    }
    reasons = np.select(list(rules.values()), list(rules), default="")
    return [
        Shift(dx=dx, dy=dy, peak=p, second=q, reason=str(reason))
        for (dy, dx), p, q, reason in zip(
            summit.tolist(), peak.tolist(), second.tolist(), reasons, strict=True
        )
    ]


def _near(field: Stack, radius: int) -> Stack:
    """Values (n, 2 radius + 1, 2 radius + 1) at shifts -radius..radius of circular correlations (n,
    S, S).
    """
    index = np.arange(-radius, radius + 1)
    return field[:, index[:, None], index[None, :]]


def _energies(ga: Spectra, gb: Spectra, w: Stack, radius: int) -> Stack:
    """Product of both patches' weighted gradient energies at each shift, (n, 2 radius + 1, 2 radius
    + 1).
    """
    power = np.empty_like(ga)
    power.real = (ga.real**2 + ga.imag**2) * w
    # the window is symmetric, so a's energy at d equals that of the flipped field: one transform
    # serves both
    power.imag = (gb.real**2 + gb.imag**2) * w
    both = ifft2(np.conj(fft2(w[None])) * fft2(power))
    a, b = _near(both.real, radius)[:, ::-1, ::-1], _near(both.imag, radius)
    return np.maximum(a, 0) * np.maximum(b, 0) + np.float32(1e-20)


def _slope(values: Stack, row: NDArray[Any], column: NDArray[Any]) -> NDArray[np.float64]:
    """(n, 2) derivative along rows and columns at one place of each field."""
    k = np.arange(len(values))
    along_rows = values[k, row + 1, column] - values[k, row - 1, column]
    along_columns = values[k, row, column + 1] - values[k, row, column - 1]
    return np.stack([along_rows, along_columns], 1).astype(np.float64) / 2


def _summit(
    cross: Spectra, start: NDArray[Any], slope: NDArray[np.float64], *, steps: int = 4
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Shifts (n, 2: row, column) of the peak of log correlation minus its slowly varying norm, and
    whether each was reached within a pixel of `start`.
    """
    d = start.astype(np.float64)
    good = np.ones(len(d), bool)
    for _ in range(steps):
        t = _taylor(cross, d)
        c = t[:, 0, 0]
        with np.errstate(all="ignore"):
            gradient = np.stack([t[:, 1, 0], t[:, 0, 1]], 1) / c[:, None]
            hessian = np.stack([t[:, 2, 0], t[:, 1, 1], t[:, 1, 1], t[:, 0, 2]], 1).reshape(
                -1, 2, 2
            )
            hessian = hessian / c[:, None, None] - gradient[:, :, None] * gradient[:, None, :]
            determinant = np.linalg.det(hessian)
            good &= (c > 0) & (determinant > 0) & (hessian[:, 0, 0] < 0)
            hessian[~good] = -np.eye(2)
            step = np.linalg.solve(hessian, (slope - gradient)[..., None])[..., 0]
        d = d + np.where(good[:, None], np.clip(step, -0.5, 0.5), 0)
    good &= (np.abs(d - start) <= 1).all(1)
    return d, good


def _taylor(cross: Spectra, d: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives (n, 3, 3) of order (i, j) along rows and columns of the correlation at shifts d
    (n, 2).
    """
    size = cross.shape[1]
    k = 2j * np.pi * np.fft.fftfreq(size)
    order = np.arange(3)
    wave = np.exp(k * d[..., None])[..., None] * k[:, None] ** order
    wave = wave.astype(np.complex64)
    return np.asarray(
        (wave[:, 0].transpose(0, 2, 1) @ (cross @ wave[:, 1])).real / size**2, np.float64
    )


def _farther(inner: Stack, start: NDArray[Any]) -> Stack:
    """(n,) the highest correlation APART px or more from the peaks at shifts `start` (n, 2)."""
    shift = np.arange(inner.shape[1]) - inner.shape[1] // 2
    rows, columns = np.abs(shift - start[:, :1]), np.abs(shift - start[:, 1:])
    away = np.maximum(rows[:, :, None], columns[:, None, :]) >= APART
    return np.asarray(np.where(away, inner, -1).max((1, 2)).astype(np.float32))


def _second(field: Stack, row: NDArray[Any], column: NDArray[Any]) -> Stack:
    """(n,) the highest local maximum except the one at (row, column); the field's margin does not
    count.

    The flank of a broad peak is no second peak: smooth patches with one clear position have such
    flanks.
    """
    inner = field[:, 1:-1, 1:-1]
    summit = np.ones(inner.shape, bool)
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
        summit &= inner >= field[:, i : i + inner.shape[1], j : j + inner.shape[2]]
    summit[np.arange(len(field)), row, column] = False
    return np.asarray(np.where(summit, inner, 0).max((1, 2)).astype(np.float32))
