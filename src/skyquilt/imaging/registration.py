"""Sub-pixel translation between patches that show the same ground under different light.

The weighted normalised correlation of two complex gradient images, ga and gb (gx + i gy), for a shift d:

    ncc(d) = Re sum W conj(ga(x)) gb(x + d) / sqrt(sum W |ga(x)|^2 * sum W |gb(x + d)|^2),  W = w(x) w(x + d)

By Cauchy-Schwarz it is 1 at the true shift of equal patches and less elsewhere, so the window pulls nothing
towards zero; gradients drop the offset, the norm drops the gain; exchanging the patches negates the shift.
All sums are correlations, found by FFT; the summit is found by Newton's method on their Fourier series.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

RADIUS = 8
"""Largest shift in px looked for along each axis."""
MIN_PEAK = 0.3
"""Correlation below which a summit is weak: one in 3000 pairs of unrelated real patches comes higher."""
MAX_RATIO = 0.8
"""Second summit over the first above which the place is ambiguous."""
APART = 4
"""Px from the first summit within which its own flank lies."""
NOISE = 1.5
"""Standard deviation of the noise of a pixel value taken for granted, for pictures of 0 to 255."""
TEXTURE = 2.0
"""Times the noise's own gradient that a patch must vary in every direction to have texture."""
RIM = 2
"""Px at the border of a patch where its gradient is not used."""
_DERIVE = np.array([-1, -2, 0, 2, 1], np.float32) / 8
_SMOOTH = np.array([1, 4, 6, 4, 1], np.float32) / 16

Stack = NDArray[np.float32]
Spectra = NDArray[np.complex64]


@dataclass(frozen=True, kw_only=True)
class Shift:
    """How far a second patch's content lies from the first's: b(x + dx, y + dy) shows what a(x, y) shows."""

    dx: float
    """Px along columns, rightwards."""
    dy: float
    """Px along rows, downwards."""
    peak: float
    """Correlation at the summit, at most 1."""
    second: float
    """Highest correlation away from it."""
    reason: str = ""
    """Why it is not to be trusted; empty if it is."""

    @property
    def ok(self) -> bool:
        """Whether the shift is to be trusted."""
        return not self.reason

    def __bool__(self) -> bool:
        return self.ok


def shift_between(a: NDArray, b: NDArray, *, radius: int = RADIUS) -> Shift:
    """The shift between two patches (S, S); see `shifts_between`."""
    return shifts_between(np.asarray(a)[None], np.asarray(b)[None], radius=radius)[0]


def shifts_between(a: NDArray, b: NDArray, *, radius: int = RADIUS) -> list[Shift]:
    """The shift of each of n pairs of patches, a and b both (n, S, S), any unit, without gaps.

    Shifts reach `radius` px along each axis, S must be at least four times that.
    """
    if a.shape != b.shape or a.ndim != 3 or a.shape[1] != a.shape[2]:
        raise ValueError(f"two equal stacks (n, S, S) expected, got {a.shape} and {b.shape}")
    if a.shape[1] < 4 * radius:
        raise ValueError(
            f"patches of at least {4 * radius} px expected for a radius of {radius}, got {a.shape[1]}"
        )
    shifts = []
    for k in range(0, len(a), 32):  # a block's arrays stay within the processor's cache
        shifts += _block(gradients(a[k : k + 32]), gradients(b[k : k + 32]), radius)
    return shifts


def gradients(patches: NDArray) -> Spectra:
    """Complex gradients (n, S, S), gx + i gy per px, of patches (n, S, S), lightly smoothed; rim 0."""
    n, size, _ = patches.shape
    if not n:
        return np.zeros(patches.shape, np.complex64)
    tall = np.ascontiguousarray(patches, np.float32).reshape(n * size, size)
    g = np.zeros((n, size, size), np.complex64)
    inner = (slice(None), slice(RIM, -RIM), slice(RIM, -RIM))
    g.real[inner] = cv2.sepFilter2D(tall, cv2.CV_32F, _DERIVE, _SMOOTH).reshape(n, size, size)[inner]
    g.imag[inner] = cv2.sepFilter2D(tall, cv2.CV_32F, _SMOOTH, _DERIVE).reshape(n, size, size)[inner]
    return g


def weakest_gradient(patches: NDArray) -> NDArray[np.float64]:
    """RMS gradient (n,) per px of patches (n, S, S) along the direction in which each varies least.

    A patch that holds one straight edge varies along one direction only and fixes no shift along the other.
    """
    g = gradients(patches) * np.sqrt(window(patches.shape[1]))
    xx, yy = (g.real**2).sum((1, 2)), (g.imag**2).sum((1, 2))
    xy = (g.real * g.imag).sum((1, 2))
    least = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    return np.asarray(np.sqrt(np.maximum(least, 0) / window(patches.shape[1]).sum()), np.float64)


def has_texture(patches: NDArray, *, noise: float = NOISE) -> NDArray[np.bool_]:
    """Whether each of n patches (n, S, S) varies enough in every direction to fix a shift.

    `noise` is the standard deviation of a value's noise in the patches' own unit.
    """
    of_noise = noise * float(np.linalg.norm(_DERIVE) * np.linalg.norm(_SMOOTH))
    return weakest_gradient(patches) > TEXTURE * of_noise


@lru_cache(maxsize=8)
def window(size: int) -> Stack:
    """Weights (S, S): 1 in the middle, falling to 0 over a quarter of the patch at each side."""
    edge = (np.arange(size) + 0.5 - RIM) / (size / 4)
    ramp = np.sin(np.pi / 2 * np.clip(edge, 0, 1)) ** 2
    side = ramp * ramp[::-1]
    return np.asarray(np.outer(side, side), np.float32)


def _block(ga: Spectra, gb: Spectra, radius: int) -> list[Shift]:
    """Shifts from gradients."""
    w = window(ga.shape[1])
    cross = np.conj(scipy.fft.fft2(ga * w)) * scipy.fft.fft2(gb * w)
    energy = _energies(ga, gb, w, radius + 1)
    field = _near(scipy.fft.ifft2(cross).real, radius + 1) / np.sqrt(energy)
    inner = field[:, 1:-1, 1:-1]
    top = inner.reshape(len(inner), -1).argmax(1)
    row, column = top // inner.shape[2], top % inner.shape[2]
    start = np.stack([row, column], 1) - radius
    slope = _slope(np.log(energy), row + 1, column + 1) / 2
    summit, steep = _summit(cross, start, slope)
    return [
        _judge(inner[k], (int(row[k]), int(column[k])), summit[k], bool(steep[k]))
        for k in range(len(inner))
    ]  # fmt: skip


def _near(field: Stack, radius: int) -> Stack:
    """Values (n, 2 radius + 1, 2 radius + 1) at shifts -radius..radius of circular correlations (n, S, S)."""
    index = np.arange(-radius, radius + 1)
    return field[:, index[:, None], index[None, :]]


def _energies(ga: Spectra, gb: Spectra, w: Stack, radius: int) -> Stack:
    """Product of both patches' weighted gradient energies at each shift, (n, 2 radius + 1, 2 radius + 1)."""
    power = np.empty_like(ga)
    power.real = (ga.real**2 + ga.imag**2) * w
    # the window is symmetric, so a's energy at d equals that of the turned field: one transform serves both
    power.imag = (gb.real**2 + gb.imag**2) * w
    both = scipy.fft.ifft2(np.conj(scipy.fft.fft2(w)) * scipy.fft.fft2(power))
    a, b = _near(both.real, radius)[:, ::-1, ::-1], _near(both.imag, radius)
    return np.maximum(a, 0) * np.maximum(b, 0) + np.float32(1e-20)


def _slope(values: Stack, row: NDArray, column: NDArray) -> NDArray[np.float64]:
    """(n, 2) derivative along rows and columns at one place of each field."""
    k = np.arange(len(values))
    along_rows = values[k, row + 1, column] - values[k, row - 1, column]
    along_columns = values[k, row, column + 1] - values[k, row, column - 1]
    return np.stack([along_rows, along_columns], 1).astype(np.float64) / 2


def _summit(
    cross: Spectra, start: NDArray, slope: NDArray[np.float64], *, steps: int = 4
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Shifts (n, 2: row, column) where log correlation minus its slowly varying norm is highest, and whether
    each was reached within a pixel of `start`.
    """
    d = start.astype(np.float64)
    good = np.ones(len(d), bool)
    for _ in range(steps):
        t = _taylor(cross, d)
        c = t[:, 0, 0]
        with np.errstate(all="ignore"):
            gradient = np.stack([t[:, 1, 0], t[:, 0, 1]], 1) / c[:, None]
            hessian = np.stack([t[:, 2, 0], t[:, 1, 1], t[:, 1, 1], t[:, 0, 2]], 1).reshape(-1, 2, 2)
            hessian = hessian / c[:, None, None] - gradient[:, :, None] * gradient[:, None, :]
            determinant = np.linalg.det(hessian)
            good &= (c > 0) & (determinant > 0) & (hessian[:, 0, 0] < 0)
            hessian[~good] = -np.eye(2)
            step = np.linalg.solve(hessian, (slope - gradient)[..., None])[..., 0]
        d = d + np.where(good[:, None], np.clip(step, -0.5, 0.5), 0)
    good &= (np.abs(d - start) <= 1).all(1)
    return d, good


def _taylor(cross: Spectra, d: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivatives (n, 3, 3) of order (i, j) along rows and columns of the correlation at shifts d (n, 2)."""
    size = cross.shape[1]
    k = 2j * np.pi * np.fft.fftfreq(size)
    order = np.arange(3)
    wave = np.exp(k * d[..., None])[..., None] * k[:, None] ** order
    wave = wave.astype(np.complex64)
    return np.asarray((wave[:, 0].transpose(0, 2, 1) @ (cross @ wave[:, 1])).real / size**2, np.float64)


def _judge(field: Stack, at: tuple[int, int], d: NDArray[np.float64], converged: bool) -> Shift:
    """A shift with the verdict on its correlation field."""
    peak = float(field[at])
    rows, columns = np.ogrid[: field.shape[0], : field.shape[1]]
    away = np.maximum(abs(rows - at[0]), abs(columns - at[1])) >= APART
    second = float(field[away].max())
    reason = ""
    if min(at) == 0 or max(at) == len(field) - 1:
        reason = "summit at the edge of the search"
    elif not converged:
        reason = "no clear summit"
    elif peak < MIN_PEAK:
        reason = "weak summit"
    elif second > MAX_RATIO * peak:
        reason = "ambiguous"
    return Shift(dx=float(d[1]), dy=float(d[0]), peak=peak, second=second, reason=reason)
