"""Similarity of two images with gaps: normalised cross-correlation, for one position or for all
shifts at once, phase correlation, and mutual information.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_LOWEST = 0.03
"""Share of the spectrum's radius around its centre that is not used for rotation, since it contains
shading and the window function.
"""


def phase_shift(a: NDArray[Any], b: NDArray[Any]) -> tuple[float, float, float]:
    """(dx, dy, response): b(x + dx, y + dy) corresponds to a(x, y); response 0 to 1, the peak's
    share of the energy.

    Both (H, W), equal shapes; shifts up to half of the size.
    """
    if a.shape != b.shape:
        raise ValueError(f"equal shapes expected, got {a.shape} and {b.shape}")
    first, second = (np.asarray(p, np.float32) - np.float32(np.mean(p)) for p in (a, b))
    (dx, dy), response = cv2.phaseCorrelate(first, second, _window(a.shape))
    return float(dx), float(dy), float(response)


def rotation_and_scale(a: NDArray[Any], b: NDArray[Any]) -> tuple[float, float, float]:
    """(degrees, scale, response) of b against a from the log-polar amplitudes of both spectra.

    b's content is a's rotated by `degrees` from x towards y and magnified by `scale`. The rotation
    is ambiguous by 180 degrees.
    """
    size = 256
    radius = min(a.shape) / 2
    logs = []
    for p in (a, b):
        amplitude = np.abs(np.fft.fftshift(np.fft.fft2((p - np.mean(p)) * _window(p.shape))))
        square = cv2.resize(np.log1p(amplitude).astype(np.float32), (2 * int(radius),) * 2)
        square = np.asarray(square * _highpass(square.shape[0]), np.float32)
        flags = cv2.WARP_POLAR_LOG | cv2.INTER_LINEAR
        logs.append(cv2.warpPolar(square, (size, 2 * size), (radius, radius), radius, flags)[:size])
    window = np.ones((size, 1), np.float32) @ cv2.createHanningWindow((size, 4), cv2.CV_32F)[1:2]
    logs = [(p - p.mean()) * window for p in logs]
    (along, around), response = cv2.phaseCorrelate(*logs)
    # a magnified image has a smaller spectrum
    scale = float(np.exp(-along * np.log(radius) / size))
    return (float(around) * 180 / size + 90) % 180 - 90, scale, float(response)


def _window(shape: tuple[int, ...]) -> NDArray[np.float32]:
    return np.asarray(cv2.createHanningWindow((shape[1], shape[0]), cv2.CV_32F), np.float32)


def _highpass(size: int) -> NDArray[np.float32]:
    """High-pass filter that increases from the centre of a spectrum (Reddy and Chatterji, (12));
    zero below _LOWEST and outside the circle.
    """
    f = (np.arange(size) - size / 2) / size
    x = np.cos(np.pi * f)[:, None] * np.cos(np.pi * f)
    far = np.hypot(f[:, None], f)
    return np.asarray(((1 - x) * (2 - x) * ((far > _LOWEST / 2) & (far < 0.5))).astype(np.float32))


Floats = NDArray[np.float64]


def ncc(a: NDArray[Any], b: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float:
    """Zero-mean correlation in [-1, 1] of two images (H, W) where `mask` is true; 0 if one is
    constant or no pixel is left.
    """
    x, y = (np.asarray(p, np.float64)[... if mask is None else mask].ravel() for p in (a, b))
    if x.size < 2:
        return 0.0
    x, y = x - x.mean(), y - y.mean()
    norm = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / norm if norm > 1e-9 * x.size else 0.0


def ncc_of_shifts(
    a: NDArray[Any],
    b: NDArray[Any],
    mask_a: NDArray[np.bool_] | None = None,
    mask_b: NDArray[np.bool_] | None = None,
    *,
    overlap: float = 0.2,
) -> tuple[Floats, tuple[int, int]]:
    """The correlation of a (Ha, Wa) and b (Hb, Wb) at every shift, and the (row, column) of no
    shift in it.

    At [r + dy, c + dx] b(x + dx, y + dy) lies on a(x, y). -1 where less than the share `overlap` of
    the smaller image's pixels overlap. Computed by FFT, with means and norms over the overlapping
    pixels at each shift (Padfield, IEEE TIP 2012).
    """
    import scipy.fft  # imported here, since it is rarely needed

    masks = [np.ones(p.shape, bool) if m is None else m for p, m in ((a, mask_a), (b, mask_b))]
    centred = [
        np.where(m, p - (p[m].mean() if m.any() else 0.0), 0.0)
        for p, m in zip((a, b), masks, strict=True)
    ]
    shape = tuple(
        scipy.fft.next_fast_len(p + q - 1, real=True) for p, q in zip(a.shape, b.shape, strict=True)
    )

    def spectrum(x: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(scipy.fft.rfft2(x, shape))

    ma, mb = (spectrum(m.astype(np.float64)) for m in masks)
    fa, fb = (spectrum(p) for p in centred)
    pa, pb = (spectrum(p * p) for p in centred)

    def correlated(x: NDArray[Any], y: NDArray[Any]) -> Floats:
        field = scipy.fft.irfft2(np.conj(x) * y, shape)
        rows = np.arange(-(a.shape[0] - 1), b.shape[0])
        columns = np.arange(-(a.shape[1] - 1), b.shape[1])
        return np.asarray(field[rows[:, None], columns])

    count = np.rint(correlated(ma, mb))
    some = np.maximum(count, 1)
    sum_a, sum_b = correlated(fa, mb), correlated(ma, fb)
    top = correlated(fa, fb) - sum_a * sum_b / some
    spread_a = correlated(pa, mb) - sum_a**2 / some
    spread_b = correlated(ma, pb) - sum_b**2 / some
    least = 1e-6 * max(float((p * p).sum()) for p in centred)
    good = (count >= max(2.0, overlap * min(m.sum() for m in masks))) & (
        np.minimum(spread_a, spread_b) > least
    )
    with np.errstate(all="ignore"):
        values = np.where(good, top / np.sqrt(spread_a * spread_b), -1.0)
    return np.clip(values, -1, 1), (a.shape[0] - 1, a.shape[1] - 1)


def summit(field: Floats, *, apart: int = 4) -> tuple[float, float, float, float]:
    """(row, column, value, second) of the highest value, with subpixel position by parabolas;
    `second` is the highest value at least `apart` px from it.
    """
    row, column = np.unravel_index(int(field.argmax()), field.shape)
    value = float(field[row, column])
    rest = field.copy()
    rest[max(row - apart + 1, 0) : row + apart, max(column - apart + 1, 0) : column + apart] = -1
    off = []
    for line, k in ((field[:, column], row), (field[row], column)):
        bend = 2 * line[k] - line[k - 1] - line[k + 1] if 0 < k < len(line) - 1 else 0.0
        off.append(
            float(np.clip((line[k + 1] - line[k - 1]) / 2 / bend, -0.5, 0.5)) if bend > 0 else 0.0
        )
    return float(row) + off[0], float(column) + off[1], value, float(rest.max())


def warped(
    b: NDArray[Any], b_H_a: Floats, shape: tuple[int, ...]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """b (H, W) resampled to a's pixels (`shape`), and its valid area."""
    size = (shape[1], shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpPerspective(b.astype(np.float32), b_H_a, size, flags=flags)
    inside = cv2.warpPerspective(np.full(b.shape, 255, np.uint8), b_H_a, size, flags=flags) == 255
    return np.asarray(seen, np.float32), np.asarray(inside)


def mutual_information(
    a: NDArray[Any], b: NDArray[Any], mask: NDArray[np.bool_] | None = None, *, bins: int = 32
) -> float:
    """Normalised mutual information (H(a) + H(b)) / H(a, b) - 1 in [0, 1] (Studholme et al. 1999)
    where `mask` is true.

    0 independent, 1 each determines the other. Grey values of each (H, W) are put into `bins`
    between their 1st and 99th percentile; a value is shared between two neighbouring bins by its
    distance, so that the result is smooth.
    """
    x, y = (np.asarray(p, np.float64)[... if mask is None else mask].ravel() for p in (a, b))
    if x.size < bins:
        return 0.0
    joint = np.zeros((bins + 1, bins + 1))
    (i, s), (j, t) = _binned(x, bins), _binned(y, bins)
    for di, wi in ((0, 1 - s), (1, s)):
        for dj, wj in ((0, 1 - t), (1, t)):
            joint += np.bincount((i + di) * (bins + 1) + j + dj, wi * wj, joint.size).reshape(
                joint.shape
            )
    joint /= joint.sum()
    both = _entropy(joint)
    return (_entropy(joint.sum(0)) + _entropy(joint.sum(1))) / both - 1 if both > 1e-12 else 0.0


def _binned(
    values: NDArray[np.float64], bins: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Lower bin, and weight of the next one."""
    low, high = np.percentile(values, [1, 99])
    place = np.clip((values - low) / max(high - low, 1e-12), 0, 1) * (bins - 1)
    lower = place.astype(np.int64)
    return lower, place - lower


def _entropy(p: NDArray[np.float64]) -> float:
    positive = p[p > 0]
    return float(-(positive * np.log(positive)).sum())
