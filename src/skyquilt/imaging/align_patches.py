"""Sub-pixel translation of many small patches at once, by Gauss-Newton on brightness."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]
MOST_NOISE = 0.75
"""Largest share of the weakest gradients that counts as noise."""


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
    J = np.stack([gx.reshape(n, -1), gy.reshape(n, -1)], 1)
    H = J @ np.swapaxes(J, 1, 2) + 1e-6 * np.eye(2, dtype=np.float32)
    # what offset and gain do not take up
    taken = np.stack([J.mean(2) * s, np.einsum("nki,ni->nk", J, ref)], 2)
    held = H.astype(np.float64) - taken @ np.swapaxes(taken, 1, 2)
    J = np.linalg.solve(H, J)
    shift = np.zeros((n, 2))
    for _ in range(iterations):
        current = _normalised(_sampled(moving, shift, margin, s))
        shift -= np.einsum("nki,ni->nk", J, current - ref)
        shift = np.clip(np.nan_to_num(shift), -margin, margin)
    score = np.einsum("ni,ni->n", _normalised(_sampled(moving, shift, margin, s)), ref)
    lost = (np.abs(shift) >= margin - 1e-6).any(1) | ~np.isfinite(score)
    shift[lost], score[lost] = np.nan, np.nan
    # both have unit length, so what is left between them is 2 (1 - score); offset, gain and shift
    # are estimated
    left = np.maximum(2 * (1 - score), 0) / (s * s - 4)
    return shift, score, _deviation(held, np.nan_to_num(left), s * s)


def _deviation(
    H: NDArray[np.float64], left: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """Standard deviations (n,) of an axis, from normal matrices (n, 2, 2) and the variance (n,) of
    the misfit of each of so many pixels.

    Half of the misfit is noise of the reference. Its gradients are in the normal matrix, but do not
    hold a shift: what holds it is G = H - noise, and the covariance is left G^-1 H G^-1.
    """
    trace, det = H[:, 0, 0] + H[:, 1, 1], H[:, 0, 0] * H[:, 1, 1] - H[:, 0, 1] ** 2
    weakest = trace / 2 - np.sqrt(np.maximum(trace**2 / 4 - det, 0))
    # central differences of white noise have half of its variance
    noise = np.minimum(left * count / 4, MOST_NOISE * weakest)
    G_inv = np.linalg.inv(H - noise[:, None, None] * np.eye(2))
    return np.asarray(np.sqrt(left * np.einsum("nij,njk,nki->n", G_inv, H, G_inv) / 2))


def _normalised(flat: Float) -> Float:
    """Rows of zero mean and unit length; NaN where a row is constant."""
    centred = flat - flat.mean(1, keepdims=True)
    length = np.linalg.norm(centred, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(length > 1e-3, centred / length, np.float32(np.nan))


def _sampled(moving: Float, shift: NDArray[np.float64], margin: int, s: int) -> Float:
    """Moving patches (n, s * s) sampled at their shifts, bilinear."""
    n = len(moving)
    whole = np.floor(shift).astype(int)
    part = (shift - whole).astype(np.float32)
    x0 = np.clip(margin + whole[:, 0], 0, 2 * margin - 1)
    y0 = np.clip(margin + whole[:, 1], 0, 2 * margin - 1)
    span = np.arange(s + 1)
    block = moving[
        np.arange(n)[:, None, None],
        (y0[:, None] + span)[:, :, None],
        (x0[:, None] + span)[:, None, :],
    ]
    fx, fy = part[:, 0, None, None], part[:, 1, None, None]
    rows = block[:, :, :-1] * (1 - fx) + block[:, :, 1:] * fx
    return np.asarray(rows[:, :-1] * (1 - fy) + rows[:, 1:] * fy).reshape(n, -1)
