"""Sub-pixel translation of many small patches at once, by Gauss-Newton on brightness."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]
MOST_NOISE = 0.75
"""Largest share of the weakest gradients that counts as noise."""
ALIKE = 3
"""Side in px of the squares within which misfits of two patches may be correlated."""


def translate(
    reference: Float, moving: Float, *, margin: int = 3, iterations: int = 4
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Shifts of the content of moving patches against reference patches.

    Lucas and Kanade (1981), inverse compositional, gain and offset removed by normalising both
    patches.

    Args:
        reference: (n, s, s).
        moving: (n, s + 2 margin, s + 2 margin), the same ground with a margin around it.
        margin: px; no shift found can exceed it.
        iterations: Gauss-Newton steps.

    Returns:
        Shifts (n, 2) in px, x then y, the correlation (n,) reached, and the standard deviation
        (n,) in px of an axis, which the misfit left between both patches tells. The first two are
        NaN where a shift exceeded the margin or a patch is uniform.
    """
    n, s, _ = reference.shape
    if not n:
        return np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    ref = _normalised(reference.reshape(n, -1))
    gy, gx = (np.asarray(g) for g in np.gradient(ref.reshape(n, s, s), axis=(1, 2)))
    slope = np.stack([gx.reshape(n, -1), gy.reshape(n, -1)], 1)
    H = slope @ np.swapaxes(slope, 1, 2) + 1e-6 * np.eye(2, dtype=np.float32)
    # what offset and gain do not take up
    taken = np.stack([slope.mean(2) * s, _times(slope, ref)], 2)
    held = H.astype(np.float64) - taken @ np.swapaxes(taken, 1, 2)
    H_inv = _inverse(H.astype(np.float64))
    shift = np.zeros((n, 2))
    for _ in range(iterations):
        current = _normalised(_sampled(moving, shift, margin, s))
        shift -= _times(H_inv, _times(slope, current - ref))
        shift = np.clip(np.nan_to_num(shift), -margin, margin)
    current = _normalised(_sampled(moving, shift, margin, s))
    score = np.einsum("ni,ni->n", current, ref)
    lost = (np.abs(shift) >= margin - 1e-6).any(1) | ~np.isfinite(score)
    shift[lost], score[lost] = np.nan, np.nan
    misfit = current - score[:, None].astype(np.float32) * ref
    misfit[lost] = 0
    pull = (slope * misfit[:, None]).reshape(n, 2, s, s)
    return shift, score, _deviation(held, pull, (misfit**2).sum(1))


def _times(matrix: NDArray[Any], vector: NDArray[Any]) -> NDArray[Any]:
    """Products (n, k) of matrices (n, k, i) with vectors (n, i)."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _inverse(symmetric: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverses of symmetric matrices (n, 2, 2), written out: a library's loop over so many small
    ones takes longer than all else.
    """
    a, b, d = symmetric[:, 0, 0], symmetric[:, 0, 1], symmetric[:, 1, 1]
    turned = np.stack([np.stack([d, -b], 1), np.stack([-b, a], 1)], 1)
    return np.asarray(turned / (a * d - b * b)[:, None, None])


def _deviation(
    H: NDArray[np.float64], pull: Float, squares: NDArray[np.floating[Any]]
) -> NDArray[np.float64]:
    """Standard deviations (n,) in px of an axis, from normal matrices (n, 2, 2), from slope times
    misfit of each pixel (n, 2, s, s), and from the sum of squares (n,) of the misfit.

    The covariance is G^-1 S G^-1. Half of the misfit is noise of the reference. Its gradients are
    in the normal matrix, but do not hold a shift: what holds it is G = H - noise. S is the
    covariance of what the misfits pull at the shift. Leaves and relief within a patch make those of
    neighbouring pixels alike, so their products within small squares are added to it (Newey and
    West 1987): as if they were independent, crowns would seem half as inaccurate as they are.
    """
    s = pull.shape[2]
    trace, det = H[:, 0, 0] + H[:, 1, 1], H[:, 0, 0] * H[:, 1, 1] - H[:, 0, 1] ** 2
    weakest = trace / 2 - np.sqrt(np.maximum(trace**2 / 4 - det, 0))
    # offset, gain and shift are estimated
    spare = s * s / (s * s - 4)
    # central differences of white noise have half of its variance
    noise = np.minimum(squares * spare / 4, MOST_NOISE * weakest)
    G_inv = _inverse(H - noise[:, None, None] * np.eye(2))
    S = _of_squares(pull).astype(np.float64) * spare
    return np.asarray(np.sqrt(np.maximum(np.einsum("nij,njk,nki->n", G_inv, S, G_inv) / 2, 0)))


def _of_squares(pull: Float) -> Float:
    """Covariances (n, 2, 2) of sums over patches (n, 2, s, s), in which pixels of the same square
    of `ALIKE` px may be correlated, averaged over all places of these squares.
    """
    s, k = pull.shape[2], min(ALIKE, pull.shape[2])
    inside = s - k + 1
    columns = sum((pull[:, :, i : i + inside] for i in range(1, k)), pull[:, :, :inside])
    squares = sum(
        (columns[..., i : i + inside] for i in range(1, k)), columns[..., :inside]
    ).reshape(len(pull), 2, -1)
    share = s * s / (inside * k) ** 2
    return np.asarray(squares @ np.swapaxes(squares, 1, 2) * np.float32(share))


def _normalised(flat: Float) -> Float:
    """Rows of zero mean and unit length; NaN where a row is constant."""
    out = flat - flat.mean(1, keepdims=True)
    length = np.sqrt(np.einsum("ni,ni->n", out, out))
    return np.asarray(out / np.where(length > 1e-3, length, np.float32(np.nan))[:, None])


def _sampled(moving: Float, shift: NDArray[np.float64], margin: int, s: int) -> Float:
    """Moving patches (n, s * s) sampled at their shifts, bilinear."""
    n = len(moving)
    whole = np.floor(shift).astype(int)
    part = (shift - whole).astype(np.float32)
    x0 = np.clip(margin + whole[:, 0], 0, 2 * margin - 1)
    y0 = np.clip(margin + whole[:, 1], 0, 2 * margin - 1)
    windows = np.lib.stride_tricks.sliding_window_view(moving, (s + 1, s + 1), axis=(1, 2))
    block = windows[np.arange(n), y0, x0]
    fx, fy = part[:, 0, None, None], part[:, 1, None, None]
    rows = block[:, :, :-1] + (block[:, :, 1:] - block[:, :, :-1]) * fx
    return np.asarray(rows[:, :-1] + (rows[:, 1:] - rows[:, :-1]) * fy).reshape(n, -1)
